"""The hard cases: no red row; and the judge itself, on cases whose verdict is known."""

from __future__ import annotations

import math
from collections import Counter
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from pipeline.io import read_csv, write_csv
from pipeline.errors import UserError
from pipeline.stability.case import BYTES, NETWORKS, SOLVED, Bound, Case, Dtype, exactly, summing, within
from pipeline.stability.condition import CHANGE, magnification, rounded
from pipeline.stability.record import Judgement, StabilityRow
from pipeline.stability.run import all_cases, available, judge, judge_all, stop_on_red, summary
from tests.closure import ROOT

CASES = all_cases(ROOT / "standins" / "clip", ROOT / "standins" / "llama")
ONE = within(0.5, "use: made up")


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.part}: {case.name}")
def test_no_row_is_red(case: Case) -> None:
    """What the stage does, case by case: this is what fails where a part breaks."""
    rows = judge_all([case])
    assert [row.dtype for row in rows] == [d.value for d in case.dtypes if available(d)]
    assert [row for row in rows if row.verdict is Judgement.FAILED] == [], case.bound and case.bound.why


def test_every_part_has_cases_under_names_of_their_own() -> None:
    parts = {"scenes", "frames", "encoder", "joint decisions", "language model", "loss", "statistics"}
    assert {case.part for case in CASES} == parts
    assert [name for name, count in Counter((c.part, c.name) for c in CASES).items() if count > 1] == []


def test_every_bound_says_what_it_rests_on() -> None:
    kinds = ("roundings: ", "condition: ", "use: ", "the residual bounds ")
    assert [c.name for c in CASES if c.bound and not c.bound.why.startswith(kinds)] == []


def test_formats_are_those_of_torch() -> None:
    for dtype in NETWORKS:
        told = torch.finfo(dtype.torch)
        assert dtype.roundoff == told.eps / 2
        assert dtype.smallest == told.smallest_normal * told.eps


# The judge


def verdicts(case: Case) -> list[tuple[bool, float | None, float | None, str]]:
    return [(r.finite, r.error, r.bound, r.verdict.value) for r in judge(case)]


def test_errors_are_relative_to_the_largest_exact_number() -> None:
    found = {Dtype.FLOAT64: [2.0, -8.0], Dtype.FLOAT32: [3.0, -8.0]}
    case = Case("p", "c", SOLVED, found.__getitem__, Bound(lambda d: 0.125 if d is Dtype.FLOAT32 else 0.0, "use: x"))
    assert verdicts(case) == [(True, None, None, "passed"), (True, 0.12, 0.12, "passed")]
    held = Case("p", "c", SOLVED, found.__getitem__, exactly("use: x"), lambda: [2.0, -8.0])
    assert verdicts(held) == [(True, 0.0, 0.0, "passed"), (True, 0.12, 0.0, "failed")]


def test_where_all_is_0_errors_are_absolute() -> None:
    case = Case("p", "c", BYTES, lambda _: [0.0, 0.25], ONE, lambda: [0.0, 0.0])
    assert verdicts(case) == [(True, 0.25, 0.5, "passed")]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_red_with_a_bound_or_without(value: float) -> None:
    for bound in (ONE, None):
        case = Case("p", "c", BYTES, lambda _: [1.0, value], bound, lambda: [1.0, 1.0])
        assert [(r.finite, r.error, r.verdict) for r in judge(case)] == [(False, None, Judgement.FAILED)]


def test_an_error_that_is_just_too_large_is_red() -> None:
    for found, verdict in ((1.5, "passed"), (np.nextafter(1.5, 2), "failed")):
        case = Case("p", "c", BYTES, lambda _, f=found: f, ONE, lambda: 1.0)  # type: ignore[misc]
        assert [r.verdict.value for r in judge(case)] == [verdict]


def test_a_result_of_another_shape_is_no_comparison() -> None:
    case = Case("p", "c", BYTES, lambda _: [1.0, 2.0], ONE, lambda: [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="shape"):
        judge(case)


def test_nothing_at_all_is_finite_and_right() -> None:
    assert verdicts(Case("p", "c", BYTES, lambda _: [], exactly("use: x"), list)) == [(True, 0.0, 0.0, "passed")]


def test_a_red_row_stops_with_one_line_after_the_table_was_written(tmp_path: Path) -> None:
    rows = judge_all(
        [
            Case("good", "c", BYTES, lambda _: 1.0),
            Case("bad", "far off", BYTES, lambda _: 2.0, ONE, lambda: 1.0),
            Case("bad", "no number", BYTES, lambda _: math.nan),
        ]
    )
    write_csv(tmp_path / "stability.csv", StabilityRow, rows)
    assert read_csv(tmp_path / "stability.csv", StabilityRow) == rows
    assert summary(rows) == {"rows": 3, "red": 2}
    with pytest.raises(UserError) as caught:
        stop_on_red(rows, tmp_path / "stability.csv")
    said = str(caught.value)
    assert said.startswith("bad: far off in uint8: error 1, at most 0.5 (and 1 more); all rows stand in ")
    assert str(tmp_path / "stability.csv") in said
    assert "\n" not in said
    with pytest.raises(UserError, match=r"^bad: no number in uint8: not finite; "):
        stop_on_red(rows[2:], tmp_path)
    stop_on_red(rows[:1], tmp_path)


def test_threads_are_as_they_were() -> None:
    before = torch.get_num_threads()
    seen: list[int] = []
    judge_all([Case("p", "c", BYTES, lambda _: seen.append(torch.get_num_threads()) or 0.0)])  # type: ignore[func-returns-value]
    assert seen == [1]
    assert torch.get_num_threads() == before


# Bounds


@pytest.mark.parametrize("dtype", [Dtype.FLOAT64, Dtype.FLOAT32])
def test_sums_in_the_worst_order_stay_within_their_bound(dtype: Dtype) -> None:
    """One by one, against fractions; large terms first, so that every small one is rounded away in part."""
    rng = np.random.default_rng(0)
    terms = np.sort(rng.lognormal(0, 4, 2000))[::-1].astype(dtype.numpy)
    total = dtype.numpy.type(0)
    for term in terms:
        total += term
    exact = sum(map(Fraction, terms.tolist()), Fraction(0))
    error = abs(Fraction(float(total)) - exact) / exact
    assert 0 < error <= summing(len(terms), dtype)


def test_products_of_16_bits_stay_within_their_bound() -> None:
    draw = torch.Generator().manual_seed(0)
    one, other = (torch.rand(64, 512, generator=draw, dtype=torch.float64) for _ in range(2))
    exact = one @ other.T
    found = (one.bfloat16() @ other.bfloat16().T).double()
    assert ((found - exact).abs() / exact).max() <= summing(512, Dtype.BFLOAT16)


def test_magnification_is_the_condition_number_of_a_single_weight() -> None:
    """w^8 changes eight times as much as w; and the weight is what it was."""
    layer = nn.Linear(1, 1, bias=False).double()
    with torch.no_grad():
        layer.weight.fill_(1.25)
    single = nn.Module()
    single.weight = layer.weight
    draw = torch.Generator().manual_seed(0)
    largest = max(abs(float(torch.randn(1, 1, generator=draw, dtype=torch.float64))) for _ in range(3))
    found = magnification(single, lambda: layer.weight**8)
    assert found == pytest.approx(8 * largest, rel=10 * CHANGE)
    assert layer.weight.item() == 1.25


def test_bounds_of_networks_grow_with_the_roundoff() -> None:
    bounds = [rounded(1.0, 256, dtype) for dtype in (Dtype.FLOAT64, Dtype.FLOAT32, Dtype.FLOAT16, Dtype.BFLOAT16)]
    assert bounds == sorted(bounds)
    assert bounds[0] < 1e-14
    assert bounds[-1] < 0.1
