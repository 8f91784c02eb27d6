"""Tables as the templates show them: cells of traced text, and a little picture of each measured row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pipeline.review.traced import Grid, Piece, fields, fill
from pipeline.review.views import Bar, Column, Kind, View

LONG = 14
"""A table with more rows is folded."""
BAR_WIDTH, BAR_MARGIN = 150.0, 7.0
BAR_HEADING = "Drawn"


@dataclass(frozen=True)
class Drawn:
    """Places in the little picture, in its units; None where there is nothing to draw."""

    value: float | None
    low: float | None
    high: float | None
    chance: float | None
    marks: tuple[float | None, ...]
    signed: bool


@dataclass(frozen=True)
class Cell:
    """One cell; either text or a picture."""

    pieces: tuple[Piece, ...]
    kind: Kind
    small: tuple[Piece, ...] = ()
    drawn: Drawn | None = None


@dataclass(frozen=True)
class Heading:
    """Of a column."""

    text: str
    small: str
    kind: Kind
    drawn: bool = False


@dataclass(frozen=True)
class Shown:
    """A table for reading."""

    name: str
    title: str
    file: str
    """Relative to reports/."""
    headings: tuple[Heading, ...]
    rows: tuple[tuple[Cell, ...], ...]
    size: Piece
    """Rows in the file."""
    part: str
    """Which of them are shown, in words; empty for all."""
    folded: bool


def show(
    grid: Grid,
    view: View,
    title: str,
    only: Sequence[int] | None = None,
    part: str = "some",
    name: str = "",
) -> Shown:
    """Fill a view; columns without any content are left out, columns that the view does not know come last.

    Args:
        only: The rows to show, counted from 0; all by default.
        part: Which those are, in words.
        name: For the table's anchor; the file's name by default.
    """
    chosen = range(len(grid.rows)) if only is None else only
    named = {
        name
        for column in view.columns
        for name in (*fields(column.template + column.small + column.otherwise), column.needs)
    }
    known = named | set(view.hidden) | set(view.bar.marks if view.bar else ())
    columns = [*view.columns, *_others(grid, known)]
    cells = [[_cell(grid, row, column) for row in chosen] for column in columns]
    kept = [(_heading(c), column) for c, column in zip(columns, cells, strict=True) if _any(column)]
    if view.bar and any(grid.number(row, view.bar.value) is not None for row in chosen):
        # Behind the figure that it draws, so that a phone shows that one first.
        place = 1 + next((i for i, (heading, _) in enumerate(kept) if heading.kind is Kind.MEASURED), len(kept) - 1)
        pictures = [Cell((), Kind.PLAIN, drawn=draw(grid, row, view.bar)) for row in chosen]
        kept.insert(place, (Heading(BAR_HEADING, "", Kind.PLAIN, drawn=True), pictures))
    return Shown(
        name=name or grid.file.rsplit("/", 1)[-1].rsplit(".", 1)[0],
        title=title,
        file=grid.file,
        headings=tuple(heading for heading, _ in kept),
        rows=tuple(zip(*(column for _, column in kept), strict=True)),
        size=grid.size,
        part=part if len(chosen) < len(grid.rows) else "",
        folded=len(chosen) > LONG,
    )


def draw(grid: Grid, row: int, bar: Bar) -> Drawn | None:
    """Where the row's figures lie between the ends of its picture; None where it has no figure at all."""

    def place(column: str) -> float | None:
        figure = grid.number(row, column) if column else None
        return None if figure is None else _place(figure / bar.unit, bar.signed)

    value, marks = place(bar.value), tuple(map(place, bar.marks))
    if value is None and not any(mark is not None for mark in marks):
        return None
    return Drawn(value, place(bar.low), place(bar.high), place(bar.chance), marks, bar.signed)


def _place(share: float, signed: bool) -> float:
    inside = (min(max(share, -1.0), 1.0) + 1) / 2 if signed else min(max(share, 0.0), 1.0)
    return round(BAR_MARGIN + inside * (BAR_WIDTH - 2 * BAR_MARGIN), 1)


def _others(grid: Grid, known: Iterable[str]) -> list[Column]:
    first = not known  # a table that nobody knows begins with what its rows are about
    return [
        Column(name.replace("_", " "), f"{{{name}}}", Kind.HEAD if first and i == 0 else Kind.PLAIN)
        for i, name in enumerate(c for c in grid.columns if c not in known)
    ]


def _cell(grid: Grid, row: int, column: Column) -> Cell:
    if column.needs and not grid.value(row, column.needs):
        return Cell((), column.kind)
    pieces = fill(column.template, grid, row)
    if column.kind is Kind.FLAG and "".join(piece.text for piece in pieces) != "True":
        return Cell((), column.kind)
    return Cell(pieces, column.kind, fill(column.small if pieces else column.otherwise, grid, row))


def _heading(column: Column) -> Heading:
    text, _, small = column.heading.partition("|")
    return Heading(text, small, column.kind)


def _any(cells: Sequence[Cell]) -> bool:
    return any(cell.pieces or cell.small for cell in cells)
