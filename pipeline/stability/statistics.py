"""Statistics at their edges: none or all right, one question, one object, all alike, p at both ends, raters that agree.

All of it is float64. What it is held against is the closed form of the special case, in whole numbers, fractions or
decimals; where a special function of scipy's takes part, the bound is the agreement asked of it, 1e-12.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal, localcontext
from functools import partial

import numpy as np

from pipeline.stability.case import DOUBLE, Bound, Case, Dtype, Floats, exactly, within
from pipeline.statistics import (
    Answer,
    Interval,
    Outcome,
    clustered,
    holm,
    icc3k,
    icc3k_interval,
    mcnemar,
    over_seeds,
    paired,
    quadratic_kappa,
    resampled,
    wilson,
)

PART = "statistics"
Z = Decimal("1.959963984540054235524594430520551527955550")
"""The normal quantile of .975."""
AGREED = within(1e-12, "use: agreement with the closed form to 1e-12, where a special function takes part")
TRUE = exactly("use: the closed form, which floating point holds")
COUNTS = ((0, 1), (1, 1), (0, 10**6), (10**6, 10**6), (1, 10**6))
"""Right answers, of how many."""
FLIPPED = (2, 7, 15)
"""Objects that all differ the same way: 2 / 2^n is the smallest p."""
SHIFT = 2.0**26
"""Added to all ratings: their squares are no longer whole in a double."""
CLASSIC = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
"""Shrout and Fleiss 1979, table 2."""


def cases() -> list[Case]:
    """Proportions, comparisons, agreement and seeds."""
    return [*_proportions(), *_comparisons(), *_adjusted(), *_agreement(), *_seeds()]


def about(values: Sequence[float], objects: int) -> list[Outcome]:
    """Questions with these outcomes, each about one object, which go by turns."""
    return [Outcome(value, (f"o{i % objects}",)) for i, value in enumerate(values)]


def _case(name: str, compute: Callable[[], object], bound: Bound, exact: object) -> Case:
    """A figure, an interval (both ends) or several of them; what is None where a figure ought to be is no number."""

    def result(_: Dtype) -> Floats:
        return np.array(list(_numbers(compute())))

    def expected() -> Floats:
        return np.array(list(_numbers(exact)))

    return Case(PART, name, DOUBLE, result, bound, expected)


def _numbers(found: object) -> Iterator[float]:
    if isinstance(found, Interval):
        yield from (found.low, found.high)
    elif isinstance(found, (tuple, list)):
        for part in found:
            yield from _numbers(part)
    else:
        yield float(found) if isinstance(found, (int, float)) else math.nan


def _undefined(*computations: Callable[[], object]) -> list[bool]:
    """Whether there is rightly no figure, one by one."""
    return [compute() is None for compute in computations]


# Proportions


def _proportions() -> Iterator[Case]:
    for k, n in COUNTS:
        yield _case(f"Wilson, {k} of {n}", partial(wilson, k, n), AGREED, _wilson(k, n))
    for name, outcomes in (("one question", about([1], 1)), ("one object", about([1, 0] * 9, 1))):
        yield _case(
            f"{name}: no interval over objects",
            partial(_undefined, partial(clustered, outcomes), partial(resampled, outcomes)),
            TRUE,
            [1, 1],
        )
    for value in (0.0, 1.0):
        alike, name = about([value] * 21, 7), f"seven objects, all answers {value:g}"
        yield _case(f"{name}: interval over objects", partial(clustered, alike), AGREED, _all_alike(value, 7))
        yield _case(f"{name}: objects drawn anew", partial(resampled, alike), AGREED, [value, value])


def _wilson(k: int, n: int) -> Interval:
    """(p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n) (Wilson 1927), in 50 decimals."""
    with localcontext() as context:
        context.prec = 50
        share, count = Decimal(k) / n, Decimal(n)
        half = Z * (share * (1 - share) / count + Z * Z / (4 * count * count)).sqrt()
        centre, under = share + Z * Z / (2 * count), 1 + Z * Z / count
        return Interval(float((centre - half) / under), float((centre + half) / under))


def _all_alike(value: float, objects: int) -> Interval:
    """Wilson's with as many questions as objects and Student's t: 0 to t^2 / (n + t^2), or the mirror image of it."""
    from scipy.stats import t

    square = float(t.ppf(0.975, objects - 1)) ** 2
    width = square / (objects + square)
    return Interval(0.0, width) if value == 0 else Interval(1 - width, 1.0)


# Comparisons


def _comparisons() -> Iterator[Case]:
    for n in (1, 2, 50, 1000):
        yield _case(f"McNemar, {n} to none", partial(mcnemar, [1.0] * n), AGREED, min(1.0, 2 * 0.5**n))
    yield _case("McNemar, none discordant", partial(mcnemar, [0.0] * 9), TRUE, 1.0)
    for objects in FLIPPED:
        gains, least = about([1.0] * (3 * objects), objects), 2 / 2**objects
        yield _case(
            f"sign flips, {objects} objects all better: p, and the smallest", partial(_p, gains), TRUE, [least] * 2
        )
    for name, values, p in (
        ("none differs", [0.0] * 21, 1.0),
        ("as often better as worse", [1.0, -1.0] * 14, 1.0),
        ("differences of 1e-300", [1e-300 * (1 + i % 2) for i in range(21)], 2 / 2**7),
    ):
        yield _case(f"sign flips, {name}: p, and the smallest", partial(_p, about(values, 7)), TRUE, [p, 2 / 2**7])
    for value in (-1.0, 0.0, 1.0):
        yield _case(
            f"differences that are all {value:g}: the interval has a width, holds them and ends at -1 and 1",
            partial(_holds, about([value] * 21, 7), value),
            TRUE,
            True,
        )
    one = about([1.0] * 5, 1)
    yield _case(
        "a comparison about one object: no p, no interval",
        partial(_undefined, lambda: paired(one).p, lambda: paired(one).interval),
        TRUE,
        [1, 1],
    )


def _p(gains: Sequence[Outcome]) -> list[float | None]:
    found = paired(gains)
    return [found.p, found.least]


def _holds(gains: Sequence[Outcome], value: float) -> bool | None:
    found = paired(gains).interval
    return None if found is None else -1 <= found.low <= value <= found.high <= 1 and found.low < found.high


def _adjusted() -> Iterator[Case]:
    for name, ps, expected in (
        ("0 and 1", (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)),
        ("ties", (0.25, 0.25, 0.25), (0.75, 0.75, 0.75)),
        ("smallest numbers", (5e-324, 1.0), (1e-323, 1.0)),
        ("one test", (0.5,), (0.5,)),
        ("none", (), ()),
    ):
        yield _case(f"Holm, {name}", partial(holm, ps), TRUE, expected)


# Agreement


def _agreement() -> Iterator[Case]:
    raters = [[float(i)] * 3 for i in range(4)]
    yield _case(
        "ICC, raters that agree: with its interval", lambda: [icc3k(raters), icc3k_interval(raters)], AGREED, [1] * 3
    )
    nothing: list[list[float]] = []
    for name, ratings in (
        ("all alike", [[2.0] * 3] * 4),
        ("one rater", [[0.0], [1.0]]),
        ("one target", [[0.0, 1.0]]),
        ("nothing", nothing),
    ):
        yield _case(
            f"ICC, {name}: undefined",
            partial(_undefined, partial(icc3k, ratings), partial(icc3k_interval, ratings)),
            TRUE,
            [1, 1],
        )
    moved = [[SHIFT + r for r in row] for row in CLASSIC]
    yield _case(
        f"ICC, {SHIFT:g} added to all ratings",
        partial(icc3k, moved),
        Bound(
            lambda d: 2 * SHIFT * d.roundoff * len(moved) * len(moved[0]),
            "roundings: means of large numbers, off by u times their size, as often as there are ratings, which differ "
            "by 1 and more; the shift itself changes nothing",
        ),
        icc3k(CLASSIC),
    )
    for name, pairs, kappa in (
        ("equal", [(i % 3, i % 3) for i in range(9)], 1.0),
        ("opposite", [(0, 2), (2, 0)], -1.0),
        ("independent", list(itertools.product(range(3), repeat=2)), 0.0),
    ):
        expected, predicted = [a for a, _ in pairs], [b for _, b in pairs]
        yield _case(f"kappa, {name}", partial(quadratic_kappa, expected, predicted, 3), AGREED, kappa)
    alone = partial(quadratic_kappa, [1] * 5, [1] * 5, 3)
    yield _case("kappa, a single class: undefined", partial(_undefined, alone), TRUE, 1)


# Seeds


def _seeds() -> Iterator[Case]:
    for name, seeds, value in (("one seed", 1, 1.0), ("three seeds, all right", 3, 1.0), ("all wrong", 3, 0.0)):
        answers = [Answer(f"q{q}", s, value, (f"o{q % 7}",)) for s in range(seeds) for q in range(21)]
        yield _case(f"over seeds, {name}: interval", partial(_over_seeds, answers), AGREED, _all_alike(value, 7))


def _over_seeds(answers: Sequence[Answer]) -> Interval | None:
    return over_seeds(answers).interval
