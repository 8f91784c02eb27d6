"""Figures at their edges: none or all right, p at its smallest, differences next to nothing, far-off ratings.

All of it is float64, held against the closed form of the special case, in whole numbers or fractions.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pipeline.evaluation.intervals import Objects, accuracy_interval
from pipeline.evaluation.paired import paired
from pipeline.videos.audit.labels import icc3k
from tests.numerics.harness import FLOAT64, Check

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


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_answers_that_are_all_alike_have_wilsons_interval_of_objects(check: Check, value: float) -> None:
    """With as many questions as objects and Student's t: 0 to t^2 / (n + t^2), or the mirror image of it."""
    square = float(stats.t.ppf(0.975, 6)) ** 2
    exact = np.array([0, square / (7 + square)])
    name = f"seven objects, all answers {value:g}: interval"
    found = accuracy_interval(np.full(21, value), by_turns(21, 7))
    check(name, FLOAT64, lambda _: found, AGREED, 1 - exact[::-1] if value else exact)


@pytest.mark.parametrize(
    ("name", "values", "objects", "p"),
    [
        *((f"{n} objects all better", [1.0] * 3 * n, n, 2 / 2**n) for n in (2, 7, 15)),
        ("as often better as worse", [1.0, -1.0] * 14, 7, 1.0),
        ("differences of 1e-300", [1e-300 * (1 + i % 2) for i in range(21)], 7, 2 / 2**7),
    ],
)
def test_sign_flips_reach_both_ends(check: Check, name: str, values: list[float], objects: int, p: float) -> None:
    """Of n objects that all differ the same way 2 / 2^n is the smallest p."""
    found = paired(np.array([values]), by_turns(len(values), objects))
    check(f"sign flips, {name}: p", FLOAT64, lambda _: found.p, 0, [p])


def test_a_shift_of_all_ratings_changes_no_icc(check: Check) -> None:
    """roundings: means of numbers near `SHIFT`, off by u times their size, as often as there are ratings."""
    classic, bound = icc3k(CLASSIC), 2 * SHIFT * FLOAT64.roundoff * CLASSIC.size
    assert round(classic[0], 2) == 0.91
    name = f"ICC, {SHIFT:g} added to all ratings"
    check(name, FLOAT64, lambda _: icc3k(CLASSIC + SHIFT), bound, classic)
