"""Which settings are worth their cost, and a picture of it: what the benchmarks and the table over all of them draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.io import atomic
from pipeline.speed.labels import MARKER, Box, Place, place_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Annotation

DPI = 120
MARKERS = "osD^vPX*"
MOST_STEP = 12.0
"""Pixels between the boxes that stand for a slanting line."""
LED = 24.0
"""A name farther from its point than this many pixels, across and up, has a thin line to it."""
RING = 12.0
"""Radius of the ring around what is recommended, in pixels."""
DARKER = 0.7
"""What is left of a colour's light where it is a name's."""
SUBDIVISIONS = ((1.0,), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))
"""Where ticks of a logarithmic axis may be within a decade: the coarsest that gives `FEWEST_TICKS`."""
FEWEST_TICKS = 4
MOST_TICKS = 7
"""At equal steps, on an axis that is too short for those."""


@dataclass(frozen=True)
class Point:
    """A setting."""

    group: str
    """Settings of one group share a colour and a line of the legend; one group alone has none."""
    name: str
    cost: float
    error: float
    low: float | None = None
    """Ends of the error's interval."""
    high: float | None = None
    recommended: bool = False


def front(points: Sequence[Point]) -> list[Point]:
    """Those that no other beats by being as cheap and better, or cheaper and as good; in order of rising cost."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cost, p.error)):
        if not best or point.error < best[-1].error:
            best.append(point)
    return best


def draw_pareto(points: Sequence[Point], path: Path, title: str, cost: str, error: str) -> None:
    """Draw cost against error with intervals; the front is a line, its names bold, what is recommended has a ring.

    Args:
        points: One or more, all costs above 0.
        path: A PNG; equal points give equal bytes.
        title: Above the plot.
        cost: What the cost is.
        error: What the error is.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ahead = front(points)
    figure = Figure(figsize=(9, 6), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_xscale("log")
    axes.margins(x=0.1, y=0.08)
    colours = _draw_groups(axes, points)
    axes.plot([p.cost for p in ahead], [p.error for p in ahead], color="black", linewidth=1, zorder=1, label="front")
    chosen = [p for p in points if p.recommended]
    if chosen:
        where = [p.cost for p in chosen], [p.error for p in chosen]
        axes.scatter(
            *where,
            s=(2 * RING * 72 / DPI) ** 2,
            facecolors="none",
            edgecolors="black",
            linewidths=1.6,
            label="recommended",
        )
    _set_ticks(axes)
    axes.set_xlabel(cost)
    axes.set_ylabel(error)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    # Below the axes, where it covers no point.
    figure.legend(loc="outside lower center", ncols=5, fontsize=8)
    names = [
        axes.annotate(p.name, (p.cost, p.error), (0, 0), textcoords="offset points", fontsize=8, annotation_clip=False)
        for p in points
    ]
    for name, point in zip(names, points, strict=True):
        name.set_in_layout(False)
        name.set_color(colours[point.group])
        name.set_fontweight("bold" if point in ahead or point.recommended else "normal")
    canvas.draw()
    _place(axes, points, ahead, names)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png", metadata={"Software": None})


def _draw_groups(axes: Axes, points: Sequence[Point]) -> dict[str, tuple[float, ...]]:
    """Draws the points; the colours that their names have, by group."""
    from matplotlib.colors import to_rgb

    colours: dict[str, tuple[float, ...]] = {}
    groups = list(dict.fromkeys(p.group for p in points))
    for number, group in enumerate(groups):
        own = [p for p in points if p.group == group]
        spread = [
            [p.error - (p.error if p.low is None else p.low) for p in own],
            [(p.error if p.high is None else p.high) - p.error for p in own],
        ]
        axes.errorbar(
            [p.cost for p in own],
            [p.error for p in own],
            yerr=spread,
            fmt=MARKERS[number % len(MARKERS)],
            label=group if len(groups) > 1 else None,
            capsize=2,
            elinewidth=0.7,
            alpha=0.85,
            zorder=2,
            color=f"C{number}",
        )
        colours[group] = tuple(DARKER * part for part in to_rgb(f"C{number}"))
    return colours


def _set_ticks(axes: Axes) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, ScalarFormatter

    low, high = axes.get_xlim()
    locators = [LogLocator(subs=subdivisions, numticks=99) for subdivisions in SUBDIVISIONS]
    enough = (x for x in locators if sum(low <= t <= high for t in x.tick_values(low, high)) >= FEWEST_TICKS)
    axes.xaxis.set_major_locator(next(enough, MaxNLocator(MOST_TICKS)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_locator(NullLocator())


def _place(axes: Axes, points: Sequence[Point], ahead: Sequence[Point], names: Sequence[Annotation]) -> None:
    """Move the names to where they cover nothing, with a thin line to what is farther off."""

    def pixel(cost: float, error: float) -> Place:
        x, y = axes.transData.transform((cost, error))
        return float(x), float(y)

    middles = [pixel(p.cost, p.error) for p in points]
    extents = [name.get_window_extent() for name in names]
    lines: list[Box] = []
    for p, (x, _) in zip(points, middles, strict=True):
        if p.low is not None and p.high is not None:
            lines.append(Box(x - 1, pixel(p.cost, p.low)[1], x + 1, pixel(p.cost, p.high)[1]))
    for one, other in pairwise(pixel(p.cost, p.error) for p in ahead):
        lines += _pieces(one, other)
    whole: Any = axes.get_window_extent()
    frame = Box(whole.x0 + 2, whole.y0 + 2, whole.x1 - 2, whole.y1 - 2)
    markers = [RING if p.recommended else MARKER for p in points]
    boxes = place_labels(middles, [(e.width, e.height) for e in extents], frame, lines, markers)
    for name, (x, y), extent, box in zip(names, middles, extents, boxes, strict=True):
        # Offsets count from where the text's line begins, which is not the corner of what is drawn.
        right, up = (box.left - x) - (extent.x0 - x), (box.bottom - y) - (extent.y0 - y)
        name.set_position((right * 72 / DPI, up * 72 / DPI))
        near = min(max(x, box.left), box.right), min(max(y, box.bottom), box.top)
        if abs(near[0] - x) + abs(near[1] - y) > LED:
            ends = axes.transData.inverted().transform([(x, y), near])
            axes.plot(ends[:, 0], ends[:, 1], color="0.5", linewidth=0.5, zorder=0, scalex=False, scaley=False)


def _pieces(one: Place, other: Place) -> list[Box]:
    """A slanting line as small boxes."""
    count = 1 + int(max(abs(other[0] - one[0]), abs(other[1] - one[1])) / MOST_STEP)
    steps = [i / count for i in range(count + 1)]
    middles = [(one[0] + s * (other[0] - one[0]), one[1] + s * (other[1] - one[1])) for s in steps]
    return [Box(x - 1, y - 1, x + 1, y + 1) for x, y in middles]
