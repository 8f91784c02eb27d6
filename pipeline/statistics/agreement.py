"""How far raters, or labels and predictions, agree. scipy and scikit-learn are imported only where they are used.

Sources: Shrout and Fleiss 1979 (ICC); Cohen 1968 (weighted kappa).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from statistics import fmean

from pipeline.statistics.figures import LEVEL, Interval


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


def quadratic_kappa(expected: Sequence[int], predicted: Sequence[int], classes: int) -> float | None:
    """1 - (mean squared distance) / (the same if both were paired at random); None where the latter is 0.

    Args:
        expected: Classes from 0 to `classes` - 1.
        predicted: As many.
        classes: How many there are.
    """
    if len({*expected, *predicted}) < 2:
        return None
    from sklearn.metrics import cohen_kappa_score

    return float(cohen_kappa_score(expected, predicted, weights="quadratic", labels=range(classes)))
