"""How right each variant is, in figures of the same names for all: what the dashboard's table of variants shows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.io import read_table
from pipeline.records import WHOLE, Score
from pipeline.statistics import Outcome, clustered

ENDS = ("low", "high")
"""Of an interval, in the names of metrics."""
DIGITS = 4


@dataclass(frozen=True)
class Standing:
    """A variant's accuracy in one task, from 0 to 1."""

    task: str
    accuracy: float
    low: float | None
    """Of the 95 % interval clustered by object, as the report's; None where the questions cannot show it."""
    high: float | None

    def metrics(self) -> dict[str, float]:
        """`accuracy.PC`, `accuracy.PC.low` and `accuracy.PC.high`."""
        names = [figure(self.task), *(figure(self.task, end) for end in ENDS)]
        values = zip(names, (self.accuracy, self.low, self.high), strict=True)
        return {name: value for name, value in values if value is not None}


def figure(task: str, end: str = "") -> str:
    """The name of an accuracy among a run's metrics, or of an end of its interval: next to each other when sorted."""
    return f"accuracy.{task}.{end}" if end else f"accuracy.{task}"


def standings(root: Path, variant: str) -> list[Standing]:
    """The accuracies of a variant, task by task as they were graded; nothing where it has no scores.

    Raises:
        UserError: where its scores are broken.
    """
    file = root / "data" / "scores" / variant / "scores.parquet"
    scores = [score for score in read_table(file, Score) if score.measure in WHOLE] if file.is_file() else []
    return [_standing(task, [s for s in scores if s.task == task]) for task in sorted({s.task for s in scores})]


def _standing(task: str, scores: list[Score]) -> Standing:
    interval = clustered([Outcome(float(score.correct), score.objects) for score in scores])
    share = sum(score.correct for score in scores) / len(scores)
    low, high = (round(interval.low, DIGITS), round(interval.high, DIGITS)) if interval else (None, None)
    return Standing(task, round(share, DIGITS), low, high)
