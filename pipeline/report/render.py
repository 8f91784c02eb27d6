"""What README.md and the page are written with: one set of templates, and tables as Markdown or as HTML."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from pipeline.running.errors import counted

WORDS: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("words.yaml").read_text(encoding="utf-8"))


class Block(NamedTuple):
    """A table that is shown, with what stands above it."""

    key: str
    title: str
    caption: str
    frame: pd.DataFrame
    """Text in every cell."""
    file: str
    """The CSV of the report that it comes from; the frame's index is that of the CSV."""
    open: bool = False
    """Whether it is shown unasked."""


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


def markdown(frame: pd.DataFrame, bold: str = "") -> str:
    """A table in Markdown; bars in cells are escaped, columns whose heads begin with `bold` are so."""
    rows = [list(frame.columns), ["---"] * len(frame.columns)]
    marks = ["**" if bold and name.startswith(bold) else "" for name in frame]
    rows += [[f"{m}{cell}{m}" for m, cell in zip(marks, row, strict=True)] for row in frame.to_numpy()]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |\n" for row in rows)


def kinds(frame: pd.DataFrame) -> list[str]:
    """How each column is shown on the page: what was measured here never looks like what the paper printed."""
    firsts = [name.partition(" ")[0].lower() for name in frame]
    numbers = [all(re.fullmatch(r"[-+\d.,e/ \[\]()]*", cell) for cell in frame[name]) for name in frame]
    named = {"measured", "published"}
    return [f if f in named else "number" if n else "words" for f, n in zip(firsts, numbers, strict=True)]


TEMPLATES = Environment(
    loader=PackageLoader("pipeline.report"),
    autoescape=select_autoescape(),
    trim_blocks=True,
    keep_trailing_newline=True,
    undefined=StrictUndefined,
)
"""Only what is put into .html is escaped."""
TEMPLATES.filters |= {f.__name__: f for f in (inline, counted, size, markdown, kinds)}


def render(template: str, **values: Any) -> str:
    """The text of a file in templates/."""
    return TEMPLATES.get_template(template).render(**values)
