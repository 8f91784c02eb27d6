"""A table of the report: rows of one frozen dataclass, as CSV (all fields) and Markdown (what a person reads)."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

from pipeline.io import write_text

Cell = str | int | float | None


class Row(Protocol):
    """A row; its class is a dataclass whose fields are the CSV's columns."""

    def display(self) -> Mapping[str, str]:
        """Markdown columns and their text, the same columns in every row of a table."""
        ...


@dataclass(frozen=True)
class Table:
    """One table and the sentences around it."""

    name: str
    """File name without ending."""
    title: str
    caption: str
    rows: Sequence[Row]
    shown: Sequence[Row] | None = None
    """Those that a person reads, where that is not all of them."""
    folder: str = "tables"
    """Below the report's folder."""

    @property
    def section(self) -> str:
        """Title, caption and table as a page has them."""
        file = (Path(self.folder) / f"{self.name}.csv").as_posix()
        return f"## {self.title}\n\n{self.caption} ([CSV]({file}))\n\n{self.markdown()}"

    def csv(self) -> str:
        """All fields of all rows; None is an empty cell."""
        stream = io.StringIO()
        lines: list[dict[str, Cell]] = [asdict(row) for row in self.rows]  # type: ignore[call-overload]
        writer = csv.DictWriter(stream, fieldnames=list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _plain(value) for name, value in line.items()} for line in lines)
        return stream.getvalue()

    def markdown(self) -> str:
        """The table in GitHub's Markdown; columns that are empty in every row are left out, numbers to the right."""
        shown = [row.display() for row in (self.rows if self.shown is None else self.shown)]
        if not shown:
            return "Nothing.\n"
        columns = [name for name in shown[0] if any(row[name] for row in shown)]
        numeric = [all(not row[name] or row[name].lstrip("-")[:1].isdigit() for row in shown) for name in columns]
        lines = [
            columns,
            ["---:" if right else ":---" for right in numeric],
            *([row[name].replace("|", "\\|") for name in columns] for row in shown),
        ]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_tables(tables: Iterable[Table], folder: Path) -> None:
    """Write each as CSV and Markdown below a report's folder."""
    for table in tables:
        write_text(folder / table.folder / f"{table.name}.csv", table.csv())
        write_text(
            folder / table.folder / f"{table.name}.md", f"# {table.title}\n\n{table.caption}\n\n{table.markdown()}"
        )


def number(value: float | None, digits: int = 2) -> str:
    """A number for reading; empty for None."""
    return "" if value is None else f"{value:.{digits}f}"


def percent(share: float | None) -> str:
    """A share in percent for reading, to one decimal; empty for None."""
    return "" if share is None else number(100 * share, 1)


def span(low: float | None, high: float | None) -> str:
    """An interval for reading, to one decimal; empty for None."""
    return "" if low is None or high is None else f"{low:.1f} to {high:.1f}"


def share_span(low: float | None, high: float | None) -> str:
    """An interval of shares in percent, as `span`."""
    return "" if low is None or high is None else span(100 * low, 100 * high)


def _plain(value: Cell) -> Cell:
    return round(value, 4) if isinstance(value, float) else value
