"""What a comparison can find before it is made. scipy and NumPy are imported only where they are used.

Sources: Bloom 1995 (minimum detectable effects, without clusters); Murray 1998 (trials of groups: degrees of freedom by
groups); Miller 2024, arXiv 2411.00640 (power of evaluations of language models).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from pipeline.statistics.figures import Outcome

POWER = 0.8
ALPHA = 0.05


def smallest_effect(
    error: float, objects: int, power: float = POWER, alpha: float = ALPHA, freedom: float | None = None
) -> float:
    """The smallest true difference that a two-sided t test over objects finds with the given power.

    That is the standard error times the noncentrality at which Student's t, with as many degrees of freedom as there
    are objects, less one, exceeds its critical value as often as `power`. Bloom's sum of two quantiles is the same
    but for a few percent at seven objects. For a family of tests give `alpha` over their number. The sign-flip test
    over few objects needs more.

    Args:
        error: Standard error of the difference, in its unit.
        objects: How many of them.
        power: How often it is to be found.
        alpha: The test's size.
        freedom: Degrees of freedom of the error where they are not objects less one.

    Returns:
        In the unit of `error`; above 1 no difference of accuracies is large enough.

    Raises:
        ValueError: for fewer than two objects, or a power that is not from alpha to 1.
    """
    if objects < 2:
        raise ValueError("a test over objects needs at least two")
    if not 0 < alpha < power < 1:
        raise ValueError(f"power {power} at size {alpha}: 0 < size < power < 1 is needed")
    return error * _noncentrality(objects - 1 if freedom is None else freedom, power, alpha)


def planned_error(objects: int, questions: float, between: float, within: float) -> float:
    """The standard error that a mean of paired differences will have, for questions about one object each.

    Args:
        objects: How many will be measured.
        questions: About each.
        between: Deviation of the objects' true differences.
        within: Deviation of single questions' differences about one object.

    Raises:
        ValueError: without objects or questions.
    """
    if objects < 1 or questions <= 0:
        raise ValueError("a design needs objects and questions")
    return math.sqrt((between**2 + within**2 / questions) / objects)


@dataclass(frozen=True)
class Deviations:
    """How much paired differences vary."""

    between: float
    """Between objects: of an object's own share in the differences of its questions."""
    within: float
    """Between questions about the same objects; 0 where no object has two, as they cannot be told apart then."""


def deviations(gains: Sequence[Outcome]) -> Deviations | None:
    """What was observed of both, to plan the next comparison with; below 0 estimated variances count as 0.

    Returns:
        None where the questions cannot show that objects differ.
    """
    if not gains:
        return None
    import numpy as np

    from pipeline.statistics.clusters import clusters_of, components

    clusters = clusters_of(tuple(gain.objects for gain in gains))
    if not clusters.estimable:
        return None
    own, *rest = components(np.array([gain.correct for gain in gains]), clusters)
    return Deviations(math.sqrt(float(own)), math.sqrt(float(sum(rest))))


@lru_cache(maxsize=64)
def _noncentrality(freedom: float, power: float, alpha: float) -> float:
    from scipy.optimize import brentq
    from scipy.stats import f, ncf

    # The square of t is F with one degree of freedom; scipy's noncentral t is NaN far out.
    critical = float(f.isf(alpha, 1, freedom))

    def missing(shift: float) -> float:
        return float(ncf.sf(critical, 1, freedom, shift**2)) - power

    high = 1.0
    while missing(high) < 0:
        high *= 2
    return float(brentq(missing, 1e-6, high, xtol=1e-10))
