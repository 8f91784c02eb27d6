"""Datasets that draw their items anew in each epoch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from torch.utils.data import Dataset

T = TypeVar("T", covariant=True)


class EpochDataset(Dataset[T], Generic[T]):
    """Knows the epoch that it is drawn from; 0 until it follows a training.

    It asks, and is not told: a data loader that begins in the middle of an epoch, as where a killed training goes on,
    tells its dataset that this is the first one.
    """

    def __init__(self) -> None:
        self._asked: Callable[[], int] = int

    def follow(self, asked: Callable[[], int]) -> None:
        """From now on, ask this for the epoch."""
        self._asked = asked

    @property
    def epoch(self) -> int:
        """Counted from 0."""
        return self._asked()
