"""What README.md and the page are written with: one set of templates, and tables as Markdown or as HTML."""

from __future__ import annotations

import re
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from pipeline.core.errors import counted


def inline(text: str, folder: str = "") -> Markup:
    """A sentence of a README: its bold words, code and links, relative to a folder, as HTML; all else as it is."""
    html = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text)))
    html = re.sub(r"\*(\w[^*]*)\*", r"<em>\1</em>", html)
    html = re.sub(r"`(.+?)`", r"<code>\1</code>", html)
    return Markup(re.sub(r"\[([^]]+)\]\(([\w./-]+)\)", rf'<a href="{escape(folder)}\2">\1</a>', html))


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
TEMPLATES.filters |= {"inline": inline, "count": counted, "size": size, "model": model}


def render(template: str, **values: Any) -> str:
    """The text of a file in templates/."""
    return TEMPLATES.get_template(template).render(**values)


def markdown(frame: pd.DataFrame) -> str:
    """A table in Markdown, of cells that are text; bars in cells are escaped."""
    rows = [list(frame.columns), ["---"] * len(frame.columns), *frame.to_numpy().tolist()]
    return "".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |\n" for row in rows)


def draw_table(frame: pd.DataFrame, title: str, file: str = "") -> Markup:
    """A table as HTML.

    Args:
        frame: text in every cell.
        file: the CSV that it comes from, where the frame's index is that of the CSV, so that each row names its line.
    """
    heads = [(name, _kind(name, frame[name])) for name in frame]
    rows = [(f"{file}:{index + 2}" if file else "", cells) for index, *cells in frame.itertuples(name=None)]
    return Markup(render("table.html", title=title, heads=heads, rows=rows))


def _kind(name: str, column: pd.Series[Any]) -> str:
    """How a column is shown: what was measured here never looks like what the paper printed."""
    kind = name.partition(" ")[0].lower()
    if kind in ("measured", "published"):
        return kind
    return "number" if all(re.fullmatch(r"[-+\d.,e/ \[\]()]*", cell) for cell in column) else "words"
