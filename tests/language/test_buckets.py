"""The order of training: every conversation once, neighbours of like length, the same again for the same epoch."""

from __future__ import annotations

import random
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st
from pipeline.language.buckets import POOL, LengthBuckets
from torch.utils.data import BatchSampler

LENGTHS = st.lists(st.integers(1, 500), max_size=300)


@given(LENGTHS, st.integers(1, 20), st.integers(0, 5), st.integers(0, 3))
def test_each_epoch_has_every_conversation_once(lengths: list[int], size: int, seed: int, epoch: int) -> None:
    sampler = LengthBuckets(lengths, size, seed, lambda: epoch)
    order = list(sampler)
    assert sorted(order) == list(range(len(lengths)))
    assert len(sampler) == len(lengths)
    assert list(sampler) == order, "asked again, as a resumed training does"


def test_epochs_and_seeds_differ() -> None:
    orders = [list(LengthBuckets([5] * 64, 4, s, lambda e=e: e)) for s in (0, 1) for e in (0, 1)]  # type: ignore[misc]
    assert len({tuple(order) for order in orders}) == 4


@given(st.lists(st.integers(1, 500), min_size=1, max_size=300), st.integers(1, 20), st.integers(0, 5))
def test_within_a_pool_no_other_cut_pads_less(lengths: list[int], size: int, seed: int) -> None:
    """Batches of sorted neighbours are disjoint in length, but for ties: that is what makes their padding least."""
    order = list(LengthBuckets(lengths, size, seed, lambda: 0))
    full = len(order) // size
    batches = [order[i * size : (i + 1) * size] for i in range(full)]
    for start in range(0, full, POOL):
        ranges = sorted((min(b), max(b)) for b in ([lengths[i] for i in x] for x in batches[start : start + POOL]))
        assert all(low[1] <= high[0] for low, high in pairwise(ranges))


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
