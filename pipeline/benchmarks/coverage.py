"""Do intervals cover what they say, and do tests reject as often as they say? Simulated, with the truth known.

A row is a method in a design, over several true accuracies. What costs is an interval's mean width, or nothing for a
test; the error is how often the interval misses the truth, the test rejects where nothing differs, or fails to where
something does, at the truth where that is worst, with its Monte Carlo interval.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.io import write_text
from pipeline.benchmarks.coverage_methods import (
    ACCURACY,
    DIFFERENCE,
    TESTS,
    Bounds,
    Method,
    Test,
    adjusted,
    effective,
    overlapping,
)
from pipeline.benchmarks.coverage_table import OVER_SEEDS, CoverageRow, Verdict, table, verdict
from pipeline.benchmarks.simulation import Design
from pipeline.statistics import planned_error, smallest_effect, wilson
from pipeline.statistics.bounds import accuracy_bounds, difference_bounds, estimate
from pipeline.statistics.clusters import Values
from pipeline.statistics.seeds import crossed

REPETITIONS = 2000
OBJECTS = (7, 20, 60)
ABOUT = (1, 2, 3)
CORRELATIONS = (0.0, 0.3, 0.7)
TRUTHS = (0.05, 0.3, 0.5, 0.8, 0.97)
EQUAL = ((0.5, 0.5), (0.8, 0.8), (0.97, 0.97))
UNEQUAL = ((0.8, 0.5), (0.97, 0.8))
SEEDS = (1, 5)
HOLDS = (0.93, 0.97)
SIZE = 0.05


def measure(root: Path, repetitions: int = REPETITIONS, objects: Sequence[int] = OBJECTS) -> list[CoverageRow]:
    """Simulate all designs and write reports/bench/coverage.md beside the rows that are returned."""
    rows: list[CoverageRow] = []
    for count, about, correlation in itertools.product(objects, ABOUT, CORRELATIONS):
        design = Design(count, about, correlation)
        rows += _accuracies(design, repetitions) + _differences(design, repetitions)
        rows += _runs(design, repetitions) + _run_differences(design, repetitions)
    rows += [row for count in objects for row in _smallest_effects(count, repetitions)]
    write_text(root / "reports" / "bench" / "coverage.md", table(rows))
    return rows


def _accuracies(design: Design, repetitions: int) -> list[CoverageRow]:
    values = design.answers(TRUTHS, repetitions)
    found = [(m, [m.bounds(v, design) for v in values]) for m in ACCURACY]
    return _intervals("accuracy", design, found, TRUTHS, [f"{t:g}" for t in TRUTHS])


def _differences(design: Design, repetitions: int) -> list[CoverageRow]:
    pairs = (*EQUAL, *UNEQUAL)
    values = design.differences(pairs, repetitions)
    found = [(m, [m.bounds(v, design) for v in values]) for m in DIFFERENCE]
    named = [f"{a:g} - {b:g}" for a, b in pairs]
    rows = _intervals("difference", design, found, [a - b for a, b in pairs], named)
    rejected = [(t, [float((t.p(v, design) <= SIZE).mean()) for v in values]) for t in TESTS]
    split = len(EQUAL)
    rows += [_test("size", t, design, named[:split], r[:split], repetitions) for t, r in rejected]
    rows += [_test("power", t, design, named[split:], r[split:], repetitions) for t, r in rejected]
    return rows


def _runs(design: Design, repetitions: int) -> list[CoverageRow]:
    """Intervals for the accuracy over other objects and other runs, from one run and from five."""
    clusters, rows = design.clusters(), []
    # Many answers a repetition: a part of the repetitions at a time would hold no less.
    truths, fewer = (0.5, 0.8), max(1, repetitions // 2)
    for seeds in SEEDS:
        values = design.runs(truths, seeds, fewer)
        alone = [accuracy_bounds(estimate(v.mean(axis=1), clusters), clusters) for v in values]
        both = [accuracy_bounds(crossed(v, clusters), clusters) for v in values]
        found = [(Method("objects alone", effective), alone)]
        if seeds > 1:
            found.append((Method("objects and seeds", effective, reported=True), both))
        rows += _intervals("seeds", design, found, truths, [f"{t:g}" for t in truths], seeds)
    return rows


def _run_differences(design: Design, repetitions: int) -> list[CoverageRow]:
    """Intervals for the difference over other objects and other runs, from five runs of both settings."""
    clusters, pairs, seeds = design.clusters(), (*EQUAL, *UNEQUAL), SEEDS[-1]
    values = design.run_differences(pairs, seeds, max(1, repetitions // 2))
    alone = [difference_bounds(estimate(v.mean(axis=1), clusters), clusters) for v in values]
    both = [difference_bounds(crossed(v, clusters), clusters) for v in values]
    found = [
        (Method("objects alone", adjusted), alone),
        (Method("objects and seeds", adjusted, reported=True), both),
    ]
    named = [f"{a:g} - {b:g}" for a, b in pairs]
    return _intervals("difference over seeds", design, found, [a - b for a, b in pairs], named, seeds)


def _smallest_effects(objects: int, repetitions: int) -> list[CoverageRow]:
    """How often the smallest effect of a plan is found, with normal differences: 80 % is what it says."""
    between, within, design = 0.15, 0.6, Design(objects, 1, 0)
    questions = len(design.questions()) // objects
    effect = smallest_effect(planned_error(objects, questions, between, within), objects)
    rng = design.generator("smallest effect")
    own = rng.normal(effect, between, (repetitions, objects)) @ design.clusters().membership.T
    values = own + rng.normal(0, within, own.shape)

    def student(values: Values, design: Design) -> Values:
        low, high = overlapping(values, design)
        return ((low <= 0) & (high >= 0)).astype(np.float64)

    tests = (Test("t over objects", student), TESTS[-1])
    shares = [float((t.p(values, design) <= SIZE).mean()) for t in tests]
    named = f"{effect:.3f}"
    return [_test("smallest effect", t, design, [named], [s], repetitions) for t, s in zip(tests, shares, strict=True)]


def _intervals(
    kind: Literal["accuracy", "difference", "seeds", "difference over seeds"],
    design: Design,
    found: Sequence[tuple[Method, Sequence[Bounds]]],
    truths: Sequence[float],
    named: Sequence[str],
    seeds: int = 1,
) -> list[CoverageRow]:
    rows: list[CoverageRow] = []
    for method, bounds in found:
        shares = [
            float(((low <= truth + 1e-9) & (high >= truth - 1e-9)).mean())
            for truth, (low, high) in zip(truths, bounds, strict=True)
        ]
        repetitions = len(bounds[0][0])
        width = float(np.mean([high - low for low, high in bounds]))
        # Of coverages as far from 95 %, the lower is the worse.
        worst = max(shares, key=lambda s: (abs(s - 0.95), -s))
        spread = wilson((1 - worst) * repetitions, repetitions)
        base = rows[0].cost if rows else width
        rows.append(
            CoverageRow(
                case=_case(kind, method.name, design, seeds),
                cost=round(width, 4),
                unit="mean width",
                baseline=_case(kind, found[0][0].name, design, seeds),
                ratio=round(width / base, 3),
                error=round(1 - worst, 4),
                low=round(spread.low, 4),
                high=round(spread.high, 4),
                kind=kind,
                method=method.name,
                reported=method.reported,
                objects=design.objects,
                about=design.about,
                correlation=design.correlation,
                seeds=seeds,
                truths=tuple(named),
                shares=tuple(round(s, 4) for s in shares),
                verdict=tuple(verdict(s, repetitions, *HOLDS) for s in shares),
                repetitions=repetitions,
            )
        )
    return rows


def _test(
    kind: Literal["size", "power", "smallest effect"],
    test: Test,
    design: Design,
    named: Sequence[str],
    shares: Sequence[float],
    repetitions: int,
) -> CoverageRow:
    worst = max(shares) if kind == "size" else 1 - min(shares)
    spread = wilson(worst * repetitions, repetitions)
    case = _case(kind, test.name, design, 1)
    # A test that rejects too seldom is conservative, as an interval that covers too much.
    judged: list[Verdict] = [verdict(1 - s, repetitions, *HOLDS) if kind == "size" else "" for s in shares]
    return CoverageRow(
        case=case,
        cost=0,
        unit="mean width",
        baseline=case,
        ratio=0,
        error=round(worst, 4),
        low=round(spread.low, 4),
        high=round(spread.high, 4),
        kind=kind,
        method=test.name,
        reported=test.reported,
        objects=design.objects,
        about=design.about,
        correlation=design.correlation,
        seeds=1,
        truths=tuple(named),
        shares=tuple(round(s, 4) for s in shares),
        verdict=tuple(judged),
        repetitions=repetitions,
    )


def _case(kind: str, method: str, design: Design, seeds: int) -> str:
    runs = f", {seeds} seeds" if kind in OVER_SEEDS else ""
    return f"{kind}, {method}, {design.objects} objects, {design.about} a question, r {design.correlation:g}{runs}"
