"""The check itself on cases whose verdict is known, the bounds of networks, and the table."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn

from tests.numerics.bounds import CHANGE, magnification
from tests.numerics.harness import FLOAT32, FLOAT64, UINT8, Check, table


@pytest.fixture
def alone() -> Check:
    """A check whose rows are not the session's."""
    return Check("p", [])


@pytest.mark.parametrize(
    ("found", "exact", "bound", "error", "verdict"),
    [
        ([3.0, -8.0], [2.0, -8.0], 0.125, "1.2e-01", "pass"),  # Relative to the largest exact number.
        ([3.0, -8.0], [2.0, -8.0], 0.0, "1.2e-01", "fail"),
        ([0.0, 0.25], 0.0, 0.5, "2.5e-01", "pass"),  # Absolute, where all is 0.
        ([1.5], [1.0], 0.5, "5.0e-01", "pass"),
        ([np.nextafter(1.5, 2)], [1.0], 0.5, "5.0e-01", "fail"),
        ([1.0, math.nan], [1.0, 1.0], 9.0, "", "fail"),
        ([1.0, -math.inf], None, None, "", "fail"),
        ([1.0], None, None, "", "pass"),
        ([], [], 0.0, "0", "pass"),
    ],
)
def test_verdicts(
    alone: Check, found: list[float], exact: list[float] | None, bound: float | None, error: str, verdict: str
) -> None:
    if verdict == "pass":
        alone("c", UINT8, lambda _: found, bound, exact)
    else:
        with pytest.raises(AssertionError, match="c in uint8: (error|not finite)"):
            alone("c", UINT8, lambda _: found, bound, exact)
    (row,) = alone.rows
    assert (row.error, row.verdict, row.finite) == (error, verdict, bool(np.isfinite(found).all()))


def test_without_an_exact_result_formats_are_held_against_float64(alone: Check) -> None:
    results = {FLOAT64: [4.0], FLOAT32: [5.0]}
    for fmt in (FLOAT64, FLOAT32):
        alone("both", fmt, results.__getitem__, 0.25)
    alone("float32 alone", FLOAT32, results.__getitem__, 0.25)
    assert [(r.format, r.error, r.bound) for r in alone.rows] == [
        ("float64", "", ""),
        ("float32", "2.5e-01", "2.5e-01"),
        ("float32", "2.5e-01", "2.5e-01"),
    ]
    assert [(r["case"], r["format"]) for r in table(alone.rows[::-1])] == [
        ("both", "float64"),
        ("both", "float32"),
        ("float32 alone", "float32"),
    ]


def test_another_shape_or_a_name_twice_is_no_comparison(alone: Check) -> None:
    with pytest.raises(AssertionError):
        alone("c", UINT8, lambda _: [1.0, 1.0], 0.5, [1.0])
    alone("d", UINT8, lambda _: 1.0)
    with pytest.raises(AssertionError, match="d: twice"):
        alone("d", UINT8, lambda _: 1.0)


def test_magnification_is_the_condition_number_of_a_single_weight() -> None:
    """w^8 changes eight times as much as w; and the weight is what it was."""
    layer = nn.Linear(1, 1, bias=False).double()
    nn.init.constant_(layer.weight, 1.25)
    draw = torch.Generator().manual_seed(0)
    largest = max(abs(torch.randn(1, 1, generator=draw, dtype=torch.float64).item()) for _ in range(3))
    assert magnification(layer, lambda: layer.weight**8) == pytest.approx(8 * largest, rel=10 * CHANGE)
    assert layer.weight.item() == 1.25
