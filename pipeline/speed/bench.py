"""Questions that one section of the benchmarks answers by itself."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from pipeline.speed.rows import SpeedRow
from pipeline.speed.sources import Found, Line, Missing, bench_command, bench_file, checked, read_lines


class Case(Line):
    """A case of a section; sections have more columns, and not all of these."""

    case: str
    cost: float
    unit: str
    ratio: float
    error: float | None = None
    low: float | None = None
    high: float | None = None
    frames: float | None = None
    tokens: float | None = None
    flops: float | None = None
    megabytes: float | None = None
    samples: float | None = None
    image: float | None = None
    image_low: float | None = None
    image_high: float | None = None
    error_low: float | None = None
    error_high: float | None = None


@dataclass(frozen=True)
class Cases:
    """Some cases of a section, and which of their columns is the error.

    Rates (`rates`) are turned into costs: more is better in them, and their ratio is how many times the baseline's rate
    they are. Counts of such a section are those of all samples of a repeat.
    """

    section: str
    pattern: str
    """Matches the whole name of a case; its group is the setting."""
    baseline: str
    """The setting that others are held against. Where the section holds all of them against a case of its own, the
    ratios of both are divided: they were taken in the same run."""
    error: str = "error"
    low: str = "low"
    high: str = "high"
    named: tuple[tuple[str, str], ...] = ()
    """Settings that are called otherwise here."""
    rates: str = ""
    """What a sample takes, as the cost's unit, where the section has rates."""

    def read(self, reports: Path, question: str) -> Found | Missing:
        """The rows of a question, in the order of the section."""
        file = bench_file(self.section)
        lines = read_lines(reports / file, Case)
        if not lines:
            return Missing(f"there is no `reports/{file}`, or it is empty; {bench_command(self.section)}")
        found = [(dict(self.named).get(m[1], m[1]), c) for c in lines if (m := re.fullmatch(self.pattern, c.case))]
        base = next((case.ratio for setting, case in found if setting == self.baseline and case.ratio > 0), 1.0)
        rows = [self._row(question, setting, case, base) for setting, case in found if case.ratio > 0 and case.cost > 0]
        return checked(rows, self.baseline, f"From `reports/{file}`.", file, bench_command(self.section))

    def _row(self, question: str, setting: str, case: Case, base: float) -> SpeedRow:
        error = _value(case, self.error)
        # Where a case has no error, its ends are those of the cost.
        low, high = (_value(case, end) if error is not None else None for end in (self.low, self.high))
        samples = (case.samples or 1.0) if self.rates else 1.0
        return SpeedRow(
            question=question,
            setting=setting,
            cost=_figures(1000 / case.cost) if self.rates else case.cost,
            unit=self.rates or case.unit,
            ratio=_figures(base / case.ratio if self.rates else case.ratio / base),
            frames=case.frames,
            tokens=_each(case.tokens, samples),
            flops=_each(case.flops, samples),
            bytes=None if case.megabytes is None else round(1e6 * case.megabytes),
            error=error,
            low=low,
            high=high,
        )


def _value(case: Case, column: str) -> float | None:
    value: float | None = getattr(case, column) if column else None
    return value


def _each(total: float | None, samples: float) -> float | None:
    return None if total is None else _figures(total / samples)


def _figures(value: float) -> float:
    """Four significant figures: as many as the sections have."""
    return float(f"{value:.4g}")
