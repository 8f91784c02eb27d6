"""Accuracies and their intervals. scipy and NumPy are imported only where they are used.

Sources: Wilson 1927 (the binomial interval); Korn and Graubard 1998, Franco, Little, Louis, Slud 2019 (intervals with
an effective number of clustered answers); Miller 2024, arXiv 2411.00640 (error bars of evaluations, clustered
questions); Bowyer, Aitchison, Ivanova 2025, arXiv 2503.01747 (why not the normal approximation below a few hundred).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.statistics.figures import LEVEL, Interval, Outcome
from pipeline.statistics.resampling import resampled


@dataclass(frozen=True)
class Proportion:
    """An accuracy over questions."""

    correct: float
    """Right answers; with several seeds their mean, which need not be whole."""
    n: int
    """Questions."""
    wilson: Interval
    clustered: Interval | None
    """Object-clustered; None where the questions cannot show that objects differ."""
    resampled: Interval | None
    """By resampling objects; None likewise. Optimistic at few objects."""

    @property
    def value(self) -> float:
        """The accuracy, from 0 to 1."""
        return self.correct / self.n


def wilson(correct: float, n: int) -> Interval:
    """Wilson's 95 % interval of a proportion; `correct` is rounded to a whole number of successes.

    It takes questions to be independent. Where they share objects that differ it is too narrow: simulated with seven
    objects and a correlation of .7 within objects, it covers 72 to 92 % for questions about one object and 36 to 86 %
    for questions about two or three; more objects make it no better.

    Raises:
        ValueError: if `n` is not positive or `correct` is not from 0 to `n`.
    """
    from scipy.stats import binomtest

    interval = binomtest(math.floor(correct + 0.5), n).proportion_ci(LEVEL, method="wilson")
    return Interval(float(interval.low), float(interval.high))


def clustered(outcomes: Sequence[Outcome]) -> Interval | None:
    """The 95 % interval of an accuracy over questions that share objects: Wilson's, with an effective n and t.

    The variance is `clusters.variance`, the interval `bounds.accuracy_bounds`. It holds all of Wilson's interval of as
    many independent questions.

    Simulated (reports/bench/coverage.md), it covers 93 to 97 % of accuracies from .3 to .8 for questions about one
    object, with twenty objects and more also for questions about two or three (91.7 % at the least). It is wider than
    it need be, 97 to 99.7 %, where few objects do not differ. It falls short, 90 to 92 %, with seven objects for
    questions about two or three that correlate by .3 and more within objects, and with twenty and sixty at .05 or .97
    where the correlation is .7.

    Returns:
        None where the questions cannot show that objects differ: fewer than two objects, or each about all of them.
    """
    if not outcomes:
        return None
    import numpy as np

    from pipeline.statistics.bounds import accuracy_bounds, estimate
    from pipeline.statistics.clusters import clusters_of

    # Sums of floats depend on their order; questions' must not matter.
    ordered = sorted((outcome.objects, outcome.correct) for outcome in outcomes)
    clusters = clusters_of(tuple(objects for objects, _ in ordered))
    if not clusters.estimable:
        return None
    low, high = accuracy_bounds(estimate(np.array([correct for _, correct in ordered]), clusters), clusters)
    return Interval(float(low), float(high))


def proportion(outcomes: Sequence[Outcome], seed: int = 0) -> Proportion:
    """Accuracy with all its intervals; `seed` is that of the resampling beyond a few objects.

    Raises:
        ValueError: without any outcome.
    """
    if not outcomes:
        raise ValueError("an accuracy needs at least one outcome")
    correct, n = math.fsum(outcome.correct for outcome in outcomes), len(outcomes)
    return Proportion(correct, n, wilson(correct, n), clustered(outcomes), resampled(outcomes, seed))
