"""What chapters and sections of the page are made of."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.review.matrices import Matrix
from pipeline.review.tables import Shown
from pipeline.review.traced import Grid, Piece


@dataclass(frozen=True)
class Picture:
    """A PNG on the page."""

    file: str
    """Relative to reports/."""
    alt: str


@dataclass(frozen=True)
class Block:
    """A table, matrices or a figure under its heading."""

    title: str
    caption: str
    source: str
    """File that the caption stands in."""
    table: Shown | None = None
    matrices: tuple[Matrix, ...] = ()
    pictures: tuple[Picture, ...] = ()
    counts: tuple[tuple[str, Piece], ...] = ()
    left: Grid | None = None
    """A table that is left to its file, being too long to read."""
    same: tuple[str, ...] = ()
    """Files that say the same as the table's."""
