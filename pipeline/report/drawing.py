"""Tables as HTML, and where the marks of the page's lines stand; the templates draw them."""

from __future__ import annotations

import itertools
import math
import re
import warnings
from typing import Any

import pandas as pd
from markupsafe import Markup, escape

HEADS = ("Task", "Measure", "Severity")
"""Columns whose equal cells become one heading over their rows."""


def share(value: float) -> float | None:
    """A fraction as percent of a line; None for a missing one."""
    return None if pd.isna(value) else round(100 * float(value), 2)


def span(largest: float) -> float:
    """Half the width of a line of differences in points: the next 25 above the largest bound, at most 100."""
    return min(100.0, 25.0 * max(1, math.ceil(largest / 25)))


def draw_table(frame: pd.DataFrame, caption: str, file: str, at_lines: bool = True) -> Markup:
    """A table as HTML by great_tables, in the page's style: its own would weigh 9 kB a table and know no dark screen.

    Args:
        frame: text in every cell; rows of one task, measure or severity are brought together.
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
