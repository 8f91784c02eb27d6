"""What sections share: times, errors with intervals, rows of reports/speed_error.csv."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median, stdev
from time import perf_counter
from typing import TypeVar

import numpy as np
from pydantic import Field, ValidationError

from pipeline.core.io import write_csv
from pipeline.core.records import Record
from pipeline.core.runtime import cores, processor
from pipeline.evaluation.intervals import accuracy_interval
from pipeline.evaluation.rows import ScoreRow
from pipeline.running.errors import UserError, first_problem

CSV = Path("reports") / "speed_error.csv"
WRONG = "share of videos of unseen objects of which not every property is right"
R = TypeVar("R")


def timed(run: Callable[[], R]) -> tuple[R, float]:
    """What one call gives, and the milliseconds that it takes."""
    started = perf_counter()
    found = run()
    return found, 1000 * (perf_counter() - started)


def machine(threads: str) -> str:
    """The processor, how many cores there are and how many were used."""
    return f"{processor()}, {cores()} cores, {threads}"


@dataclass(frozen=True)
class Error:
    """An error, and the ends of its interval where there are objects enough."""

    error: float
    low: float | None = None
    high: float | None = None
    n: int | None = None
    """Videos, answers or scenes that it is over."""

    @classmethod
    def of(cls, score: ScoreRow) -> Error:
        """1 - accuracy of a row of scores.csv."""
        low, high = (None if end is None else 1 - end for end in (score.high, score.low))
        return cls(1 - score.accuracy, low, high, score.n)


def share_of(wrong: Sequence[float] | np.ndarray, objects: Sequence[tuple[str, ...]]) -> Error:
    """The share of wrong answers, with the reports' interval; `wrong` is 0 (right) to 1 for each question or video."""
    values = np.array(wrong, dtype=np.float64)
    low, high = accuracy_interval(values, objects) or (None, None)
    return Error(float(values.mean()), low, high, len(values))


def mean_of(values: Sequence[float], objects: Sequence[str]) -> Error:
    """The mean of a non-negative quantity, with Student's t over the objects' means; each object has as many values."""
    from scipy.stats import t

    means = [fmean(v for v, o in zip(values, objects, strict=True) if o == own) for own in sorted(set(objects))]
    if len(means) < 2:
        return Error(fmean(values), n=len(values))
    half = float(t.ppf(0.975, len(means) - 1)) * stdev(means) / len(means) ** 0.5
    return Error(fmean(means), max(fmean(means) - half, 0.0), fmean(means) + half, len(values))


class Row(Record):
    """One setting of a question."""

    question: str
    setting: str
    cost: float = Field(ge=0)
    """Median over the repeats, in `unit`."""
    unit: str
    cost_ratio: float = Field(ge=0)
    """Cost divided by that of the question's baseline: the median of this ratio over the repeats."""
    frames: float | None = None
    """Frames per video."""
    megabytes: float | None = None
    """Peak of memory, in 10^6 bytes."""
    error: float | None = None
    """What `error_of` says; None where all settings compute the same."""
    error_of: str = ""
    low: float | None = None
    """Ends of the error's 95 % interval over objects."""
    high: float | None = None
    n: int | None = None
    """Videos, answers or scenes that the error is over."""
    front: bool | None = None
    """Whether the setting is on its question's Pareto front of cost and error; None without an error."""
    machine: str = ""


def front(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which points are on the Pareto front: no other is at least as good in both and better in one."""
    points = list(zip(costs, errors, strict=True))
    return [not any(c <= cost and e <= error and (c, e) != (cost, error) for c, e in points) for cost, error in points]


def make_rows(
    question: str,
    costs: Mapping[str, Sequence[float]],
    *,
    unit: str,
    baseline: str,
    errors: Mapping[str, Error] | None = None,
    error_of: str = "",
    counts: Mapping[str, Mapping[str, float]] | None = None,
    machine: str = "",
) -> list[Row]:
    """The rows of a question, each told whether it is on the front.

    Args:
        costs: By setting, one value per repeat in `unit`; the n-th values of all settings were measured together.
        baseline: The setting whose ratio is 1.
        errors: By setting; a setting without an error is not on the front.
        counts: By setting, the values of count columns (`frames`, `megabytes`) by their names.
    """
    errors, counts = errors or {}, counts or {}
    rows = []
    for name, own in costs.items():
        ratio = median(c / b for c, b in zip(own, costs[baseline], strict=True))
        values = {"cost": median(own), "cost_ratio": ratio, **counts.get(name, {})}
        if name in errors:
            values |= {column: value for column, value in vars(errors[name]).items() if value is not None}
        rounded = {column: float(f"{value:.4g}") for column, value in values.items()}
        named = {"question": question, "setting": name, "unit": unit, "machine": machine}
        rows.append(Row.model_validate({**named, "error_of": error_of if errors else "", **rounded}))
    measured = [row for row in rows if row.error is not None]
    ahead = iter(front([row.cost_ratio for row in measured], [row.error or 0.0 for row in measured]))
    return [row.model_copy(update={"front": None if row.error is None else next(ahead)}) for row in rows]


def read_rows(path: Path) -> list[Row]:
    """All rows of a table; none where there is no file.

    Raises:
        UserError: for a file that is no such table.
    """
    if not path.is_file():
        return []
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            return [Row.model_validate({k: v for k, v in line.items() if v}) for line in csv.DictReader(stream)]
    except ValueError as error:
        what = first_problem(error) if isinstance(error, ValidationError) else error
        raise UserError(f"{path}: not a table of costs and errors ({what}); restore it from Git") from None


def merge(path: Path, rows: Sequence[Row]) -> list[Row]:
    """Put the rows of some questions into the table, in place of what it had of them; returns the whole table.

    Other questions keep their rows and their place; new ones come last.
    """
    old, answered = read_rows(path), {row.question for row in rows}
    merged = [row for row in old if row.question not in answered] + [*rows]
    places = list(dict.fromkeys(row.question for row in [*old, *rows]))
    table = sorted(merged, key=lambda row: places.index(row.question))
    write_csv(path, Row, table)
    return table
