"""Confusion matrices as tables, so that they can be read on a phone, aloud and by copying."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.review.traced import Grid, Piece

SHADES = 10


@dataclass(frozen=True)
class Square:
    """One cell: how many videos of a class were taken for another, and its shade as a share of the row in tenths."""

    piece: Piece
    shade: int
    right: bool


@dataclass(frozen=True)
class Matrix:
    """One property; rows are rated, columns predicted classes."""

    property: str
    levels: tuple[str, ...]
    rows: tuple[tuple[Square, ...], ...]


def matrices(grid: Grid) -> list[Matrix]:
    """One a property, in the file's order; none of a property without figures."""
    found = []
    for name in dict.fromkeys(grid.value(row, "property") for row in range(len(grid.rows))):
        own = [row for row in range(len(grid.rows)) if grid.value(row, "property") == name]
        levels = tuple(dict.fromkeys(grid.value(row, "expected") for row in own))
        place = {(grid.value(row, "expected"), grid.value(row, "predicted")): row for row in own}
        if all(grid.number(row, "videos") is not None for row in own) and len(place) == len(levels) ** 2:
            rows = []
            for rated in levels:
                counts = [grid.number(place[rated, other], "videos") or 0 for other in levels]
                rows.append(
                    tuple(
                        Square(
                            grid.piece(place[rated, other], "videos"),
                            round(SHADES * count / max(sum(counts), 1)),
                            rated == other,
                        )
                        for other, count in zip(levels, counts, strict=True)
                    )
                )
            found.append(Matrix(name, levels, tuple(rows)))
    return found
