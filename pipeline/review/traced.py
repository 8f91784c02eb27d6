"""Text that knows the file it comes from, so that every figure on the page can be traced back.

A source is `FILE#PLACE`, the file relative to reports/. Places are `3:column` (third row of a CSV, or of a JSON list of
rows), `a.b.0` (a path in JSON or YAML), `count`, `count:column=value` or `count:a.b` (how many), and nothing at all
(the text stands in the file as it is).
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal, localcontext
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

from pipeline.io import read_json


@dataclass(frozen=True)
class Piece:
    """A run of text; without a source it is glue, and has no digit."""

    text: str
    source: str = ""
    factor: int = 1
    """The text is the source's figure times this: 100 where shares are shown in percent."""


@dataclass(frozen=True)
class Grid:
    """A table as it lies in a file; all cells as text, empty where there is nothing."""

    file: str
    """Relative to reports/."""
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def value(self, row: int, column: str) -> str:
        """The text of a cell, rows counted from 0; empty where there is no such column."""
        return self.rows[row][self.columns.index(column)] if column in self.columns else ""

    def number(self, row: int, column: str) -> float | None:
        """The figure in a cell; None where there is none."""
        try:
            return float(self.value(row, column))
        except ValueError:
            return None

    def piece(self, row: int, column: str) -> Piece:
        """A cell as it is."""
        return Piece(self.value(row, column), f"{self.file}#{row + 1}:{column}")

    @property
    def size(self) -> Piece:
        """How many rows there are."""
        return Piece(str(len(self.rows)), f"{self.file}#count")

    def where(self, column: str, value: str) -> Piece:
        """In how many rows a column says this."""
        place = self.columns.index(column)
        count = sum(row[place] == value for row in self.rows)
        return Piece(str(count), f"{self.file}#count:{column}={value}")


def read_grid(reports: Path, file: str) -> Grid | None:
    """A CSV, or a JSON list of rows; None where the file is absent, empty or neither."""
    path = reports / file
    if not path.is_file():
        return None
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as stream:
            lines = list(csv.reader(stream))
        return Grid(file, tuple(lines[0]), tuple(map(tuple, lines[1:]))) if len(lines) > 1 else None
    found = read_json(path)
    if not isinstance(found, list) or not found or not all(isinstance(row, dict) for row in found):
        return None
    columns = tuple(dict.fromkeys(name for row in found for name in row))
    return Grid(file, columns, tuple(tuple(_plain(row.get(name)) for name in columns) for row in found))


def fill(template: str, grid: Grid, row: int) -> tuple[Piece, ...]:
    """A cell for reading, as in "{low:.1f} to {high:.1f}"; nothing where one of its fields is empty.

    Formats are Python's, and with a `p` before them the figure is multiplied by 100; without one the text stays as it
    is in the file.
    """
    pieces: list[Piece] = []
    for glue, name, form in _parsed(template):
        if glue:
            pieces.append(Piece(glue))
        if name:
            if not grid.value(row, name):
                return ()
            figure = grid.number(row, name) if form else None
            if form is None or figure is None:
                pieces.append(grid.piece(row, name))
            else:
                factor = 100 if form.startswith("p") else 1
                text = _rounded(grid.value(row, name), factor, form.removeprefix("p"))
                pieces.append(Piece(text, f"{grid.file}#{row + 1}:{name}", factor))
    return tuple(pieces)


def _rounded(figure: str, factor: int, form: str) -> str:
    """A figure as its file writes it, in decimal digits: halves go up, whatever its nearest binary fraction is."""
    if form == "g":
        return format(float(figure) * factor, form)
    with localcontext(rounding=ROUND_HALF_UP):
        return format(Decimal(figure) * factor, form)


def fields(template: str) -> tuple[str, ...]:
    """The columns that a template reads."""
    return tuple(name for _, name, _ in _parsed(template) if name)


def entry(file: str, content: Any, place: str) -> Piece:
    """A value in JSON or YAML as text; empty where it is not there."""
    value = lookup(content, place)
    return Piece("" if value is None else _plain(value), f"{file}#{place}")


def lookup(content: Any, place: str) -> Any:
    """The value at a dotted path of keys and positions; None where there is none."""
    for part in place.split("."):
        if isinstance(content, Mapping):
            content = content.get(part)
        elif isinstance(content, list) and part.isdigit() and int(part) < len(content):
            content = content[int(part)]
        else:
            return None
    return content


def _plain(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, list):
        return "\n".join(filter(None, map(_plain, value)))
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


@cache
def _parsed(template: str) -> tuple[tuple[str, str | None, str | None], ...]:
    return tuple((glue, name, form or None) for glue, name, form, _ in Formatter().parse(template))
