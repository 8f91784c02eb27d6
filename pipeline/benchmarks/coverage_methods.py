"""The intervals and tests that are held against simulated answers, each over many repetitions at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.benchmarks.simulation import Design
from pipeline.statistics import wilson
from pipeline.statistics.bounds import accuracy_bounds, difference_bounds, estimate
from pipeline.statistics.clusters import Clusters, Values, overlapping_variance
from pipeline.statistics.flips import sign_flip
from pipeline.statistics.resampling import percentiles, set_weights

DRAWS = 1000
"""Resamples and signs, where they are drawn."""

Bounds = tuple[Values, Values]


@dataclass(frozen=True)
class Method:
    """How an interval is made of values (repetitions x questions)."""

    name: str
    bounds: Callable[[Values, Design], Bounds]
    reported: bool = False


@dataclass(frozen=True)
class Test:
    """How p is made of differences (repetitions x questions)."""

    name: str
    p: Callable[[Values, Design], Values]
    reported: bool = False


def independent(values: Values, design: Design) -> Bounds:
    """Wilson's interval, questions taken as independent."""
    ends = _every_wilson(values.shape[-1])[np.rint(values.sum(axis=-1)).astype(int)]
    return ends[:, 0], ends[:, 1]


def resampled(values: Values, design: Design) -> Bounds:
    """Percentiles over resamples of objects."""
    questions = design.questions()
    place = {s: i for i, s in enumerate(dict.fromkeys(questions))}
    by_set, probabilities = set_weights(design.objects, tuple(place), draws=DRAWS)
    weights = by_set[:, [place[s] for s in questions]]
    return percentiles(values @ (weights / weights.sum(axis=1, keepdims=True)).T, probabilities)


def overlapping(values: Values, design: Design) -> Bounds:
    """Mean and t over objects with the variance of overlapping clusters; below 0 that of independent questions."""
    clusters = design.clusters()
    found = estimate(values, clusters)
    least = values.var(axis=-1, ddof=1) / clusters.questions
    error = np.sqrt(np.fmax(overlapping_variance(values, clusters), least)) * _t(clusters)
    return found.mean - error, found.mean + error


def effective(values: Values, design: Design) -> Bounds:
    """As `pipeline.statistics.clustered`."""
    clusters = design.clusters()
    return accuracy_bounds(estimate(values, clusters), clusters)


def adjusted(values: Values, design: Design) -> Bounds:
    """As `pipeline.statistics.paired`."""
    clusters = design.clusters()
    return difference_bounds(estimate(values, clusters), clusters)


def mcnemar(values: Values, design: Design) -> Values:
    """As `pipeline.statistics.mcnemar`."""
    from scipy.stats import binom

    better, worse = (values > 0).sum(axis=-1), (values < 0).sum(axis=-1)
    p: Values = np.minimum(1.0, 2 * binom.cdf(np.minimum(better, worse), better + worse, 0.5))
    return p


def excluded(values: Values, design: Design) -> Values:
    """0 where the reported interval excludes 0, else 1: that as a test."""
    low, high = adjusted(values, design)
    return ((low <= 0) & (high >= 0)).astype(np.float64)


def flipped(values: Values, design: Design) -> Values:
    """As `pipeline.statistics.paired`, with fewer signs where they are drawn."""
    return sign_flip(values, design.clusters(), draws=DRAWS)


INDEPENDENT = Method("Wilson, questions as independent", independent)
RESAMPLED = Method("objects resampled, percentiles", resampled)
OVERLAPPING = Method("overlapping clusters, t", overlapping)
ACCURACY = (INDEPENDENT, RESAMPLED, OVERLAPPING, Method("Wilson, effective n, t", effective, reported=True))
DIFFERENCE = (OVERLAPPING, RESAMPLED, Method("Bonett-Price, effective n, t", adjusted, reported=True))
TESTS = (
    Test("exact McNemar", mcnemar),
    Test("interval excludes 0", excluded),
    Test("sign-flip over objects", flipped, reported=True),
)


@lru_cache(maxsize=16)
def _every_wilson(n: int) -> Values:
    """Both ends for 0 to n right answers."""
    ends = [wilson(k, n) for k in range(n + 1)]
    return np.array([(e.low, e.high) for e in ends])


def _t(clusters: Clusters) -> float:
    from scipy.stats import t

    return float(t.ppf(0.975, clusters.objects - 1))
