"""Conversations: training and evaluation see the same text, only answers carry labels, batches hold like lengths."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import BatchSampler
from transformers import PreTrainedTokenizerBase

from pipeline.language.base import load_tokenizer
from pipeline.language.chat import IGNORE_INDEX, TACTILE_TOKENS, encode, render
from pipeline.language.conversations import POOL, LengthBuckets, collate
from pipeline.language.generate import write_prompt
from pipeline.language.training import Material, assemble
from pipeline.records import Turn
from tests.checkpoints import write_llama
from tests.language.shared import DIM, FRAMES, generation, taking
from tests.models import model_folder


@pytest.fixture(scope="module", params=["random", "tiny"])
def tokenizer(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PreTrainedTokenizerBase:
    if request.param == "tiny":
        return load_tokenizer(model_folder("tiny-llama"))
    return load_tokenizer(write_llama(tmp_path_factory.mktemp("llama")))


def test_without_a_begin_token_all_else_is_the_same(tokenizer: PreTrainedTokenizerBase, held: Material) -> None:
    """As the published code trains and asks; what a chat template writes is its own."""
    turns = [Turn(user="Feel {tactile}.", assistant="Soft.")]
    rendered = render(turns, tokenizer, system_prompt="", frames=2, complete=True)
    usual, without = (encode(rendered, tokenizer, bos=bos) for bos in (True, False))
    assert (without.input_ids, without.labels) == (usual.input_ids[1:], usual.labels[1:])
    own = replace(rendered, text="<s>" + rendered.text, answers=(), templated=True)
    assert encode(own, tokenizer, bos=False) == encode(own, tokenizer)
    _, theirs = assemble(replace(held, language=held.language.model_copy(update={"bos": False})), taking(6), "test")
    _, ours = assemble(held, taking(6), "test")
    assert [(1, *e.input_ids) for e in theirs.encoded] == [e.input_ids for e in ours.encoded]
    asked = write_prompt(turns, tokenizer, generation(1).model_copy(update={"bos": False}), FRAMES)
    assert asked == tuple(
        i for i, label in zip(without.input_ids, without.labels, strict=True) if label == IGNORE_INDEX
    )


def test_same_draws_for_same_epoch_and_others_for_another(held: Material) -> None:
    _, data = assemble(held, taking(6), "test")
    first = [data[i]["features"] for i in range(len(data))]
    assert all(torch.equal(a, data[i]["features"]) for i, a in enumerate(first))
    data.follow(lambda: 1)
    assert not all(torch.equal(a, data[i]["features"]) for i, a in enumerate(first))


def test_counterfactuals_have_other_videos_and_teach_only_conclusions(held: Material) -> None:
    """Of the described questions the wanted share, and no other; all else is as without."""
    tokenizer = load_tokenizer(Path(held.language.weights))
    (_, plain), (_, mixed) = (assemble(held, taking(14, counterfactual=share), "test") for share in (0.0, 0.5))
    described = changed = 0
    for epoch in range(40):
        for data in (plain, mixed):
            data.follow(lambda: epoch)  # noqa: B023 - asked in this round alone
        for index, question in enumerate(mixed.questions):
            usual, drawn = plain[index], mixed[index]
            turns = question.dialogue(held.opd).turns  # type: ignore[union-attr]
            described += any(turn.described for turn in turns)
            assert torch.equal(usual["input_ids"], drawn["input_ids"])
            assert usual["features"].shape == drawn["features"].shape
            if torch.equal(usual["labels"], drawn["labels"]):
                continue
            changed += 1
            learnt = drawn["labels"][drawn["labels"] != IGNORE_INDEX].tolist()
            said = str(tokenizer.decode(learnt))
            assert said.replace("</s>", "").strip() == turns[-1].assistant[turns[-1].described :].strip()
            assert not torch.equal(usual["features"], drawn["features"])
    assert 0.4 < changed / described < 0.6


def test_replayed_text_has_no_touch_and_weighs_as_conclusions_do(held: Material) -> None:
    own = {"conclusion_weight": 4.0, "weighting": "token"}
    (_, plain), (_, mixed) = (assemble(held, taking(9, replay=share, **own), "test") for share in (0.0, 0.25))
    assert (len(plain), len(mixed), len(mixed.lengths)) == (9, 12, 12)
    assert mixed.questions == plain.questions
    assert all(torch.equal(plain[i]["weights"], mixed[i]["weights"]) for i in range(9))
    tokenizer = load_tokenizer(Path(held.language.weights))
    tactile = set(tokenizer.convert_tokens_to_ids(list(TACTILE_TOKENS)))
    for sample in (mixed[i] for i in range(9, 12)):
        assert not tactile & set(sample["input_ids"].tolist())
        assert sample["features"].shape == (0, DIM)
        assert set(sample["weights"][sample["labels"] != IGNORE_INDEX].tolist()) == {4.0}
    assert len({tuple(mixed[i]["input_ids"].tolist()) for i in range(9, 12)}) == 3
    model, _ = assemble(held, taking(1), "test")
    alone, beside = collate([mixed[9], mixed[10]]), collate([mixed[0], mixed[9]])
    model(**alone).loss.backward()
    gradients = [p.grad for p in model.connector.parameters()]
    assert all(g is not None and not g.any() for g in gradients), "there, but nothing is learnt of touch"
    with torch.no_grad():
        sums = [float(model(**collate([mixed[i]])).loss) * float(mixed[i]["weights"].sum()) for i in (0, 9)]
        both = float(beside["weights"].sum())
        assert float(model(**beside).loss) == pytest.approx(sum(sums) / both, rel=1e-5)


LENGTHS = st.lists(st.integers(1, 500), max_size=300)


@settings(max_examples=30)
@given(LENGTHS, st.integers(1, 20), st.integers(0, 5), st.integers(0, 3))
def test_each_epoch_has_every_conversation_once(lengths: list[int], size: int, seed: int, epoch: int) -> None:
    sampler = LengthBuckets(lengths, size, seed, lambda: epoch)
    order = list(sampler)
    assert sorted(order) == list(range(len(lengths)))
    assert len(sampler) == len(lengths)
    assert list(sampler) == order, "asked again, as a resumed training does"
    # Batches of sorted neighbours are disjoint in length, but for ties: no other cut of a pool pads less.
    batches = [order[i * size : (i + 1) * size] for i in range(len(order) // size)]
    for start in range(0, len(batches), POOL):
        ranges = sorted((min(b), max(b)) for b in ([lengths[i] for i in x] for x in batches[start : start + POOL]))
        assert all(low[1] <= high[0] for low, high in pairwise(ranges))


def test_epochs_and_seeds_differ() -> None:
    orders = [list(LengthBuckets([5] * 64, 4, s, lambda e=e: e)) for s in (0, 1) for e in (0, 1)]  # type: ignore[misc]
    assert len({tuple(order) for order in orders}) == 4


def test_padding_falls_and_batches_come_in_no_order_of_length() -> None:
    rng = random.Random(0)
    lengths = [rng.choice((50, 115, 158, 210)) + rng.randrange(10) for _ in range(800)]

    def padding(order: list[int]) -> float:
        batches = list(BatchSampler(order, 4, drop_last=False))
        return 1 - sum(lengths) / sum(len(b) * max(lengths[i] for i in b) for b in batches)

    order = list(LengthBuckets(lengths, 4, 0, lambda: 0))
    assert padding(order) < 0.05
    assert padding(list(range(800))) > 0.25
    first = [lengths[i] for i in order[: 4 * POOL : 4]]
    assert first not in (sorted(first), sorted(first, reverse=True))
