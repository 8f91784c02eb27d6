"""Intervals from a variance over questions that share objects. All functions take many data sets at once.

A variance over few objects is itself uncertain: Student's t with one degree of freedom less than there are objects
makes up for most of it, though not in all designs (Cameron and Miller 2015). Near 0 and 1 a symmetric interval fails
whatever its variance, so they take the shape of those for independent questions, with an effective number of these.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.statistics.clusters import TINY, Clusters, Values, variance
from pipeline.statistics.figures import LEVEL


class Estimate(NamedTuple):
    """A mean over questions and how sure it is; arrays of equal shape, one entry a data set."""

    mean: Values
    square: Values
    """Mean of the squares."""
    variance: Values
    """Of the mean."""
    freedom: Values
    """Degrees of freedom of the variance."""


def estimate(values: Values, clusters: Clusters) -> Estimate:
    """Mean and variance over questions, with as many degrees of freedom as there are objects, less one.

    Args:
        values: (..., questions).
    """
    mean = values.mean(axis=-1)
    freedom = np.full(mean.shape, float(clusters.objects - 1))
    return Estimate(mean, (values**2).mean(axis=-1), variance(values, clusters), freedom)


def accuracy_bounds(found: Estimate, clusters: Clusters) -> tuple[Values, Values]:
    """Wilson's interval with the effective number of questions in place of n and Student's t in place of z.

    The effective number is that of independent questions with the variance found (Kish 1965), at most n: so Korn and
    Graubard 1998, with t, for the exact interval; Franco, Little, Louis, Slud 2019 compare intervals of this kind and
    recommend Wilson's. Where all answers are alike there is nothing to estimate a variance from, and objects count, not
    questions.
    """
    binomial = found.mean * (1 - found.mean)
    n = _effective(binomial, found.variance, clusters)
    c = _quantile(found.freedom) ** 2 / n
    centre = (found.mean + c / 2) / (1 + c)
    half = np.sqrt(np.maximum(0.0, c * binomial + c * c / 4)) / (1 + c)
    # Rounding must not leave the estimate outside.
    low = np.clip(np.minimum(centre - half, found.mean), 0, 1)
    return low, np.clip(np.maximum(centre + half, found.mean), 0, 1)


def difference_bounds(found: Estimate, clusters: Clusters) -> tuple[Values, Values]:
    """Interval of a mean of paired differences from -1 to 1: one question won and one lost are added before.

    That is the adjusted interval of Bonett and Price 2012 with the effective number of questions in place of n and t
    in place of z. It keeps a width where all differences are alike, of which a variance would make none.
    """
    error, centre = _difference(found, clusters)
    half = _quantile(found.freedom) * error
    low = np.clip(np.minimum(centre - half, found.mean), -1, 1)
    return low, np.clip(np.maximum(centre + half, found.mean), -1, 1)


def difference_error(found: Estimate, clusters: Clusters) -> Values:
    """The standard error that `difference_bounds` is made with; above 0."""
    return _difference(found, clusters)[0]


def _difference(found: Estimate, clusters: Clusters) -> tuple[Values, Values]:
    """Standard error and centre of `difference_bounds`."""
    questions = clusters.questions
    spread = np.maximum(0.0, found.square - found.mean**2) * questions / max(1, questions - 1)
    n = _effective(spread, found.variance, clusters)
    centre = n * found.mean / (n + 2)
    square = (n * found.square + 2) / (n + 2)
    return np.sqrt(np.maximum(0.0, square - centre**2) / (n + 2)), centre


def _effective(single: Values, mean: Values, clusters: Clusters) -> Values:
    """How many independent questions with the variance `single` have a mean with the variance `mean`."""
    few = min(clusters.objects, clusters.questions)
    known = (single > TINY) & (mean > TINY)
    numbers = np.where(known, single / np.where(known, mean, 1.0), few)
    effective: Values = np.clip(numbers, 1, clusters.questions)
    return effective


def _quantile(freedom: Values) -> Values:
    from scipy.stats import t

    quantile: Values = t.ppf((1 + LEVEL) / 2, freedom)
    return quantile
