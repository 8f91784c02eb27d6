"""Errors with their intervals: 95 %, over objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

import numpy as np

from pipeline.core.records import ScoreRow
from pipeline.encoder.folds import Labels, Predict, cross_validate
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


def share_of(wrong: Sequence[float], objects: Sequence[tuple[str, ...]]) -> Error:
    """The share of what is wrong, with the interval of the reports.

    Args:
        wrong: From 0 (right) to 1, of each question or video.
        objects: What each is about.
    """
    interval = accuracy_interval(np.array(wrong, dtype=np.float64), objects)
    if interval is None:
        return Error(fmean(wrong), n=len(wrong))
    return Error(fmean(wrong), interval.low, interval.high, len(wrong))


def mean_of(values: Sequence[float], objects: Sequence[str]) -> Error:
    """The mean of a quantity that is not negative, with Student's t over the objects' means, as many of each object."""
    from scipy.stats import t

    means = [fmean(v for v, o in zip(values, objects, strict=True) if o == own) for own in sorted(set(objects))]
    if len(means) < 2:
        return Error(fmean(values), n=len(values))
    half = float(t.ppf(0.975, len(means) - 1)) * stdev(means) / len(means) ** 0.5
    return Error(fmean(means), max(fmean(means) - half, 0.0), fmean(means) + half, len(values))


def cross_validated(
    predict: Predict,
    labels: Labels,
    objects: Sequence[str],
    classes: Sequence[int],
    *,
    folds: int = 5,
    repeats: int = 3,
) -> Error:
    """`WRONG`, by grouped cross-validation whose folds depend on the objects alone.

    Args:
        predict: Learns from the trained videos of a fold and predicts the tested ones.
        labels: Videos x properties.
        objects: Each video's object.
        classes: How many classes each property has.
    """
    predicted = cross_validate(predict, objects, classes, folds=folds, repeats=repeats)
    wrong = (predicted != labels[:, None]).any(axis=2).mean(axis=1)
    return share_of(wrong.tolist(), [(o,) for o in objects])


def error_of(score: ScoreRow) -> Error:
    """One less the accuracy of a row of scores.csv."""
    if score.low is None or score.high is None:
        return Error(1 - score.accuracy, n=score.n)
    return Error(1 - score.accuracy, 1 - score.high, 1 - score.low, score.n)
