"""What a stage left on disk that is worth showing: times, curves, totals, folders. No MLflow."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from pipeline.io import read_json, read_table
from pipeline.params import Params
from pipeline.records import Measurement
from pipeline.tracking.reproduction import LockEntry, PlannedStage, digest
from pipeline.tracking.standings import standings
from pipeline.tracking.store import Point

FORM = "2"
"""Raised when runs get more than before: those of an earlier form are completed once."""


class Timing(BaseModel):
    """What runs/<stage>.json says about the last time the stage really ran; other fields are ignored."""

    model_config = ConfigDict(frozen=True)

    started: datetime
    seconds: float
    startup_seconds: float | None = None
    peak_memory_mb: float | None = None

    @property
    def span(self) -> tuple[int, int]:
        """Begin and end in milliseconds since 1970."""
        begin = int(self.started.timestamp() * 1000)
        return begin, begin + int(self.seconds * 1000)


def timing(stage: PlannedStage, root: Path) -> Timing | None:
    """When the stage ran; None where DVC restored it from its cache."""
    path = root / "runs" / f"{stage.title}.json"
    return Timing.model_validate(read_json(path)) if path.is_file() else None


def content(stage: PlannedStage, entry: LockEntry, root: Path) -> str:
    """The hash of all that a run is made from."""
    files = (f"runs/{stage.title}.json", f"data/metrics/{stage.title}.json")
    parts = [(root / f).read_bytes() if (root / f).is_file() else b"" for f in files]
    return digest(b"\n".join([FORM.encode(), entry.digest.encode(), *parts]))


def points(stage: PlannedStage, ran: Timing | None, time: int, root: Path) -> list[Point]:
    """A training's curve, the stage's totals, what it cost and, of a graded variant, its accuracies."""
    history = root / stage.trained / "history.parquet"
    curve = [
        Point(m.name, m.value, m.step, time)
        for m in (read_table(history, Measurement) if stage.trained and history.is_file() else [])
    ]
    metrics = root / "data" / "metrics" / f"{stage.title}.json"
    values: dict[str, float] = read_json(metrics) if metrics.is_file() else {}
    last = {p.name: p.value for p in curve}
    # A summary under the name of a curve would stand at its step 0, and mostly repeats its end.
    totals = {f"final/{n}" if n in last else n: value for n, value in values.items() if last.get(n) != value}
    if ran:
        fields = ran.model_dump(exclude={"started"}, exclude_none=True)
        totals |= {f"run/{name}": value for name, value in fields.items()}
    if stage.name == "grade":
        for standing in standings(root, stage.key):
            totals |= standing.metrics()
    return [*curve, *at_once(totals, time)]


def at_once(values: Mapping[str, float], time: int) -> list[Point]:
    """Values that have no steps."""
    return [Point(name, float(value), 0, time) for name, value in values.items()]


def folders(stage: PlannedStage, params: Params, root: Path) -> list[tuple[Path, str]]:
    """Folders that are copied to the run, and what they are called there."""
    if stage.name == "lora":
        return [(root / stage.trained, "adapter")]
    if stage.name == "report":
        report = root / "reports" / params.report_name
        return [(report / "tables", "tables"), (report / "figures", "figures")]
    return []
