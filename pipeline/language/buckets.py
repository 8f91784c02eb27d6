"""The order in which conversations are trained on: neighbours of like length, so that little is padding."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence

from torch.utils.data import Sampler

from pipeline.runtime import derive_seed

POOL = 16
"""Batches that are drawn together and dealt by length: more of them pad less, fewer mix lengths more freely."""


class LengthBuckets(Sampler[int]):
    """Every index once: random pools of `POOL` batches, cut by length into batches, which come in random order.

    transformers' own grouping goes from long to short within each pool, so that updates run through the tasks in the
    order of their lengths, and draws from the process's random numbers, whose state depends on what came before. Here
    the order follows from seed and epoch alone, on every device and in a resumed training alike.

    Args:
        lengths: Tokens of each item.
        size: Items of a batch.
        epoch: Asked whenever the order is drawn.
    """

    def __init__(self, lengths: Sequence[int], size: int, seed: int, epoch: Callable[[], int]) -> None:
        self.lengths = lengths
        self.size = size
        self.seed = seed
        self.epoch = epoch

    def __len__(self) -> int:
        return len(self.lengths)

    def __iter__(self) -> Iterator[int]:
        rng = random.Random(derive_seed(self.seed, self.epoch(), "order"))
        order = list(range(len(self.lengths)))
        rng.shuffle(order)
        whole = len(order) - len(order) % self.size
        # A batch that is not full ends the epoch, or all behind it would be cut elsewhere.
        rest = order[whole:]
        for start in range(0, whole, POOL * self.size):
            pool = sorted(order[start : min(start + POOL * self.size, whole)], key=self.lengths.__getitem__)
            batches = [pool[i : i + self.size] for i in range(0, len(pool), self.size)]
            rng.shuffle(batches)
            for batch in batches:
                yield from batch
        yield from rest
