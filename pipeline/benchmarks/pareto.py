"""The rows of a section as a plot of cost against error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.benchmarks import BenchRow
from pipeline.speed.pareto import Point, draw_pareto


def draw_rows(rows: Sequence[BenchRow], path: Path, title: str, error: str) -> None:
    """Draw the rows that have an error; what stands before a case's first comma is its group.

    Args:
        rows: One with an error or more, all with one unit.
        path: A PNG.
        title: Above the plot.
        error: What the error is.
    """
    points = [
        Point(row.case.split(",")[0], row.case.split(", ")[-1], row.cost, row.error, row.low, row.high)
        for row in rows
        if row.error is not None
    ]
    draw_pareto(points, path, title, f"cost ({rows[0].unit})", error)
