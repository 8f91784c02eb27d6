"""The check itself on cases whose verdict is known, and the condition number of networks."""

from __future__ import annotations

import math
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from torch import nn

from tests.numerics.bounds import CHANGE, magnification
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


def test_magnification_is_the_condition_number_of_a_single_weight() -> None:
    """w^8 changes eight times as much as w; and the weight is what it was."""
    layer = nn.Linear(1, 1, bias=False).double()
    nn.init.constant_(layer.weight, 1.25)
    draw = torch.Generator().manual_seed(0)
    largest = max(abs(torch.randn(1, 1, generator=draw, dtype=torch.float64).item()) for _ in range(3))
    assert magnification(layer, lambda: layer.weight**8) == pytest.approx(8 * largest, rel=10 * CHANGE)
    assert layer.weight.item() == 1.25
