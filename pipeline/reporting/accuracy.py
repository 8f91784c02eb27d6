"""One row of a table of accuracies: measured beside published.

Several seeds: every question counts once, with the share of its answers that are right, so the value is the mean over
seeds, n stays the number of questions, and no interval shrinks because the same question was asked again.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.records import WHOLE, Score, Task
from pipeline.reporting.published import Published
from pipeline.reporting.table import number, span
from pipeline.statistics import Outcome, Spread, proportion


@dataclass(frozen=True)
class Measure:
    """What a row of a table measures."""

    task: Task
    name: str
    """As in `Score.measure`."""

    @property
    def row(self) -> str:
        """As published.csv calls it."""
        return self.name if self.task is Task.OPD else self.task.value

    @property
    def label(self) -> str:
        """The task, and of a description which property."""
        return self.task.value if self.name in WHOLE else f"{self.task} {self.name}"

    @property
    def whole(self) -> bool:
        """Whether it says that an answer is right, not only a part of it."""
        return self.name in WHOLE


@dataclass(frozen=True)
class Cell:
    """Where a row stands and what it is measured against."""

    row: str
    system: str
    """Name for reading."""
    chance: float
    """Accuracy of a uniform guess, from 0 to 1."""
    published: tuple[Published | None, Published | None]
    """The paper's cells for its 7b and its 13b model."""


@dataclass(frozen=True)
class AccuracyRow:
    """An accuracy with everything that it must be read with; all figures in percent but counts."""

    row: str
    system: str
    value: float | None
    k: float | None
    """Right answers: the mean over seeds."""
    n: int | None
    low: float | None
    high: float | None
    clustered_low: float | None
    clustered_high: float | None
    resampled_low: float | None
    """By resampling objects: optimistic where they are few, and only to be read beside the interval before it."""
    resampled_high: float | None
    chance: float
    majority: float | None
    """The best constant answer in hindsight, on the same questions."""
    unparsed: float | None
    """Answers in which no choice could be found; they count as wrong."""
    truncated: float | None
    seeds: int | None
    seed_mean: float | None
    seed_sd: float | None
    seed_values: str
    published_7b: float | None
    published_7b_n: int | None
    published_7b_low: float | None
    published_7b_high: float | None
    published_13b: float | None
    published_13b_n: int | None
    published_13b_low: float | None
    published_13b_high: float | None
    note: str
    """Why the measured cells are empty, or what speaks against reading anything into them."""

    def display(self) -> Mapping[str, str]:
        """Intervals in one column each, that by resampling in the CSV alone; seeds only where there are several."""
        several = f"{number(self.seed_mean)} ± {number(self.seed_sd)} ({self.seed_values})"
        return {
            "": self.row,
            "System": self.system,
            "Measured %": number(self.value),
            "k/n": "" if self.k is None else f"{self.k:g}/{self.n}",
            "95 % Wilson": span(self.low, self.high),
            "95 % over objects": span(self.clustered_low, self.clustered_high),
            "Chance": number(self.chance),
            "Majority": number(self.majority),
            "Unparsed %": number(self.unparsed, 1),
            "Truncated %": number(self.truncated, 1),
            "Seeds": several if self.seeds and self.seeds > 1 else "",
            "Published 7b": _reference(
                self.published_7b, self.published_7b_n, self.published_7b_low, self.published_7b_high
            ),
            "Published 13b": _reference(
                self.published_13b, self.published_13b_n, self.published_13b_low, self.published_13b_high
            ),
            "Note": self.note,
        }


def accuracy_row(cell: Cell, by_seed: Mapping[int, Sequence[Score]], note: str = "", doubt: str = "") -> AccuracyRow:
    """Measure a cell from its scores, and put the published figures beside it.

    Args:
        by_seed: scores of one measure, at most one a question and seed; without any, the measured cells stay empty.
        note: why they do.
        doubt: what speaks against reading anything into them where they are measured.
    """
    graded = {seed: scores for seed, scores in by_seed.items() if scores}
    every = [score for scores in graded.values() for score in scores]
    one, two = cell.published
    measured = proportion(outcomes(every)) if every else None
    spread = Spread(tuple(_share(s.correct for s in scores) for scores in graded.values())) if every else None
    clustered = measured.clustered if measured else None
    resampled = measured.resampled if measured else None
    return AccuracyRow(
        row=cell.row,
        system=cell.system,
        value=100 * measured.value if measured else None,
        k=round(measured.correct, 2) if measured else None,
        n=measured.n if measured else None,
        low=100 * measured.wilson.low if measured else None,
        high=100 * measured.wilson.high if measured else None,
        clustered_low=100 * clustered.low if clustered else None,
        clustered_high=100 * clustered.high if clustered else None,
        resampled_low=100 * resampled.low if resampled else None,
        resampled_high=100 * resampled.high if resampled else None,
        chance=100 * cell.chance,
        majority=_majority(next(iter(graded.values()))) if every else None,
        unparsed=_share(not s.parsed for s in every) if every else None,
        truncated=_share(s.truncated for s in every) if every else None,
        seeds=len(graded) if every else None,
        seed_mean=spread.mean if spread else None,
        seed_sd=spread.deviation if spread else None,
        seed_values=", ".join(f"{seed}: {v:.2f}" for seed, v in zip(graded, spread.values, strict=True))
        if spread
        else "",
        published_7b=one.value if one else None,
        published_7b_n=one.n if one else None,
        published_7b_low=_ends(one)[0],
        published_7b_high=_ends(one)[1],
        published_13b=two.value if two else None,
        published_13b_n=two.n if two else None,
        published_13b_low=_ends(two)[0],
        published_13b_high=_ends(two)[1],
        note=doubt if every else note,
    )


def outcomes(scores: Iterable[Score]) -> list[Outcome]:
    """By question, the share of its answers (one a seed) that are right."""
    by_question: dict[str, list[Score]] = defaultdict(list)
    for score in scores:
        by_question[score.question_id].append(score)
    return [Outcome(sum(s.correct for s in same) / len(same), same[0].objects) for same in by_question.values()]


def _majority(scores: Sequence[Score]) -> float:
    return 100 * max(Counter(score.expected for score in scores).values()) / len(scores)


def _share(flags: Iterable[bool]) -> float:
    values = list(flags)
    return 100 * sum(values) / len(values)


def _ends(cell: Published | None) -> tuple[float | None, float | None]:
    interval = cell.wilson if cell else None
    return (interval.low, interval.high) if interval else (None, None)


def _reference(value: float | None, n: int | None, low: float | None, high: float | None) -> str:
    return "" if value is None else f"{value:.2f} (n = {n}; {span(low, high)})"
