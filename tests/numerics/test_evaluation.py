"""Figures at their edges: none or all right, all alike, p at its smallest, errors of any size, far-off ratings.

All of it is float64, held against the closed form of the special case, in whole numbers or fractions. Where a special
function of scipy's takes part, the bound is the agreement asked of it, 1e-12.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from pipeline.evaluation.intervals import Objects, accuracy_interval
from pipeline.evaluation.paired import Difference, paired, smallest_effect
from pipeline.videos.audit.labels import icc3k
from tests.numerics.harness import FLOAT64, Check, Floats

PART = "evaluation"
AGREED = 1e-12
"""use: agreement with the closed form, where a special function takes part."""
SHIFT = 2.0**26
"""Added to all ratings: their squares are no longer whole in a double."""
CLASSIC = np.array([[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]])
"""Shrout and Fleiss 1979, table 2; their ICC(3,4) is .91 in two digits."""


def by_turns(questions: int, objects: int) -> list[Objects]:
    """Questions about one object each, which go by turns."""
    return [(f"o{i % objects}",) for i in range(questions)]


def compared(values: Sequence[float], objects: int = 7, seeds: int = 1) -> Difference:
    return paired(np.array([values] * seeds, np.float64), by_turns(len(values), objects))


def numbers(*found: float | None) -> Floats:
    """None is no number and fails where one ought to be."""
    return np.array([np.nan if value is None else value for value in found])


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_answers_that_are_all_alike_have_wilsons_interval_of_objects(check: Check, value: float, seeds: int) -> None:
    """With as many questions as objects and Student's t: 0 to t^2 / (n + t^2), or the mirror image of it."""
    square = float(stats.t.ppf(0.975, 6)) ** 2
    exact = np.array([0, square / (7 + square)])
    answers = np.full((seeds, 21), value).mean(axis=0)
    check(
        f"seven objects, all answers {value:g}, {seeds} seed(s): interval",
        FLOAT64,
        lambda _: numbers(*(accuracy_interval(answers, by_turns(21, 7)) or [None])),
        AGREED,
        1 - exact[::-1] if value else exact,
    )


@pytest.mark.parametrize(("k", "n"), [(0, 10), (10, 10), (1, 1000)])
def test_one_question_an_object_has_wilsons_interval_whose_ends_are_roots(check: Check, k: int, n: int) -> None:
    """(p - x)^2 n = t^2 x (1 - x) at both ends x (Wilson 1927), however lopsided the answers are.

    The sample's variance has n - 1 below it, so that of 1 in 1000 one question fewer counts.
    """
    values = np.arange(n) < k
    found = accuracy_interval(values.astype(np.float64), by_turns(n, n))
    assert 0 <= found.low <= k / n <= found.high <= 1
    square, size = float(stats.t.ppf(0.975, n - 1)) ** 2, n - (0 < k < n)
    ends = np.roots([size + square, -(2 * size * k / n + square), size * (k / n) ** 2])
    check(f"{k} of {n} right: interval", FLOAT64, lambda _: numbers(*found), AGREED, np.sort(ends))


@pytest.mark.parametrize(
    ("name", "values", "objects", "p"),
    [
        *((f"{n} objects all better", [1.0] * 3 * n, n, 2 / 2**n) for n in (2, 7, 15)),
        ("none differs", [0.0] * 21, 7, 1.0),
        ("as often better as worse", [1.0, -1.0] * 14, 7, 1.0),
        ("differences of 1e-300", [1e-300 * (1 + i % 2) for i in range(21)], 7, 2 / 2**7),
    ],
)
def test_sign_flips_reach_both_ends(check: Check, name: str, values: list[float], objects: int, p: float) -> None:
    """Of n objects that all differ the same way 2 / 2^n is the smallest p."""
    check(f"sign flips, {name}: p", FLOAT64, lambda _: numbers(compared(values, objects).p), 0, [p])


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("value", [-1.0, -1e-300, 0.0, 1.0])
def test_differences_that_are_all_alike_have_an_interval_with_a_width(check: Check, value: float, seeds: int) -> None:
    found = compared([value] * 21, seeds=seeds)
    ends = numbers(found.low, found.high)
    assert -1 <= ends[0] <= value <= ends[1] <= 1
    assert ends[0] < ends[1]
    ends = numbers(*ends, found.p, found.smallest_effect)
    check(f"differences that are all {value:g}, {seeds} seed(s): interval, p", FLOAT64, lambda _: ends)


@pytest.mark.parametrize("freedom", [1.0, 6.0, 1e6])
def test_the_smallest_effect_is_proportional_to_its_error(check: Check, freedom: float) -> None:
    """Of no error it is 0."""
    unit = smallest_effect(1.0, freedom)
    effects = [smallest_effect(error, freedom) for error in (0.0, 1e-300, 1e300)]
    check(f"smallest effect, {freedom:g} free", FLOAT64, lambda _: effects, AGREED, [0, 1e-300 * unit, 1e300 * unit])


def test_a_shift_of_all_ratings_changes_no_icc(check: Check) -> None:
    """roundings: means of numbers near `SHIFT`, off by u times their size, as often as there are ratings."""
    classic, bound = icc3k(CLASSIC), 2 * SHIFT * FLOAT64.roundoff * CLASSIC.size
    assert round(classic[0], 2) == 0.91
    name = f"ICC, {SHIFT:g} added to all ratings"
    check(name, FLOAT64, lambda _: numbers(*(icc3k(CLASSIC + SHIFT) or [None])), bound, classic)
