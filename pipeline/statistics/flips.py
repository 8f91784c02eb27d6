"""The sign-flip test over objects: could the differences as well have gone the other way?

If two settings are equally good, the difference that an object makes is as likely to be d as -d (Fisher 1935; for
clusters Gail, Mark, Carroll, Green, Pee 1996; with few clusters Canay, Romano, Shaikh 2017). All ways to give the
objects signs are looked at, or, with many objects, some that are drawn (Phipson and Smyth 2010 for their p).

For questions about one object, what is flipped is the object's sum of differences. Questions about several have no
such sum: an object's sum takes in what the others do, and flipping these sums as if they were independent finds
differences where there are none, as flipping each question by the product of its objects' signs does (simulated at
5 %, in 18 to 52 % of the comparisons; a test holds that). So the
differences are first split: each is taken as the mean of its objects' effects, which least squares find, and these are
flipped. In the second moment that is right where objects have effects that add up and questions no chance of their
own; a question's own chance counts at least as often as it has objects, since the inverse of a matrix of counts has
no smaller diagonal than the inverses of its diagonal. The test is thus conservative for pairs, and more for triples,
where objects differ little. Where the questions cannot tell the objects apart, what hangs together by questions is
flipped as a whole, which is safe as well.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np

from pipeline.statistics.clusters import Clusters, Values

MOST_FLIPPED = 15
"""Up to so many units all signs are gone through (13: 16 384 that differ); beyond, some are drawn."""
DRAWS = 10_000
ROUNDING = 1e-9


@lru_cache(maxsize=32)
def flip_units(clusters: Clusters) -> Values:
    """Units x questions: what each unit that is flipped takes of each question's difference; columns sum to 1 in total.

    Units are objects, or connected parts of the design where questions cannot tell the objects apart.
    """
    shares = clusters.membership / clusters.membership.sum(axis=1, keepdims=True)
    if np.linalg.matrix_rank(shares) == clusters.objects:
        # The shares of a question sum to 1, so fitted and measured differences have the same sum.
        units: Values = np.linalg.pinv(shares) * shares.sum(axis=0)[:, None]
        return units
    return _connected(clusters.membership)


def least_p(units: int) -> float:
    """The smallest p that so many units can give: 2 / 2^units, with seven 2/128; by draws 1 / (draws + 1)."""
    return 2 / 2**units if units <= MOST_FLIPPED else 1 / (DRAWS + 1)


def sign_flip(values: Values, clusters: Clusters, seed: int = 0, draws: int = DRAWS) -> Values:
    """Two-sided p of the mean of paired differences.

    Simulated (reports/bench/coverage.md), it rejects at 5 %: with seven objects in up to 1.5 % for questions about one
    and 3 % about several; with sixty in 2 to 4 %, but nearly never where questions are about several objects that do
    not differ.

    Args:
        values: (..., questions), differences.
        clusters: The questions' objects.
        seed: Of the signs, where they are drawn.
        draws: How many, there.

    Returns:
        (...), above 0 and at most 1.
    """
    units = flip_units(clusters)
    parts = values @ units.T
    signs, exact = _signs(len(units), seed, draws)
    measured = np.abs(parts.sum(axis=-1, keepdims=True))
    size = np.abs(values).sum(axis=-1, keepdims=True)
    as_far = (np.abs(parts @ signs.T) >= measured - ROUNDING * size).sum(axis=-1)
    p: Values = as_far / len(signs) if exact else (as_far + 1) / (len(signs) + 1)
    return p


@lru_cache(maxsize=8)
def _signs(units: int, seed: int, draws: int) -> tuple[Values, bool]:
    """Ways x units of 1 and -1, and whether these are all; the first unit keeps its sign, as only sizes matter."""
    if units <= MOST_FLIPPED:
        ways = list(itertools.product((1.0, -1.0), repeat=units - 1))
        return np.array([(1.0, *way) for way in ways]), True
    return np.random.default_rng(seed).choice([-1.0, 1.0], size=(draws, units)), False


def _connected(membership: Values) -> Values:
    """Parts x questions: 1 where the question is in the part; objects in a question together are in one part."""
    from scipy.sparse.csgraph import connected_components

    count, part = connected_components(membership.T @ membership > 0, directed=False)
    first = part[membership.argmax(axis=1)]
    parts: Values = np.equal.outer(np.arange(count), first).astype(np.float64)
    return parts
