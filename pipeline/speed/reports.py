"""Questions that need a report's tables: which encoder, and how much to describe before concluding."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

from pipeline.plan import FULL
from pipeline.records import Opd, Task
from pipeline.reporting.answered import FAILED
from pipeline.reporting.encoders import COMBINED
from pipeline.speed.bench import Cases
from pipeline.speed.rows import SpeedRow
from pipeline.speed.sources import Found, Line, Missing, bench_command, bench_file, checked, read_lines

ENCODERS = "encoder/cross_validation.csv"
VARIANTS = "language/ablation.csv"
COMPARE = '`octopi scale small "cross_validation.models=[trees,probe,strong]"` and `dvc repro` measure it'
ABLATE = "`octopi scale small ablation.plan=factorial` and `dvc repro` measure it"
TASKS = (Task.PC, Task.PSS, Task.POM, Task.PSR)
"""Those that can be answered without describing anything."""


class Judged(Line):
    """A row of the encoders' cross-validation. Shares."""

    model: str
    property: str
    accuracy: float
    low: float | None = None
    high: float | None = None
    n: int


class Variant(Line):
    """A row of the ablation: one variant, seed and task. Shares."""

    encoder: str
    lora: str
    opd: str
    task: str
    accuracy: float
    low: float | None = None
    high: float | None = None
    n: int
    chance: float
    tokens: float
    gate: str = ""


@dataclass(frozen=True)
class Encoders:
    """Which encoder: costs from the benchmark, errors from the cross-validation of most of its models, then videos.

    The benchmark's own errors are those that the cross-validation had when it ran; the report may know more by now.
    """

    baseline: str = "strong"

    def read(self, reports: Path, question: str) -> Found | Missing:
        """The rows, in the order of the benchmark."""
        costs = Cases("encoder", r"model, (.+)", self.baseline).read(reports, question)
        if isinstance(costs, Missing):
            return costs
        tables = [
            (name, [line for line in read_lines(reports / name, Judged) if line.property == COMBINED])
            for name in _files(reports, ENCODERS)
        ]
        judged = [(name, lines) for name, lines in tables if lines]
        if not judged:
            return Missing(f"no report has a `{ENCODERS}`; {COMPARE}")
        settings = {row.setting for row in costs.rows}
        # A comparison of two models over many videos must not hide one of them all over fewer.
        name, lines = max(judged, key=lambda table: (len(settings & _models(table[1])), _videos(table[1])))
        by_model = {line.model: line for line in lines}
        rows = [_with_error(row, by_model.get(row.setting)) for row in costs.rows]
        origin = (
            f"Costs from `reports/{bench_file('encoder')}`, errors from `reports/{name}`, {_videos(lines)} videos; "
            "models that only one of them has are left out or have no error."
        )
        return checked(rows, self.baseline, origin, bench_file("encoder"), bench_command("encoder"))


@dataclass(frozen=True)
class Describing:
    """How much to describe: the full system's tokens and errors under each OPD, mean over seeds and tasks.

    The interval's ends are means of the tasks' ends: as wide as if all tasks erred together, so for errors that are
    about normal it holds at least 95 % (a standard deviation of a mean is at most the mean of the deviations).
    Tasks in which the base language model fails on perfect descriptions are left out where there are others.
    """

    baseline: str = Opd.ALL.value

    def read(self, reports: Path, question: str) -> Found | Missing:
        """A row an OPD, from the report with the most of them and then the most answers."""
        tables = [(name, _full(read_lines(reports / name, Variant))) for name in _files(reports, VARIANTS)]
        judged = [(name, lines) for name, lines in tables if len(_modes(lines)) > 1]
        if not judged:
            return Missing(f"no report has two kinds of OPD in its `{VARIANTS}`; {ABLATE}")
        name, lines = max(judged, key=lambda table: (len(_modes(table[1])), sum(line.n for line in table[1])))
        shared = [t.value for t in TASKS if len(_modes(x for x in lines if x.task == t)) == len(_modes(lines))]
        able = [t for t in shared if not any(x.task == t and x.gate.startswith(FAILED) for x in lines)]
        tasks = able or shared
        if not tasks:
            return Missing(f"no task of `reports/{name}` was answered under every OPD; {ABLATE}")
        chosen = [line for line in lines if line.task in tasks]
        base = _tokens([x for x in chosen if x.opd == self.baseline], tasks)
        modes = [opd for opd in Opd if _tokens([x for x in chosen if x.opd == opd], tasks) > 0]
        rows = [_pooled(question, opd, [x for x in chosen if x.opd == opd], tasks, base) for opd in modes]
        left = "; the base language model fails in the others, touch or not" if len(tasks) < len(shared) else ""
        guess = 1 - _over_tasks([(x.task, x.chance) for x in chosen], tasks)
        beaten = any(row.error is not None and row.error < guess for row in rows)
        origin = (
            f"From `reports/{name}`, mean over {', '.join(tasks)}{left}. Guessing evenly is wrong in {guess:.3f}"
            f"{'' if beaten else ', and no setting is better: what is recommended is cheap, and that is all'}."
        )
        return checked(rows, self.baseline, origin, name, ABLATE)


def _files(reports: Path, name: str) -> list[str]:
    """A table in all reports, by the reports' names."""
    return sorted(path.relative_to(reports).as_posix() for path in reports.glob(f"*/{name}"))


def _models(lines: Iterable[Judged]) -> set[str]:
    return {line.model for line in lines}


def _videos(lines: Iterable[Judged]) -> int:
    return max(line.n for line in lines)


def _with_error(row: SpeedRow, judged: Judged | None) -> SpeedRow:
    if judged is None:
        return replace(row, error=None, low=None, high=None)
    ends = (None if end is None else round(1 - end, 4) for end in (judged.high, judged.low))
    return replace(row, error=round(1 - judged.accuracy, 4), low=next(ends), high=next(ends))


def _full(lines: Iterable[Variant]) -> list[Variant]:
    """The full system's rows: fine-tuned encoder, with LoRA."""
    return [x for x in lines if (x.encoder, x.lora) == FULL[:2]]


def _modes(lines: Iterable[Variant]) -> frozenset[str]:
    return frozenset(line.opd for line in lines)


def _pooled(question: str, opd: str, lines: Sequence[Variant], tasks: Sequence[str], base: float) -> SpeedRow:
    error = 1 - _over_tasks([(x.task, x.accuracy) for x in lines], tasks)
    lows = [(x.task, x.low) for x in lines if x.low is not None]
    highs = [(x.task, x.high) for x in lines if x.high is not None]
    # One task without an interval, and the mean has none.
    whole = len(lows) == len(highs) == len(lines)
    tokens = _tokens(lines, tasks)
    return SpeedRow(
        question=question,
        setting=opd,
        cost=round(tokens, 2),
        unit="tokens an answer",
        ratio=round(tokens / base, 4) if base else 1.0,
        tokens=round(tokens, 2),
        error=round(error, 4),
        low=round(1 - _over_tasks(highs, tasks), 4) if whole else None,
        high=round(1 - _over_tasks(lows, tasks), 4) if whole else None,
    )


def _tokens(lines: Sequence[Variant], tasks: Sequence[str]) -> float:
    """An answer; 0 where there is none."""
    return _over_tasks([(x.task, x.tokens) for x in lines], tasks) if lines else 0.0


def _over_tasks(values: Sequence[tuple[str, float]], tasks: Sequence[str]) -> float:
    """The mean over tasks of each task's mean over seeds."""
    return fmean(fmean(value for task, value in values if task == own) for own in tasks)
