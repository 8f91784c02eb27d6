"""How sure a figure is: intervals, agreement, confusion. scipy and NumPy are imported only where they are used.

Sources: Wilson 1927 (the binomial interval); Owen 2007, "The pigeonhole bootstrap" (resampling crossed objects with
product weights); Cameron, Gelbach, Miller 2008 (few clusters); Holm 1979 (families of tests); Shrout and Fleiss 1979
(ICC).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import fmean, stdev
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

LEVEL = 0.95
MOST_ENUMERATED = 8
"""Up to so many clusters every resample is enumerated (8: 6435 of them); beyond, resamples are drawn."""
DRAWS = 10_000


@dataclass(frozen=True)
class Interval:
    """A 95 % interval of a proportion, both ends from 0 to 1."""

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
class Proportion:
    """An accuracy over questions."""

    correct: float
    """Right answers; with several seeds their mean, which need not be whole."""
    n: int
    """Questions."""
    wilson: Interval
    clustered: Interval | None
    """Object-clustered; None where fewer than two objects leave nothing to resample."""

    @property
    def value(self) -> float:
        """The accuracy, from 0 to 1."""
        return self.correct / self.n


@dataclass(frozen=True)
class Difference:
    """How much more often one setting is right than another, on the same questions, from -1 to 1."""

    value: float
    interval: Interval | None
    """Object-clustered; None where fewer than two objects leave nothing to resample."""
    p: float | None
    """Twice the smaller share of the resamples on either side of zero: below .05 where the interval excludes zero."""


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


def wilson(correct: float, n: int) -> Interval:
    """Wilson's 95 % interval of a proportion; `correct` is rounded to a whole number of successes.

    Raises:
        ValueError: if `n` is not positive or `correct` is not from 0 to `n`.
    """
    from scipy.stats import binomtest

    interval = binomtest(math.floor(correct + 0.5), n).proportion_ci(LEVEL, method="wilson")
    return Interval(float(interval.low), float(interval.high))


def clustered(outcomes: Sequence[Outcome], seed: int = 0) -> Interval | None:
    """Percentile interval of an accuracy when objects, not questions, are drawn anew with replacement.

    A question's weight in a resample is the product over its objects of how often each was drawn: for questions about
    one object this is the ordinary cluster bootstrap, for pairs and triples Owen's pigeonhole bootstrap. Resamples in
    which no question has any weight (all draws on too few objects) have no accuracy and are left out. With up to
    `MOST_ENUMERATED` objects the distribution is exact, beyond it is drawn with `seed`. Like every bootstrap over a
    handful of clusters it is optimistic: read it as a lower bound of the uncertainty.

    Returns:
        None for fewer than two objects.
    """
    resampled = _resampled(outcomes, seed)
    return _percentiles(*resampled) if resampled else None


def paired(gains: Sequence[Outcome], seed: int = 0) -> Difference:
    """The mean of paired differences, its object-clustered interval (`clustered`) and the p that belongs to it.

    Raises:
        ValueError: without any question.
    """
    if not gains:
        raise ValueError("a comparison needs at least one question")
    resampled = _resampled(gains, seed)
    value = math.fsum(gain.correct for gain in gains) / len(gains)
    if resampled is None:
        return Difference(value, None, None)
    values, probabilities = resampled
    below, above = (float(probabilities[side].sum()) for side in (values <= 0, values >= 0))
    # A p of 0 would claim more than the resamples can show: at the least it is that of the rarest of them.
    tail = max(min(below, above), float(probabilities.min()))
    return Difference(value, _percentiles(values, probabilities), min(1.0, 2 * tail))


def holm(ps: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment: what each p of a family is worth when all of them were looked at (Holm 1979)."""
    order = sorted(range(len(ps)), key=ps.__getitem__)
    adjusted, worst = [0.0] * len(ps), 0.0
    for rank, i in enumerate(order):
        worst = max(worst, min(1.0, (len(ps) - rank) * ps[i]))
        adjusted[i] = worst
    return adjusted


def _resampled(outcomes: Sequence[Outcome], seed: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The mean in each resample of objects and the resample's probability; None for fewer than two objects."""
    import numpy as np

    objects = sorted({o for outcome in outcomes for o in outcome.objects})
    if len(objects) < 2:
        return None
    place = {o: i for i, o in enumerate(objects)}
    sets = tuple(sorted({tuple(sorted(place[o] for o in outcome.objects)) for outcome in outcomes}))
    position = {s: i for i, s in enumerate(sets)}
    correct, total = np.zeros(len(sets)), np.zeros(len(sets))
    for outcome in outcomes:
        i = position[tuple(sorted(place[o] for o in outcome.objects))]
        correct[i] += outcome.correct
        total[i] += 1
    weights, probabilities = _weights(len(objects), sets, seed)
    held = weights @ total
    defined = held > 0
    return (weights @ correct)[defined] / held[defined], probabilities[defined] / probabilities[defined].sum()


def proportion(outcomes: Sequence[Outcome], seed: int = 0) -> Proportion:
    """Accuracy with both intervals.

    Raises:
        ValueError: without any outcome.
    """
    if not outcomes:
        raise ValueError("an accuracy needs at least one outcome")
    correct = math.fsum(outcome.correct for outcome in outcomes)
    return Proportion(correct, len(outcomes), wilson(correct, len(outcomes)), clustered(outcomes, seed))


def icc3k(ratings: Sequence[Sequence[float]]) -> float | None:
    """Agreement of the mean of k raters, ICC(3,k): two-way mixed, consistency (Shrout and Fleiss 1979).

    Args:
        ratings: targets x raters, all rows of equal length.

    Returns:
        At most 1; None where it is undefined: fewer than two targets or raters, or targets that do not differ.
    """
    squares = _mean_squares(ratings)
    return None if squares is None else (squares[0] - squares[1]) / squares[0]


def icc3k_interval(ratings: Sequence[Sequence[float]]) -> Interval | None:
    """The 95 % interval of `icc3k` (Shrout and Fleiss 1979: F of targets over error); None where that is undefined."""
    from scipy.stats import f

    squares = _mean_squares(ratings)
    if squares is None:
        return None
    between, error = squares
    if error <= 1e-12:
        return Interval(1.0, 1.0)
    targets, errors = len(ratings) - 1, (len(ratings) - 1) * (len(ratings[0]) - 1)
    tail = (1 + LEVEL) / 2
    low = 1 - error / between * float(f.ppf(tail, targets, errors))
    high = 1 - error / between / float(f.ppf(tail, errors, targets))
    return Interval(low, high)


def _mean_squares(ratings: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """Mean squares between targets and of the error; None where an ICC is undefined."""
    n, k = len(ratings), len(ratings[0]) if ratings else 0
    if n < 2 or k < 2:
        return None
    mean = fmean(itertools.chain.from_iterable(ratings))
    rows = k * math.fsum((fmean(row) - mean) ** 2 for row in ratings)
    columns = n * math.fsum((fmean(column) - mean) ** 2 for column in zip(*ratings, strict=True))
    total = math.fsum((value - mean) ** 2 for row in ratings for value in row)
    between = rows / (n - 1)
    if between <= 1e-12:
        return None
    # Perfect agreement may end a rounding error below 0.
    return between, max(0.0, total - rows - columns) / ((n - 1) * (k - 1))


def confusion(expected: Sequence[int], predicted: Sequence[int], classes: int) -> tuple[tuple[int, ...], ...]:
    """Counts by expected (rows) and predicted class (columns), each from 0 to `classes` - 1."""
    counts = [[0] * classes for _ in range(classes)]
    for row, column in zip(expected, predicted, strict=True):
        counts[row][column] += 1
    return tuple(map(tuple, counts))


def compositions(total: int, parts: int) -> Iterator[tuple[int, ...]]:
    """All ways to write `total` as an ordered sum of `parts` whole numbers from 0: C(total + parts - 1, parts - 1)."""
    for bars in itertools.combinations(range(total + parts - 1), parts - 1):
        edges = (-1, *bars, total + parts - 1)
        yield tuple(b - a - 1 for a, b in itertools.pairwise(edges))


@lru_cache(maxsize=8)
def _weights(objects: int, sets: tuple[tuple[int, ...], ...], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """How often each resample holds each set of objects (resamples x sets), and each resample's probability.

    Kept, since all variants answer the same questions.
    """
    import numpy as np

    counts, probabilities = _resamples(objects, seed)
    return np.stack([counts[:, list(s)].prod(axis=1) for s in sets], axis=1), probabilities


def _resamples(clusters: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """How often each cluster is drawn (resamples x clusters, float64), and each resample's probability."""
    import numpy as np

    if clusters > MOST_ENUMERATED:
        drawn = np.random.default_rng(seed).multinomial(clusters, [1 / clusters] * clusters, size=DRAWS)
        return drawn.astype(np.float64), np.full(DRAWS, 1 / DRAWS)
    every = list(compositions(clusters, clusters))
    ways = [math.factorial(clusters) / math.prod(map(math.factorial, counts)) for counts in every]
    return np.array(every, dtype=np.float64), np.array(ways) / clusters**clusters


def _percentiles(values: np.ndarray, probabilities: np.ndarray) -> Interval:
    """The central 95 % of a discrete distribution: the smallest values that reach each tail's share."""
    import numpy as np

    order = np.argsort(values, kind="stable")
    reached = np.cumsum(probabilities[order]) / probabilities.sum()
    # A tail that is met exactly, up to rounding, counts as met.
    shares = np.array([(1 - LEVEL) / 2, (1 + LEVEL) / 2]) - 1e-12
    low, high = values[order][np.minimum(np.searchsorted(reached, shares), len(values) - 1)]
    return Interval(float(low), float(high))
