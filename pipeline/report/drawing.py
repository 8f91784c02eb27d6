"""Where the marks of the page's drawings stand: the templates draw them, these functions place them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import pandas as pd

WIDTH, HEIGHT = 360, 230
"""Of a scatter plot, in its own units: the width of a phone, so that its letters keep their size there."""
LEFT, RIGHT, TOP, BOTTOM = 44, 12, 10, 36


class Tick(NamedTuple):
    """A labelled line of an axis."""

    at: float
    label: str


class Dot(NamedTuple):
    """One setting: its place, the ends of its interval, and its number where it is on the front."""

    x: float
    y: float
    low: float
    high: float
    title: str
    number: int | None


class Scatter(NamedTuple):
    """A plot of error over cost; costs stand on a logarithmic axis."""

    dots: tuple[Dot, ...]
    front: str
    """The front as the points of a polyline."""
    across: tuple[Tick, ...]
    up: tuple[Tick, ...]


def span(largest: float) -> float:
    """Half the width of an axis of differences in points: the next 25 above the largest bound, at most 100."""
    return min(100.0, 25.0 * max(1, math.ceil(largest / 25)))


def scatter(rows: pd.DataFrame) -> Scatter | None:
    """Place the settings of one question of speed_error.csv; None where fewer than two have a cost and an error.

    Args:
        rows: setting, cost_ratio (above 0), error, low, high (in the unit of error, may be missing), front (bool).
    """
    rows = rows[rows["cost_ratio"].gt(0) & rows["error"].notna()]
    if len(rows) < 2:
        return None
    ends = rows[["error", "low", "high"]].to_numpy(float)
    bottom, top = _padded(float(pd.Series(ends.ravel()).min()), float(pd.Series(ends.ravel()).max()))
    logs = [math.log10(ratio) for ratio in rows["cost_ratio"]]
    first, last = _padded(min(logs), max(logs))

    def x(log: float) -> float:
        return round(LEFT + (log - first) / (last - first) * (WIDTH - LEFT - RIGHT), 1)

    def y(error: float) -> float:
        return round(HEIGHT - BOTTOM - (error - bottom) / (top - bottom) * (HEIGHT - TOP - BOTTOM), 1)

    dots, count = [], 0
    for row, log in sorted(zip(rows.to_dict("records"), logs, strict=True), key=lambda pair: pair[1]):
        count += bool(row["front"])
        low, high = (row["error"] if pd.isna(row[end]) else row[end] for end in ("low", "high"))
        said = f"{row['setting']}: {row['cost_ratio']:.3g} times the cost, error {row['error']:.3g}"
        dots.append(Dot(x(log), y(row["error"]), y(low), y(high), said, count if row["front"] else None))
    return Scatter(
        tuple(dots),
        " ".join(f"{dot.x},{dot.y}" for dot in dots if dot.number),
        tuple(Tick(x(math.log10(ratio)), f"{ratio:g}×") for ratio in _ratios(10**first, 10**last)),
        tuple(Tick(y(error), f"{error:.3g}") for error in _round(bottom, top)),
    )


def _padded(low: float, high: float) -> tuple[float, float]:
    room = (high - low) * 0.08 or abs(high) * 0.1 or 1.0
    return low - room, high + room


def _ratios(low: float, high: float) -> Sequence[float]:
    """1, 2 and 5 times powers of ten; of many only the powers."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found = [step * 10.0**power for power in powers for step in (1, 2, 5) if low <= step * 10.0**power <= high]
    return found if len(found) <= 6 else [ratio for ratio in found if math.log10(ratio).is_integer()]


def _round(low: float, high: float) -> Sequence[float]:
    """Three to seven round numbers between two."""
    step = 10.0 ** math.floor(math.log10(high - low))
    step = next(s for s in (step, step / 2, step / 5) if (high - low) / s >= 3)
    return [round(k * step, 12) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def percent(value: Any) -> float | None:
    """A fraction as a place on a line from 0 to 100; None for a missing one."""
    return None if pd.isna(value) else round(100 * float(value), 2)
