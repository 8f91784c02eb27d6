"""Errors with their intervals: 95 %, over objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

import numpy as np

from pipeline.core.records import ScoreRow
from pipeline.evaluation.intervals import accuracy_interval

WRONG = "share of videos of unseen objects of which not every property is right"


@dataclass(frozen=True)
class Error:
    """An error, and the ends of its interval where there are objects enough."""

    value: float
    low: float | None = None
    high: float | None = None
    n: int | None = None
    """Videos, answers or scenes that it is over."""

    @property
    def columns(self) -> dict[str, float]:
        """As a row of the table names them."""
        columns = {"error": self.value, "low": self.low, "high": self.high, "n": self.n}
        return {name: value for name, value in columns.items() if value is not None}


def share_of(wrong: Sequence[float] | np.ndarray, objects: Sequence[tuple[str, ...]]) -> Error:
    """The share of what is wrong, with the interval of the reports.

    Args:
        wrong: From 0 (right) to 1, of each question or video.
        objects: What each is about.
    """
    values = np.array(wrong, dtype=np.float64)
    interval = accuracy_interval(values, objects)
    low, high = (interval.low, interval.high) if interval else (None, None)
    return Error(float(values.mean()), low, high, len(values))


def mean_of(values: Sequence[float], objects: Sequence[str]) -> Error:
    """The mean of a quantity that is not negative, with Student's t over the objects' means, as many of each object."""
    from scipy.stats import t

    means = [fmean(v for v, o in zip(values, objects, strict=True) if o == own) for own in sorted(set(objects))]
    if len(means) < 2:
        return Error(fmean(values), n=len(values))
    half = float(t.ppf(0.975, len(means) - 1)) * stdev(means) / len(means) ** 0.5
    return Error(fmean(means), max(fmean(means) - half, 0.0), fmean(means) + half, len(values))


def error_of(score: ScoreRow) -> Error:
    """One less the accuracy of a row of scores.csv."""
    low, high = (None if end is None else 1 - end for end in (score.high, score.low))
    return Error(1 - score.accuracy, low, high, score.n)
