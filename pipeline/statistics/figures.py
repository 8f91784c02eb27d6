"""What figures are made of and what comes with them."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean, stdev

LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A 95 % interval: of a proportion from 0 to 1, of a difference from -1 to 1 (of an interaction, -2 to 2)."""

    low: float
    high: float


@dataclass(frozen=True)
class Outcome:
    """How a question went: the share of its answers (one a seed) that are right, and the objects it is about.

    For a comparison, the share under the one setting less that under the other, from -1 to 1.
    """

    correct: float
    objects: tuple[str, ...]


@dataclass(frozen=True)
class Answer:
    """How one question went in one run."""

    question: str
    seed: int
    correct: float
    """1 right, 0 wrong."""
    objects: tuple[str, ...]
    levels: tuple[str, ...] = ()
    """The run's setting of each factor, where several are compared."""


@dataclass(frozen=True)
class Spread:
    """The same figure under several seeds."""

    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Their mean."""
        return fmean(self.values)

    @property
    def deviation(self) -> float | None:
        """Their sample standard deviation; None for a single seed."""
        return stdev(self.values) if len(self.values) > 1 else None
