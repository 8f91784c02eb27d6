"""Which of the paper's directions hold here: each part that it proposes, with what it printed and what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from pipeline.records import Task
from pipeline.reporting.accuracy import Measure
from pipeline.reporting.compared_rows import EffectRow
from pipeline.reporting.inputs import Inputs
from pipeline.reporting.published import MODELS
from pipeline.reporting.results import BASE_CLIP, NO_OPD, OCTOPI, WITHOUT_LORA, System
from pipeline.reporting.table import share_span

Verdict = Literal["holds", "not shown", "reversed"]


@dataclass(frozen=True)
class Claim:
    """A part that the paper says helps, and its tables that say so."""

    axis: str
    change: str
    """As among the effects."""
    without: System
    tables: Mapping[Task, str]
    """By task, as published.csv names them."""


CLAIMS = (
    Claim(
        "OPD",
        "all minus none",
        NO_OPD,
        {**dict.fromkeys((Task.PC, Task.PSS, Task.POM), "understanding"), Task.PSR: "scenario_reasoning"},
    ),
    Claim(
        "encoder",
        "finetuned minus base",
        BASE_CLIP,
        {**dict.fromkeys((Task.PC, Task.PSS, Task.POM), "encoder_understanding"), Task.OPD: "encoder_property"},
    ),
    Claim(
        "LoRA",
        "with minus without",
        WITHOUT_LORA,
        {**dict.fromkeys((Task.PC, Task.PSS, Task.POM), "lora_understanding"), Task.OPD: "lora_property"},
    ),
)


@dataclass(frozen=True)
class DirectionRow:
    """One part and one task; differences of shares."""

    part: str
    change: str
    task: str
    published_7b: float | None
    """The full system's accuracy less that without the part, as printed."""
    published_13b: float | None
    difference: float
    low: float | None
    high: float | None
    verdict: Verdict
    gate: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Part": self.part,
            "Change": self.change,
            "Task": self.task,
            "Verdict": self.verdict,
            "Difference": _points(self.difference),
            "95 %": share_span(self.low, self.high),
            "Published 7b": _points(self.published_7b),
            "Published 13b": _points(self.published_13b),
            "Base model": self.gate,
        }


def directions(inputs: Inputs, measures: Sequence[Measure], effects: Sequence[EffectRow]) -> list[DirectionRow]:
    """The effects that the paper has a figure for; where the data set is another's, without its figures."""
    found = {(row.axis, row.change, row.task): row for row in effects}
    rows = []
    for claim in CLAIMS:
        for measure in measures:
            row = found.get((claim.axis, claim.change, measure.label))
            if row and (table := claim.tables.get(measure.task)):
                small, large = (_printed(inputs, table, measure, claim.without, model) for model in MODELS)
                rows.append(
                    DirectionRow(
                        part=claim.axis,
                        change=claim.change,
                        task=measure.label,
                        published_7b=small,
                        published_13b=large,
                        difference=row.difference,
                        low=row.low,
                        high=row.high,
                        verdict=verdict(row.low, row.high),
                        gate=row.gate,
                    )
                )
    return rows


def verdict(low: float | None, high: float | None) -> Verdict:
    """What an interval says of a part that is to help; nothing where there is none."""
    if low is not None and low > 0:
        return "holds"
    return "reversed" if high is not None and high < 0 else "not shown"


def _printed(inputs: Inputs, table: str, measure: Measure, without: System, model: str) -> float | None:
    whole, less = (inputs.published(table, measure.row, system.name, model) for system in (OCTOPI, without))
    return (whole.value - less.value) / 100 if whole and less else None


def _points(share: float | None) -> str:
    return "" if share is None else f"{100 * share:+.1f}"
