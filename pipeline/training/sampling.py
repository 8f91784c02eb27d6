"""How a clip is drawn from the frames that were kept of a video.

Paper, "Data Processing": training draws five salient frames at random, evaluation takes five at uniform intervals from
the first.
"""

from __future__ import annotations

import random
from typing import Generic, TypeVar

from torch.utils.data import Dataset


def sample_training(count: int, k: int, rng: random.Random) -> tuple[int, ...]:
    """`k` random positions in a list of `count` kept frames, sorted; repeated only where there are fewer than k."""
    chosen = rng.sample(range(count), k) if count >= k else rng.choices(range(count), k=k)
    return tuple(sorted(chosen))


def sample_evaluation(count: int, k: int) -> tuple[int, ...]:
    """`k` positions at uniform intervals from the first of `count` kept frames."""
    return tuple(i * count // k for i in range(k))


T = TypeVar("T", covariant=True)


class EpochDataset(Dataset[T], Generic[T]):
    """A dataset that draws anew in each epoch; `TrainingMonitor` sets which one it is."""

    epoch = 0
