"""Figures at their edges: none or all right, one question, one object, all alike, p at both ends, raters that agree.

All of it is float64. What it is held against is the closed form of the special case, in whole numbers or fractions;
where a special function of scipy's takes part, the bound is the agreement asked of it, 1e-12. What ought to be no
figure at all is None.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from pipeline.evaluation.intervals import Objects, accuracy_interval
from pipeline.evaluation.ordinal import quadratic_kappa
from pipeline.evaluation.paired import Difference, holm, paired, smallest_effect
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
    assert found is not None
    assert 0 <= found.low <= k / n <= found.high <= 1
    square, size = float(stats.t.ppf(0.975, n - 1)) ** 2, n - (0 < k < n)
    ends = np.roots([size + square, -(2 * size * k / n + square), size * (k / n) ** 2])
    check(f"{k} of {n} right: interval", FLOAT64, lambda _: numbers(*found), AGREED, np.sort(ends))


@pytest.mark.parametrize(("questions", "values"), [("one question", [1.0]), ("one object", [1.0, 0.0] * 9)])
def test_what_cannot_show_that_objects_differ_has_no_interval(
    check: Check, questions: str, values: list[float]
) -> None:
    found = compared(values, objects=1)
    nothing = accuracy_interval(np.array(values), by_turns(len(values), 1)), found.low, found.high, found.p
    check(f"{questions}: no interval, no p", FLOAT64, lambda _: [n is None for n in nothing], 0, 1.0)


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
    """At least the normal distribution's 1.96 + 0.84 errors; of no error it is 0."""
    unit = smallest_effect(1.0, freedom)
    assert unit >= (stats.norm.ppf(0.975) + stats.norm.ppf(0.8)) * (1 - 1e-5)
    effects = [smallest_effect(error, freedom) for error in (0.0, 1e-300, 1e300)]
    check(f"smallest effect, {freedom:g} free", FLOAT64, lambda _: effects, AGREED, [0, 1e-300 * unit, 1e300 * unit])


@pytest.mark.parametrize(
    ("name", "ps", "exact"),
    [
        ("0 and 1", (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)),
        ("ties", (0.25, 0.25, 0.25), (0.75, 0.75, 0.75)),
        ("smallest numbers", (5e-324, 1.0), (1e-323, 1.0)),
        ("one test", (0.5,), (0.5,)),
        ("none", (), ()),
    ],
)
def test_holm_at_both_ends(check: Check, name: str, ps: tuple[float, ...], exact: tuple[float, ...]) -> None:
    check(f"Holm, {name}", FLOAT64, lambda _: numbers(*holm(ps)), 0, exact)


def test_raters_that_agree_or_cannot_be_compared(check: Check) -> None:
    """roundings: means of numbers near `SHIFT`, off by u times their size, as often as there are ratings, which differ
    by 1 and more; the shift itself changes nothing."""
    agree = np.arange(4.0)[:, None] + np.zeros(3)
    check(
        "ICC, raters that agree: with its interval", FLOAT64, lambda _: numbers(*(icc3k(agree) or [None])), 0, [1] * 3
    )
    undefined = {
        "all alike": np.full((4, 3), 2.0),
        "one rater": [[0.0], [1.0]],
        "one target": [[0.0, 1.0]],
        "nothing": [],
    }
    for name, ratings in undefined.items():
        check(f"ICC, {name}: undefined", FLOAT64, lambda _, r=ratings: icc3k(r) is None, 0, 1.0)
    classic, bound = icc3k(CLASSIC), 2 * SHIFT * FLOAT64.roundoff * CLASSIC.size
    assert classic is not None
    assert round(classic[0], 2) == 0.91
    check(
        f"ICC, {SHIFT:g} added to all ratings", FLOAT64, lambda _: numbers(*(icc3k(CLASSIC + SHIFT) or [None])), bound,
        classic,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "pairs", "kappa"),
    [
        ("equal", [(i % 3, i % 3) for i in range(9)], 1.0),
        ("opposite", [(0, 2), (2, 0)], -1.0),
        ("independent", list(itertools.product(range(3), repeat=2)), 0.0),
    ],
)
def test_kappa_at_its_ends(check: Check, name: str, pairs: list[tuple[int, int]], kappa: float) -> None:
    expected, predicted = zip(*pairs, strict=True)
    check(f"kappa, {name}", FLOAT64, lambda _: numbers(quadratic_kappa(expected, predicted, 3)), AGREED, [kappa])


def test_kappa_of_a_single_class_is_undefined(check: Check) -> None:
    check("kappa, a single class: undefined", FLOAT64, lambda _: quadratic_kappa([1] * 5, [1] * 5, 3) is None, 0, 1.0)
