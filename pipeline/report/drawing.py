"""Tables as HTML, and where the marks of the page's figures stand; the templates draw the figures."""

from __future__ import annotations

import itertools
import math
import re
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import pandas as pd
from markupsafe import Markup, escape

SIZE = {"width": 360, "height": 230, "left": 44, "right": 12, "top": 12, "bottom": 194}
"""Of a scatter plot and its frame, in its own units: as wide as a phone, so that letters keep their size there."""
HEADS = ("Task", "Measure", "Severity")
"""Columns whose equal cells become one heading over their rows."""


class Scatter(NamedTuple):
    """A plot of error over cost; costs stand on a logarithmic axis."""

    dots: list[dict[str, Any]]
    """x, y, low, high, title, and number where it is on the front."""
    across: list[tuple[float, str]]
    up: list[tuple[float, str]]


def share(value: float) -> float | None:
    """A fraction as percent of a line; None for a missing one."""
    return None if pd.isna(value) else round(100 * float(value), 2)


def span(largest: float) -> float:
    """Half the width of a line of differences in points: the next 25 above the largest bound, at most 100."""
    return min(100.0, 25.0 * max(1, math.ceil(largest / 25)))


def place_points(rows: pd.DataFrame) -> Scatter | None:
    """Place the settings of one question of speed_error.csv; None where fewer than two have a cost and an error.

    Args:
        rows: setting, cost_ratio, error, low and high (in the unit of the error, may be missing), front (bool).
    """
    rows = rows[rows["cost_ratio"].gt(0) & rows["error"].notna()].sort_values("cost_ratio", kind="stable")
    if len(rows) < 2:
        return None
    x, ratios = _axis([math.log10(ratio) for ratio in rows["cost_ratio"]], SIZE["left"], SIZE["width"] - SIZE["right"])
    y, errors = _axis(rows[["error", "low", "high"]].stack().tolist(), SIZE["bottom"], SIZE["top"])
    powers = range(math.floor(ratios[0]), math.ceil(ratios[1]) + 1)
    ticks = [(math.log10(step) + power, f"{step * 10.0**power:g}") for power in powers for step in (1, 2, 5)]
    ticks = [tick for tick in ticks if ratios[0] <= tick[0] <= ratios[1]]
    step = 10.0 ** math.floor(math.log10(errors[1] - errors[0]))
    step = next(s for s in (step, step / 2, step / 5) if (errors[1] - errors[0]) / s >= 3)
    levels = [round(k * step, 12) for k in range(math.ceil(errors[0] / step), math.floor(errors[1] / step) + 1)]
    count, dots = itertools.count(1), []
    for row in rows.to_dict("records"):
        low, high = (row["error"] if pd.isna(row[end]) else row[end] for end in ("low", "high"))
        title = f"{row['setting']}: {row['cost_ratio']:.3g} times the cost, error {row['error']:.3g}"
        place = {"x": x(math.log10(row["cost_ratio"])), "y": y(row["error"]), "low": y(low), "high": y(high)}
        dots.append({**place, "title": title, "number": next(count) if row["front"] else None})
    across = [(x(at), label) for at, label in ticks if len(ticks) <= 6 or label.strip("0.") == "1"]
    return Scatter(dots, across, [(y(level), f"{level:.3g}") for level in levels])


def _axis(values: Sequence[float], start: float, end: float) -> tuple[Any, tuple[float, float]]:
    """A function from values to places between two, and the ends of the axis, a little outside the values."""
    room = (max(values) - min(values)) * 0.08 or abs(max(values)) * 0.1 or 1.0
    low, high = min(values) - room, max(values) + room
    return lambda value: round(start + (value - low) / (high - low) * (end - start), 1), (low, high)


def draw_table(frame: pd.DataFrame, caption: str, file: str, at_lines: bool = True) -> Markup:
    """A table as HTML by great_tables, in the page's style: its own would weigh 9 kB a table and know no dark screen.

    Args:
        frame: text in every cell; rows of one task, measure or severity are brought together.
        caption: what the table is called.
        file: the CSV that it comes from.
        at_lines: whether the frame's index is that of the CSV, so that each row can name its line.
    """
    import pyarrow as pa
    from great_tables import GT

    frame = frame.rename(columns={"": " "})
    kinds = {str(name): _kind(str(name), frame[name]) for name in frame}
    words = [name for name, kind in kinds.items() if kind == "words"]
    group = next((name for name in HEADS if name in words and len(words) > 1), None)
    head = next((name for name in words if name != group), None)
    if group:
        frame = frame.iloc[pd.factorize(frame[group])[0].argsort(kind="stable")]
    with warnings.catch_warnings():
        # great_tables calls Arrow tables experimental; it is four times as slow with those of pandas.
        warnings.simplefilter("ignore", UserWarning)
        table = GT(pa.Table.from_pandas(frame, preserve_index=False), rowname_col=head, groupname_col=group, id="t")
        html = (table.tab_stubhead(head) if head else table).as_raw_html()
    shown = [kind for name, kind in kinds.items() if name not in (group, head)]
    heads = iter([*(["words"] if head else []), *shown])
    cells, rows = itertools.cycle(shown), (f"{file}:{index + 2}" if at_lines else file for index in frame.index)

    def attributes(match: re.Match[str]) -> str:
        tag, given = match.groups()
        if tag == "tr":
            return "<tr>" if "class=" in given else f'<tr data-source="{escape(next(rows))}">'
        if tag == "td":
            return f'<td class="{next(cells)}">'
        scope = given.partition('scope="')[2].partition('"')[0]
        wide = f' colspan="{len(shown) + 1}"' if scope == "colgroup" else ""
        return f'<th scope="{scope}"{wide}>' if scope != "col" else f'<th scope="col" class="{next(heads)}">'

    body = re.sub(r"<(tr|td|th)\b([^>]*)>", attributes, html[html.index("<thead") : html.index("</table>")])
    return Markup(f"<table><caption>{escape(caption)}</caption>{body}</table>")


def _kind(name: str, cells: pd.Series[Any]) -> str:
    """How a column is shown: what was measured here never looks like what the paper printed."""
    kind = name.partition(" ")[0].lower()
    if kind in ("measured", "published"):
        return kind
    return "number" if all(re.fullmatch(r"[-+\d.,e/ \[\]()]*", cell) for cell in cells) else "words"
