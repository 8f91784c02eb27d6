"""The paper's own figures (published.csv). They stand beside measured ones and are never taken for one.

The paper gives no numbers of questions. Those in the file are the ones that its percentages fit: 158 PC, 150 PSS, 187
POM, 46 PSR and 38 OPD, and, in the column without OPD, 172 PC, 163 PSS and 155 POM.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from pipeline.statistics import Interval, wilson

DATASET = "PhysiCLeAR"
"""The data set of the paper's figures, as properties.yaml names it; beside those of another they would mislead."""
FILE = Path(__file__).with_name("published.csv")
MODELS = ("7b", "13b")


@dataclass(frozen=True)
class Published:
    """One printed cell of one of the paper's tables."""

    table: str
    row: str
    system: str
    model: str
    """7b or 13b; empty where the cell belongs to neither."""
    value: float
    """As printed: percent, a count, frames, or an ICC."""
    n: int | None
    """Questions (objects or videos in the tables of the data set); None for a chance level."""

    @property
    def wilson(self) -> Interval | None:
        """The 95 % interval that the paper's own n gives an accuracy, in percent."""
        if self.n is None:
            return None
        interval = wilson(self.value * self.n / 100, self.n)
        return Interval(100 * interval.low, 100 * interval.high)


@cache
def published() -> tuple[Published, ...]:
    """All cells, in the paper's order."""
    with FILE.open(encoding="utf-8", newline="") as stream:
        return tuple(
            Published(
                table=line["table"],
                row=line["row"],
                system=line["system"],
                model=line["model"],
                value=float(line["value"]),
                n=int(line["n"]) if line["n"] else None,
            )
            for line in csv.DictReader(stream)
        )


def find(table: str, row: str, system: str, model: str = "") -> Published | None:
    """The cell, or None where the paper has none."""
    wanted = (table, row, system, model)
    return next((p for p in published() if (p.table, p.row, p.system, p.model) == wanted), None)
