"""What is missing on the page, and why: the notes of empty cells, figures not drawn, tables that nobody wrote."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pipeline.review.folders import Bench, Report
from pipeline.review.known import ACCURACIES
from pipeline.review.themes import EVERYWHERE, EXPECTED, NO_GATE, NO_SAMPLES, Expected
from pipeline.review.traced import Grid, Piece, lookup


@dataclass(frozen=True)
class Gap:
    """One thing that is not there."""

    where: str
    what: tuple[Piece, ...]
    why: Piece


def gaps(reports: Sequence[Report], benches: Iterable[Bench], found: Iterable[str]) -> list[Gap]:
    """All of them, report by report.

    Args:
        found: Names of the tables over all reports that are there.
    """
    every = [gap for report in reports for gap in _of_report(report)]
    every += [
        Gap("speed", (Piece(f"Section {b.name}"),), Piece("its run measured nothing")) for b in benches if not b.grid
    ]
    there = set(found)
    return every + [Gap("all reports", (Piece(e.title),), Piece(e.reason)) for e in EVERYWHERE if e.name not in there]


def _of_report(report: Report) -> list[Gap]:
    found = []
    for name in ACCURACIES:
        if grid := report.table(name):
            found += [Gap(report.name, what, why) for what, why in _empty_cells(report, name, grid)]
    found += [
        Gap(report.name, (Piece(s.title),), Piece(s.missing, f"{report.file(s.told)}#"))
        for s in report.readme.sections
        if s.missing
    ]
    found += [
        Gap(report.name, (Piece(e.title),), Piece(_reason(report, e))) for e in EXPECTED if not report.table(e.name)
    ]
    if not report.samples:
        found.append(Gap(report.name, (Piece("Sample answers"),), Piece(NO_SAMPLES)))
    ablation = report.table("ablation")
    if ablation is None or not any(ablation.value(row, "gate") for row in range(len(ablation.rows))):
        found.append(Gap(report.name, (Piece("Gate marks"),), Piece(NO_GATE)))
    return found


def _reason(report: Report, table: Expected) -> str:
    # One training is no comparison, one contestant or counterfactual is.
    least = 2 if table.name == "effects" else 1
    asked = bool(table.wanted) and len(lookup(report.params, table.wanted) or ()) >= least
    return table.due if asked else table.reason


def _empty_cells(report: Report, name: str, grid: Grid) -> list[tuple[tuple[Piece, ...], Piece]]:
    """Rows without a figure by the note that says why."""
    if "note" not in grid.columns:
        return []
    empty = [row for row in range(len(grid.rows)) if not grid.value(row, "value") and grid.value(row, "note")]
    title = next((s.title for s in report.readme.sections if s.name == name), name)
    first = {grid.value(row, "note"): row for row in reversed(empty)}
    return [
        ((Piece(f"{title}, rows: "), grid.where("note", note)), grid.piece(row, "note"))
        for note, row in sorted(first.items(), key=lambda item: item[1])
    ]
