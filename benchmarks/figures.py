"""One figure a question: cost against error with the Pareto front, or costs alone where all compute the same."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.table import Row
from pipeline.core.io import atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOLDER = "speed_error"


def draw(rows: Sequence[Row], reports: Path) -> list[Path]:
    """Draw every question of the table into a folder of reports/; figures of questions that are gone are deleted.

    Equal rows give equal bytes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = []
    for question in dict.fromkeys(row.question for row in rows):
        own = [row for row in rows if row.question == question]
        measured = [row for row in own if row.error is not None]
        figure = Figure(figsize=(9, 6 if measured else 1.5 + 0.4 * len(own)), dpi=100, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        base = next((row.setting for row in own if row.cost_ratio == 1), "")
        axes.set_title(question, pad=18)
        axes.set_xlabel(f"cost ({own[0].unit}), times that of: {base}")
        if measured:
            _trade(axes, measured)
        else:
            bars = axes.barh([row.setting for row in own], [row.cost_ratio for row in own], color="C0")
            axes.bar_label(bars, [f" {row.cost_ratio:.3g}" for row in own])
            axes.invert_yaxis()
            axes.margins(x=0.12)
        path = reports / FOLDER / f"{re.sub(r'[^a-z0-9]+', '-', question.lower()).strip('-')}.png"
        with atomic(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})
        drawn.append(path)
    for stale in {*(reports / FOLDER).glob("*.png")} - {*drawn}:
        stale.unlink()
    return drawn


def _trade(axes: Axes, rows: Sequence[Row]) -> None:
    """Points by number; the legend names them, those of the front in front."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    axes.set_ylabel("error")
    axes.text(0.5, 1.005, f"error: {rows[0].error_of}", transform=axes.transAxes, ha="center", fontsize=8)
    errors = [row.error or 0.0 for row in rows]
    if 0 < 20 * min(errors) < max(errors):
        axes.set_yscale("log")
    for number, row in enumerate(sorted(rows, key=lambda row: (not row.front, row.cost_ratio)), 1):
        error = row.error or 0.0
        low, high = (error if end is None else end for end in (row.low, row.high))
        axes.errorbar(
            row.cost_ratio,
            error,
            [[max(error - low, 0)], [max(high - error, 0)]],
            marker=f"${number}$",
            linestyle="",
            markersize=5 + 4 * len(str(number)),
            color=f"C{(number - 1) % 10}",
            elinewidth=0.6,
            label=row.setting,
        )
    ahead = sorted((row for row in rows if row.front), key=lambda row: row.cost_ratio)
    axes.plot([r.cost_ratio for r in ahead], [r.error or 0.0 for r in ahead], "k-", linewidth=1, label="Pareto front")
    axes.figure.legend(loc="outside right upper", fontsize=8)
    axes.margins(0.12)
    axes.grid(alpha=0.3)
    ratios = [row.cost_ratio for row in rows]
    if max(ratios) > 4 * min(ratios) > 0:  # What costs nothing has no place on a logarithmic axis.
        axes.set_xscale("log", subs=[])
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if max(ratios) < 100 * min(ratios) else (1,)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda ratio, _: f"{ratio:g}"))
