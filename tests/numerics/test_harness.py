"""The check itself on cases whose verdict is known."""

from __future__ import annotations

import math
from contextlib import nullcontext

import numpy as np
import pytest

from tests.numerics.harness import FLOAT32, FLOAT64, UINT8, Check


@pytest.mark.parametrize(
    ("found", "exact", "bound", "error", "right"),
    [
        ([3.0, -8.0], [2.0, -8.0], 0.125, "1.2e-01", True),  # Relative to the largest exact number.
        ([3.0, -8.0], [2.0, -8.0], 0.0, "1.2e-01", False),
        ([0.0, 0.25], 0.0, 0.5, "2.5e-01", True),  # Absolute, where all is 0.
        ([np.nextafter(1.5, 2)], [1.0], 0.5, "5.0e-01", False),
        ([1.0, math.nan], [1.0, 1.0], 9.0, "", False),
        ([1.0, -math.inf], None, None, "", False),
        ([1.0], None, None, "", True),
    ],
)
def test_verdicts(found: list[float], exact: list[float] | None, bound: float | None, error: str, right: bool) -> None:
    check = Check("p", [])
    with nullcontext() if right else pytest.raises(AssertionError, match="c in uint8: (error|not finite)"):
        check("c", UINT8, lambda _: found, bound, exact)
    assert [(row.error, row.verdict) for row in check.rows] == [(error, "pass" if right else "fail")]


def test_without_an_exact_result_formats_are_held_against_float64_of_the_same_shape() -> None:
    results, check = {FLOAT64: [4.0], FLOAT32: [5.0]}, Check("p", [])
    for fmt in (FLOAT64, FLOAT32):
        check("both", fmt, results.__getitem__, 0.25)
    check("float32 alone", FLOAT32, results.__getitem__, 0.25)
    assert [row.error for row in check.rows] == ["", "2.5e-01", "2.5e-01"]
    with pytest.raises(AssertionError):
        check("another shape", UINT8, lambda _: [1.0, 1.0], 0.5, [1.0])
