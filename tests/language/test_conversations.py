"""Conversations, of which only answers carry labels, batches that hold like lengths, and the projection's start."""

import random
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from accelerate.data_loader import BatchSamplerShard
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.utils.data import BatchSampler

from pipeline.core.records import Question, Turn
from pipeline.core.runtime import derive_seed
from pipeline.language.begin import begin_with_words
from pipeline.language.conversations import FILLER, UpdateSampler
from pipeline.language.generate import write_prompt
from pipeline.language.training import Material, assemble
from tests.checkpoints import write_llama
from tests.language.conftest import CATALOGUE, DIM, FRAMES, generation, stored, taking


def test_without_a_begin_token_all_else_is_the_same(held: Material) -> None:
    (_, ours), (model, theirs) = (
        assemble(replace(held, language=held.language.model_copy(update={"bos": bos})), taking(6), "test")
        for bos in (True, False)
    )
    for own, other in zip(ours.written, theirs.written, strict=True):
        assert own["input_ids"][0] == 1
        assert all(torch.equal(own[name][1:], value) for name, value in other.items())
    turns = [Turn(user="Feel {tactile}.", assistant="Soft.")]
    without = write_prompt(turns, model.tokenizer, generation(1).model_copy(update={"bos": False}), FRAMES)
    assert write_prompt(turns, model.tokenizer, generation(1), FRAMES) == (1, *without)


@settings(max_examples=30)
@given(
    st.lists(st.integers(1, 500), max_size=300),
    st.integers(1, 5),
    st.integers(1, 3),
    st.sampled_from([1, 2, 4]),
    st.integers(0, 3),
)
def test_updates_are_equal_on_any_device(lengths: list[int], micro: int, rounds: int, devices: int, epoch: int) -> None:
    """Those of a random order, as accelerate deals them; in a last update that is too small fillers take part."""
    update = micro * rounds * devices
    data = SimpleNamespace(lengths=lengths, epoch=epoch)
    sampler = UpdateSampler(data, update, 5, shared=micro * devices if devices > 1 else 1)  # type: ignore[arg-type]
    random_order = list(range(len(lengths)))
    random.Random(derive_seed(5, epoch, "order")).shuffle(random_order)
    drawn = BatchSampler(sampler, micro, drop_last=False)
    assert list(drawn) == list(drawn), "asked again, as a resumed training does"
    dealt = [list(BatchSamplerShard(drawn, devices, place) if devices > 1 else drawn) for place in range(devices)]
    assert len({len(batches) for batches in dealt}) == 1, "or one device would wait for ever"
    assert sum(map(len, dealt)) == len(drawn)
    for number, start in enumerate(range(0, len(lengths), update)):
        seen = [b for batches in dealt for b in batches[number * rounds : (number + 1) * rounds]]
        questions = [i for batch in seen for i in batch if i != FILLER]
        assert sorted(questions) == sorted(random_order[start : start + update])
        # No other cut of an update into batches pads less: they are disjoint in length, but for ties.
        ranges = sorted((min(own), max(own)) for b in seen if (own := [lengths[i] for i in b if i != FILLER]))
        assert all(low[1] <= high[0] for low, high in pairwise(ranges))


def felt(labels: tuple[int, ...], drawn: torch.Generator) -> torch.Tensor:
    """An embedding that tells all classes, and noise."""
    values = torch.tensor(labels, dtype=torch.float32) - 1
    clean = torch.cat([1.2 * values, 2 * (values.square() - 2 / 3)])
    return clean + 0.05 * torch.randn(DIM, generator=drawn)


@pytest.mark.parametrize("kind", ["Llama", "Llama, normalized", "Gemma"])
def test_frames_read_like_the_words_of_their_classes(
    kind: str, held: Material, questions: list[Question], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind, _, normalize = kind.partition(", ")
    base = str(write_llama(tmp_path / "base", kind=kind))
    labels = {v: label for q in questions for v, label in zip(q.videos, q.gold.labels, strict=True)}
    drawn = torch.Generator().manual_seed(0)
    frames = [(v, f, "none") for v in sorted(labels) for f in range(3)]
    store = stored(tmp_path, frames, torch.stack([felt(labels[v], drawn) for v, _, _ in frames]))
    language = held.language.model_copy(update={"normalize_touch": bool(normalize), "weights": base})
    monkeypatch.setattr("pipeline.language.begin.STEPS", 250)
    model, data = assemble(replace(held, language=language, store=store), taking(14), "test")
    begin_with_words(model, data, CATALOGUE, seed=1)
    assert all(p.grad is None for p in model.parameters())

    words = model.llm.get_input_embeddings()(torch.arange(260))
    seen = sorted({label for q in data.questions for label in q.gold.labels})
    assert len(seen) > 4
    means = torch.zeros(len(seen), words.shape[1])
    for mean, label in zip(means, seen, strict=True):
        for prop, place in zip(CATALOGUE.properties, label, strict=True):
            ids = model.tokenizer.encode(f" {prop.levels[place]}", add_special_tokens=False)
            mean += words[ids].mean(0).detach() / len(label)
    expected = torch.tensor([random.Random(i).randrange(len(seen)) for i in range(100)])
    with torch.no_grad():
        projected = model.connector.projection(torch.stack([felt(seen[i], drawn) for i in expected]))
    scale = means.square().mean(1).sqrt().mean() if normalize else 1.0
    read = F.normalize(projected * scale - means.mean(0), dim=1) @ F.normalize(means - means.mean(0), dim=1).T
    assert (read.argmax(1) == expected).sum() >= 90
