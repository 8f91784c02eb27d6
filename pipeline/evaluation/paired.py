"""Paired comparison of two settings on the same questions: interval, sign-flip test, minimum detectable effect.

Values are differences, (..., seeds, questions), from -1 to 1: the score of one setting minus that of the other.

Sources: Bonett and Price 2012 (the interval); Fisher 1935, Gail, Mark, Carroll, Green, Pee 1996 and, with few clusters,
Canay, Romano, Shaikh 2017 (sign flips); Cameron, Gelbach, Miller 2011 (seeds across objects); Bloom 1995 and Murray
1998 (smallest effects).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import optimize, stats
from scipy.sparse.csgraph import connected_components

from pipeline.evaluation.intervals import LEVEL, Design, Objects, Values, design_of, effective, variance

FLIPS = 2**15
"""Combinations of signs at most."""
DIGITS = 9
POWER, SIZE = 0.8, 0.05
"""Power and significance level of the minimum detectable effect."""


@dataclass(frozen=True)
class Difference:
    """How much more often one setting is right than another, as columns of `EffectRow`; shares from -1 to 1.

    All but the difference is None where the questions cannot show that objects differ, and p alone where they cannot be
    flipped apart.
    """

    difference: float
    n: int
    objects: int
    seeds: int
    low: float | None = None
    high: float | None = None
    p: float | None = None
    smallest_effect: float | None = None


def paired(values: Values, objects: Sequence[Objects]) -> Difference:
    """Compare two settings on the same questions under the same seeds.

    Args:
        values: Differences, seeds x questions.

    Raises:
        ValueError: without any question.
    """
    seeds, questions = values.shape
    # Sums of floats depend on their order; that of the questions must not matter.
    order = sorted(range(questions), key=lambda q: (objects[q], *values[:, q]))
    design = design_of(tuple(objects[q] for q in order))
    values = values[:, order]
    mean = float(values.mean())
    if not design.estimable:
        return Difference(mean, questions, design.objects, seeds)
    error, centre, freedom = (float(x) for x in standard_error(values, design))
    half = float(stats.t.ppf((1 + LEVEL) / 2, freedom)) * error
    low, high = max(-1.0, min(centre - half, mean)), min(1.0, max(centre + half, mean))
    p = sign_flip(values.mean(axis=0), design)
    return Difference(mean, questions, design.objects, seeds, low, high, p, smallest_effect(error, freedom))


def standard_error(values: Values, design: Design) -> tuple[Values, Values, Values]:
    """Standard error, centre and degrees of freedom (...) of the interval of a difference.

    One question won and one lost are added to the effective number (Bonett and Price 2012), which keeps a width where
    all differences are alike. Seeds and objects cross: the variance is that of the questions' means plus that of the
    seeds' means, less what both hold; its degrees of freedom are Satterthwaite's (1946).
    """
    means = values.mean(axis=-2)
    mean, square = means.mean(axis=-1), (means**2).mean(axis=-1)
    total = variance(means, design)
    freedom, seeds = np.full(total.shape, design.freedom), values.shape[-2]
    if seeds > 1:
        of_objects = total
        both = variance(values - values.mean(axis=-2, keepdims=True), design).mean(axis=-1) * seeds / (seeds - 1)
        of_seeds = np.maximum(0.0, values.mean(axis=-1).var(axis=-1, ddof=1) - both) / seeds
        total = of_objects + of_seeds
        known = np.where(total > 0, total, 1.0)
        inverse = (of_objects / known) ** 2 / freedom + (of_seeds / known) ** 2 / (seeds - 1)
        freedom = np.where(total > 0, 1 / np.where(inverse > 0, inverse, 1.0), freedom)
    spread = np.maximum(0.0, square - mean**2) * design.questions / max(1, design.questions - 1)
    n = effective(spread, total, design)
    # One difference of 1 and one of -1 are added: 2 to the number and to the sum of squares, 0 to the sum.
    centre = n * mean / (n + 2)
    return np.sqrt(np.maximum(0.0, (n * square + 2) / (n + 2) - centre**2) / (n + 2)), centre, freedom


def sign_flip(values: Values, design: Design) -> float | None:
    """Two-sided p of the mean of differences (questions): could they as well have gone the other way?

    None where one sign would flip all: then nothing can be said.

    If both settings are equally good, what an object adds to the difference is as likely to be d as -d. Up to 15
    objects all combinations of signs are gone through, beyond that so many are drawn (Phipson and Smyth 2010 for their
    p).

    In simulations at the 5 % level, at most 5 % of comparisons of equally good settings were significant. If
    differences came only from triples of objects as wholes, it would be 13 %: the test assumes that objects' effects
    add up.
    """
    parts = flip_units(design) @ values
    if len(parts) < 2:
        return None

    def far(signed: Values, axis: int) -> Values:
        # Sums that are equal but for rounding must count as equally far.
        sums: Values = np.abs(signed.sum(axis=axis)).round(DIGITS)
        return sums

    scaled = parts / (np.abs(parts).max() or 1.0)
    found = stats.permutation_test(
        (scaled,), far, permutation_type="samples", n_resamples=FLIPS, alternative="greater", vectorized=True, rng=0
    )
    return float(found.pvalue)


@lru_cache(maxsize=32)
def flip_units(design: Design) -> Values:
    """Units x questions: the weight of each question's difference in each unit that is flipped; columns sum to 1.

    For questions about one object a unit is the object's sum. With several objects a question, the objects' sums
    overlap, and flipping them as if independent gives false positives. So each difference is modelled as the mean of
    its objects' effects, estimated by least squares, and these are flipped. That is conservative where objects differ
    little. Where effects cannot be estimated, each connected component of objects is flipped as a whole.
    """
    shares = design.membership / design.membership.sum(axis=1, keepdims=True)
    units: Values
    if np.linalg.matrix_rank(shares) == design.objects:
        # The shares of a question sum to 1, so fitted and measured differences have the same sum.
        units = np.linalg.pinv(shares) * shares.sum(axis=0)[:, None]
    else:
        count, part = connected_components(design.membership.T @ design.membership > 0, directed=False)
        units = np.equal.outer(np.arange(count), part[design.membership.argmax(axis=1)]).astype(np.float64)
    return units


@lru_cache(maxsize=256)
def smallest_effect(error: float, freedom: float) -> float:
    """Minimum detectable effect of a two-sided t test with the power `POWER`, in the unit of `error`.

    That is the standard error times the noncentrality at which t exceeds its critical value that often. The sign flips
    of few objects need more, and so does one test of a family.
    """
    # The square of t is F with one degree of freedom; statsmodels' TTestPower goes astray at fractional freedom.
    critical = stats.f.isf(SIZE, 1, freedom)
    return error * float(optimize.brentq(lambda x: stats.ncf.sf(critical, 1, freedom, x * x) - POWER, 1e-6, 1e3))
