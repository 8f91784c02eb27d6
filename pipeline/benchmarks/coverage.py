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

from pipeline.artifacts import write_text
from pipeline.benchmarks import BenchRow
from pipeline.benchmarks.coverage_methods import (
    ACCURACY,
    DIFFERENCE,
    TESTS,
    Bounds,
    Method,
    Test,
    effective,
    overlapping,
)
from pipeline.benchmarks.simulation import Design
from pipeline.statistics import planned_error, smallest_effect, wilson
from pipeline.statistics.bounds import accuracy_bounds, estimate
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

Verdict = Literal["holds", "conservative", "liberal", ""]


class CoverageRow(BenchRow):
    """A method in a design."""

    kind: Literal["accuracy", "difference", "seeds", "size", "power", "smallest effect"]
    method: str
    reported: bool
    """Whether the reports use it."""
    objects: int
    about: int
    correlation: float
    seeds: int
    truths: tuple[str, ...]
    shares: tuple[float, ...]
    """Covered or, by a test, rejected: one a truth."""
    verdict: tuple[Verdict, ...]
    """Whether that is 93 to 97 %, or of equal settings 5 %, as far as the repetitions can tell; empty for power."""
    repetitions: int


def measure(root: Path, repetitions: int = REPETITIONS, objects: Sequence[int] = OBJECTS) -> list[CoverageRow]:
    """Simulate all designs and write reports/bench/coverage.md beside the rows that are returned."""
    rows: list[CoverageRow] = []
    for count, about, correlation in itertools.product(objects, ABOUT, CORRELATIONS):
        design = Design(count, about, correlation)
        rows += _accuracies(design, repetitions) + _differences(design, repetitions) + _runs(design, repetitions)
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
    kind: Literal["accuracy", "difference", "seeds"],
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


def verdict(share: float, repetitions: int, low: float, high: float) -> Verdict:
    """Whether a share lies in a range, or above or below it, as far as its Monte Carlo error can tell."""
    spread = wilson(share * repetitions, repetitions)
    if spread.high < low:
        return "liberal"
    return "conservative" if spread.low > high else "holds"


def _case(kind: str, method: str, design: Design, seeds: int) -> str:
    runs = f", {seeds} seeds" if kind == "seeds" else ""
    return f"{kind}, {method}, {design.objects} objects, {design.about} a question, r {design.correlation:g}{runs}"


def table(rows: Sequence[CoverageRow]) -> str:
    """The rows as a page: first where the reported intervals and tests do not hold, then everything."""
    short, wide = (
        [f"- {r.case}: {named}" for r in rows if r.reported and (named := _shares(r, judged))]
        for judged in ("liberal", "conservative")
    )
    lines = [
        "# Coverage of intervals, size and power of tests",
        "",
        f"Simulated, {max(r.repetitions for r in rows)} repetitions a design (seeds: half), so that 95 % is known to "
        "about a point. In percent. *r* is the correlation within objects before answers are cut into right and "
        "wrong. **Bold**: below 93 % covered, or of equal settings more than 7 % rejected, beyond Monte Carlo error; "
        "*italic*: above 97 %, or fewer than 3 %. Truths are accuracies; of differences, the two accuracies. With "
        "*seeds* the truth is over all runs, so that one run cannot cover it. The smallest effect is what a plan of 5 "
        "questions an object should find in 80 of 100 repetitions.",
        "",
        "## Where what the reports use falls short",
        "",
        *(short or ["Nowhere."]),
        "",
        "## Where it covers more, or rejects less, than it says",
        "",
        *(wide or ["Nowhere."]),
    ]
    for kind in dict.fromkeys(r.kind for r in rows):
        chosen = [r for r in rows if r.kind == kind]
        widest = max((r.truths for r in chosen), key=len)
        heads = ("",) if kind == "smallest effect" else widest
        columns = ["Method", "Objects", "A question", "r", *(["Seeds"] if kind == "seeds" else []), *heads]
        lines += [
            "",
            f"## {kind.capitalize()}",
            "",
            f"| {' | '.join([*columns, 'Width'])} |",
            "|---" * len(columns) + "|---|",
        ]
        for row in chosen:
            seeds = [str(row.seeds)] if kind == "seeds" else []
            name = f"{row.method} (reported)" if row.reported else row.method
            shares = _marked(row) if kind != "smallest effect" else [f"{row.truths[0]}: {_marked(row)[0]}"]
            width = f"{row.cost:.2f}" if row.cost else ""
            cells = [name, str(row.objects), str(row.about), f"{row.correlation:g}", *seeds, *shares, width]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _shares(row: CoverageRow, judged: str) -> str:
    pairs = zip(row.truths, row.shares, row.verdict, strict=True)
    return ", ".join(f"{100 * share:.1f} % at {truth}" for truth, share, found in pairs if found == judged)


def _marked(row: CoverageRow) -> list[str]:
    marks = {"liberal": "**", "conservative": "*"}
    return [
        f"{(mark := marks.get(judged, ''))}{100 * share:.1f}{mark}"
        for share, judged in zip(row.shares, row.verdict, strict=True)
    ]
