"""What README.md and the page are written with: one set of templates, and tables as Markdown or as HTML."""

from __future__ import annotations

import re
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

HEADS = ("Task", "Measure", "Severity")
"""Columns whose equal cells become one heading over their rows."""


def inline(text: str, folder: str = "") -> Markup:
    """A sentence of a README: its bold words, code and links, relative to a folder, as HTML; all else as it is."""
    html = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text)))
    html = re.sub(r"\*(\w[^*]*)\*", r"<em>\1</em>", html)
    html = re.sub(r"`(.+?)`", r"<code>\1</code>", html)
    return Markup(re.sub(r"\[([^]]+)\]\(([\w./-]+)\)", rf'<a href="{escape(folder)}\2">\1</a>', html))


def count(number: int, noun: str) -> str:
    """Such as "1 task" and "2 tasks"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def size(parameters: int) -> str:
    """A number of parameters in words, such as "2.1 M-parameter"."""
    for unit, name in ((1e9, "B"), (1e6, "M"), (1e3, "k"), (1, "")):
        if parameters >= unit:
            return f"{parameters / unit:.1f} {name}-parameter"
    return "model of unknown size:"


def model(facts: dict[str, Any]) -> str:
    """A base model as a person would name it, such as "a 2.1 M-parameter Llama, trained on ..."."""
    taught = facts["taught"] or "what it was taught is not noted here"
    return f"`{facts['folder']}`, a {size(facts['parameters'])} {facts['kind']}, {taught}"


TEMPLATES = Environment(
    loader=PackageLoader("pipeline.report"),
    autoescape=select_autoescape(),
    trim_blocks=True,
    keep_trailing_newline=True,
    undefined=StrictUndefined,
)
"""Only what is put into .html is escaped."""
TEMPLATES.filters |= {"inline": inline, "count": count, "size": size, "model": model}


def render(template: str, **values: Any) -> str:
    """The text of a file in templates/."""
    return TEMPLATES.get_template(template).render(**values)


def markdown(frame: pd.DataFrame) -> str:
    """A table in Markdown, of cells that are text; bars in cells are escaped."""
    rows = [list(frame.columns), ["---"] * len(frame.columns), *frame.to_numpy().tolist()]
    return "".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |\n" for row in rows)


def draw_table(frame: pd.DataFrame, title: str, file: str, at_lines: bool = True) -> Markup:
    """A table as HTML; rows of one task, measure or severity are brought together under a heading.

    Args:
        frame: text in every cell.
        file: the CSV that it comes from.
        at_lines: whether the frame's index is that of the CSV, so that each row can name its line.
    """
    kinds = {name: _kind(name, frame[name]) for name in frame}
    words = [name for name, kind in kinds.items() if kind == "words"]
    group = next((name for name in HEADS if name in words and len(words) > 1), None)
    first = [name for name in words if name != group][:1]
    columns = [*first, *(name for name in frame if name not in (group, *first))]
    if group:
        frame = frame.iloc[pd.factorize(frame[group])[0].argsort(kind="stable")]
    rows = [
        (f"{file}:{index + 2}" if at_lines else file, row.get(group), [row[name] for name in columns])
        for index, row in zip(frame.index, frame.to_dict("records"), strict=True)
    ]
    heads = [(name, kinds[name]) for name in columns]
    return Markup(render("table.html", title=title, heads=heads, named=bool(first), rows=rows))


def _kind(name: str, column: pd.Series[Any]) -> str:
    """How a column is shown: what was measured here never looks like what the paper printed."""
    kind = name.partition(" ")[0].lower()
    if kind in ("measured", "published"):
        return kind
    return "number" if all(re.fullmatch(r"[-+\d.,e/ \[\]()]*", cell) for cell in column) else "words"
