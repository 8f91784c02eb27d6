"""The figures of the committed reports, and which of them moved between two states of the project."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.comparison.locked import Change, changes, load_yaml
from pipeline.errors import UserError
from pipeline.revisions import Tree
from pipeline.tracking.reproduction import flatten

REPORTS = "reports"
NO_REPORTS = (f"{REPORTS}/bench/",)
"""Benchmarks measure a machine; they differ each time."""
METRICS, PROVENANCE, PARAMETERS = "metrics.json", "provenance.json", "params.yaml"

ORIGINS = (f"/{PROVENANCE}", f"/{PARAMETERS}")


@dataclass(frozen=True)
class Figure:
    """A cell that moved."""

    file: str
    row: str
    """What tells the row from the others, or the key where the file is no table."""
    column: str
    """Empty where the file is no table; `row` where the whole row is in one of the two only."""
    old: str | None
    """None where the cell is not there."""
    new: str | None


@dataclass(frozen=True)
class Figures:
    """How the reports of two states differ."""

    moved: tuple[Figure, ...]
    origins: tuple[Figure, ...]
    """Of provenance.json and params.yaml: what the reports were made from."""
    files: tuple[Change, ...]
    """Files of figures that only one of the two has; its name stands on the side that has it."""


def moved_figures(old: Tree, new: Tree) -> Figures:
    """Compare metrics.json, where reports come from, and all CSVs of all reports, metrics first.

    Raises:
        UserError: where one of the files is broken.
    """
    before, after = (tree.read(_figure_files(tree)) for tree in (old, new))
    names = sorted(before.keys() | after.keys(), key=lambda name: (name.split("/")[1], name.endswith(".csv"), name))
    moved: list[Figure] = []
    origins: list[Figure] = []
    alone: list[Change] = []
    for name in names:
        one, other = before.get(name), after.get(name)
        if one is None or other is None:
            alone.append(Change(name, None if one is None else name, None if other is None else name))
        elif one != other:
            found = _cells(name, one, other, (old.name, new.name))
            (origins if name.endswith(ORIGINS) else moved).extend(found)
    return Figures(tuple(moved), tuple(origins), tuple(alone))


def _figure_files(tree: Tree) -> list[str]:
    """The files below reports/<report>/ that hold figures; reports/ itself holds none."""
    return [
        path
        for path in tree.files(REPORTS)
        if path.count("/") > 1
        and not path.startswith(NO_REPORTS)
        and (path.endswith(".csv") or path.rsplit("/", 1)[1] in (METRICS, PROVENANCE, PARAMETERS))
    ]


def _cells(name: str, old: bytes, new: bytes, trees: tuple[str, str]) -> list[Figure]:
    if not name.endswith(".csv"):
        read = _json if name.endswith(".json") else _yaml
        one, other = (read(content, f"{name} of {tree}") for content, tree in zip((old, new), trees, strict=True))
        return [Figure(name, c.name, "", c.old, c.new) for c in changes(one, other)]
    one_table, other_table = (
        _table(content, f"{name} of {tree}") for content, tree in zip((old, new), trees, strict=True)
    )
    return _rows(name, one_table, other_table)


@dataclass(frozen=True)
class _Table:
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def labels(self) -> int:
        """How many of the first columns it takes to tell all rows apart; all of them where even that does not."""
        for count in range(1, len(self.columns)):
            if len({row[:count] for row in self.rows}) == len(self.rows):
                return count
        return len(self.columns)

    def keyed(self, labels: Sequence[str]) -> dict[str, dict[str, str]]:
        """Rows by what these columns say; rows that say the same are numbered."""
        found: dict[str, dict[str, str]] = {}
        for row in self.rows:
            cells = dict(zip(self.columns, row, strict=True))
            label = name = ", ".join(cells.get(column, "") for column in labels)
            number = 1
            while name in found:
                number += 1
                name = f"{label} #{number}"
            found[name] = cells
        return found


def _rows(name: str, old: _Table, new: _Table) -> list[Figure]:
    # Tables begin with what a row is about; figures follow. A column that came or went changes no row's name.
    wider = max((old, new), key=_Table.labels)
    labels = [c for c in wider.columns[: wider.labels()] if all(c in (t.columns or [c]) for t in (old, new))]
    before, after = old.keyed(labels), new.keyed(labels)
    found = []
    for row in dict.fromkeys([*after, *before]):
        one, other = before.get(row), after.get(row)
        if one is None or other is None:
            found.append(Figure(name, row, "row", None if one is None else "there", None if other is None else "there"))
        else:
            found += [Figure(name, row, change.name, change.old, change.new) for change in changes(one, other)]
    return found


def _table(content: bytes, where: str) -> _Table:
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{where}: not a CSV ({error}); `dvc repro` makes it anew") from None
    columns, rows = tuple(lines[0]) if lines else (), tuple(map(tuple, lines[1:]))
    if any(len(row) != len(columns) for row in rows):
        raise UserError(f"{where}: a row has more or fewer cells than there are columns; `dvc repro` makes it anew")
    return _Table(columns, rows)


def _json(content: bytes, where: str) -> Mapping[str, str]:
    try:
        found = json.loads(content)
    except ValueError as error:
        raise UserError(f"{where}: not JSON ({error}); `dvc repro` makes it anew") from None
    if not isinstance(found, dict):
        raise UserError(f"{where}: not a mapping; `dvc repro` makes it anew")
    return dict(flatten(found))


def _yaml(content: bytes, where: str) -> Mapping[str, str]:
    return dict(flatten(load_yaml(content, where)))
