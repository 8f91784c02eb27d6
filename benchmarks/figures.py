"""One figure a question: cost against error with the Pareto front, or costs alone where all compute the same."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.table import Row
from pipeline.io import atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOLDER = "speed_error"
OFFSETS = sorted(
    product((-70, -45, -24, 0, 24, 45, 70), (-60, -40, -26, -13, 0, 13, 26, 40, 60)),
    key=lambda o: o[0] ** 2 + 3 * o[1] ** 2,
)
"""Where a name may stand from its point, in points, near ones first."""


def draw(rows: Sequence[Row], reports: Path) -> list[Path]:
    """Draw every question of the table into a folder of reports/; figures of questions that are gone are deleted.

    Equal rows give equal bytes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = []
    for question in dict.fromkeys(row.question for row in rows):
        own = [row for row in rows if row.question == question]
        judged = [row for row in own if row.error is not None]
        figure = Figure(figsize=(9, 6 if judged else 1.5 + 0.4 * len(own)), dpi=100, layout="constrained")
        canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
        base = next((row.setting for row in own if row.cost_ratio == 1), "")
        axes.set_title(question, pad=18)
        axes.set_xlabel(f"cost ({own[0].unit}), times that of: {base}")
        if judged:
            _trade(axes, judged, canvas)
        else:
            _bars(axes, own)
        path = reports / FOLDER / f"{re.sub(r'[^a-z0-9]+', '-', question.lower()).strip('-')}.png"
        with atomic(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})
        drawn.append(path)
    for stale in {*(reports / FOLDER).glob("*.png")} - {*drawn}:
        stale.unlink()
    return drawn


def _bars(axes: Axes, rows: Sequence[Row]) -> None:
    bars = axes.barh([row.setting for row in rows], [row.cost_ratio for row in rows], color="C0")
    axes.bar_label(bars, [f" {row.cost_ratio:.3g}" for row in rows])
    axes.invert_yaxis()
    axes.margins(x=0.12)


def _trade(axes: Axes, rows: Sequence[Row], canvas: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator

    axes.set_ylabel("error")
    axes.text(0.5, 1.005, f"error: {rows[0].error_of}", transform=axes.transAxes, ha="center", fontsize=8)
    errors = [row.error or 0.0 for row in rows]
    if 0 < 20 * min(errors) < max(errors):
        axes.set_yscale("log")
    groups = list(dict.fromkeys(row.setting.split(",")[0] for row in rows))
    for row in rows:
        error = row.error or 0.0
        spread = (
            None if row.low is None or row.high is None else [[max(error - row.low, 0)], [max(row.high - error, 0)]]
        )
        colour = f"C{groups.index(row.setting.split(',')[0]) % 10}"
        axes.errorbar(row.cost_ratio, error, spread, fmt="o", color=colour, capsize=2, elinewidth=0.6, alpha=0.8)
    ahead = sorted((row for row in rows if row.front), key=lambda row: row.cost_ratio)
    axes.plot([r.cost_ratio for r in ahead], [r.error or 0.0 for r in ahead], "k-", linewidth=1, label="Pareto front")
    axes.legend(loc="best", fontsize=8)
    axes.margins(0.12)
    axes.grid(alpha=0.3)
    ratios = [row.cost_ratio for row in rows]
    if max(ratios) > 4 * min(ratios):
        axes.set_xscale("log", subs=[])
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if max(ratios) < 100 * min(ratios) else (1,)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda ratio, _: f"{ratio:g}"))
    canvas.draw()
    _names(axes, rows)


def _names(axes: Axes, rows: Sequence[Row]) -> None:
    """A name beside each point, those of the front bold, where it covers the least of the others."""
    from matplotlib.transforms import Bbox

    taken: list[Any] = []
    for row in rows:
        x, y = axes.transData.transform((row.cost_ratio, row.error or 0.0))
        taken.append(Bbox.from_bounds(x - 5, y - 5, 10, 10))
    frame = axes.get_window_extent()
    for row in sorted(rows, key=lambda row: not row.front):
        label = axes.annotate(
            row.setting,
            (row.cost_ratio, row.error or 0.0),
            (0, 0),
            textcoords="offset points",
            fontsize=7,
            ha="center",
            va="center",
            fontweight="bold" if row.front else "normal",
            arrowprops={"arrowstyle": "-", "linewidth": 0.4, "color": "0.5"},
        )
        box = label.get_window_extent()
        scale = axes.figure.dpi / 72

        def covered(offset: tuple[int, int], box: Any = box, scale: float = scale) -> float:
            moved = box.translated(offset[0] * scale, offset[1] * scale)
            hidden = sum(_shared(moved, other) for other in taken)
            return float(hidden + 5 * (box.width * box.height - _shared(moved, frame)))

        best = min(OFFSETS, key=covered)
        label.set_position(best)
        taken.append(box.translated(best[0] * scale, best[1] * scale))


def _shared(one: Any, other: Any) -> float:
    """The area that both boxes cover."""
    wide = min(one.x1, other.x1) - max(one.x0, other.x0)
    high = min(one.y1, other.y1) - max(one.y0, other.y0)
    return float(max(wide, 0.0) * max(high, 0.0))
