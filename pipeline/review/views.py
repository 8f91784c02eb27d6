"""What a table is shown by: columns for reading over the columns of its file."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Kind(StrEnum):
    """What a column holds."""

    HEAD = "head"
    """Says what the row is about."""
    MEASURED = "measured"
    PUBLISHED = "published"
    PLAIN = "plain"
    """A figure that goes with the measured one."""
    WORDS = "words"
    LIST = "list"
    """Several values, a line each."""
    FLAG = "flag"
    """Says `True` in the rows that are singled out, and nothing in others."""


@dataclass(frozen=True)
class Column:
    """A column for reading: a heading over a template of the CSV's columns."""

    heading: str
    """What stands behind a bar is about the second line."""
    template: str
    kind: Kind = Kind.PLAIN
    small: str = ""
    """A second line, smaller."""
    needs: str = ""
    """A column without which there is nothing to show."""
    otherwise: str = ""
    """What stands in the place of a figure that is not there."""


@dataclass(frozen=True)
class Bar:
    """The columns that a row's little picture is drawn from."""

    value: str
    low: str
    high: str
    unit: float
    """What the ends of the picture are in the file: 100 or 1, or 2 for what reaches from -200 to 200 %."""
    signed: bool = False
    """Whether it shows a difference, from -100 to 100 with a line at nothing."""
    chance: str = ""
    marks: tuple[str, ...] = ()
    """Published figures."""


@dataclass(frozen=True)
class View:
    """How one kind of table is shown."""

    columns: tuple[Column, ...]
    bar: Bar | None = None
    hidden: tuple[str, ...] = ()
    """Columns that say what others on the page say."""
