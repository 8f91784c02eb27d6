"""The projection's start: frames of each class read like its words, also those of videos that it was not fitted to."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.nn import functional as F

from pipeline.core.records import Question
from pipeline.language.begin import begin_with_words
from pipeline.language.training import Material, assemble
from tests.checkpoints import write_llama
from tests.language.conftest import CATALOGUE, DIM, taking, write_store


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
    store = write_store(tmp_path, frames, torch.stack([felt(labels[v], drawn) for v, _, _ in frames]))
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
