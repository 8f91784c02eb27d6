"""Make or complete the runs of a reproduction from what its stages left on disk.

Stages that DVC restored from its cache wrote nothing while they "ran", and most others finish sooner than MLflow
imports. So runs are made afterwards: one parent a reproduction, one child a stage, found again by their tags and
only ever completed, never doubled.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from pipeline.artifacts import read_json, read_table
from pipeline.config import PARAMS_FILE, Params
from pipeline.records import Measurement
from pipeline.tracking.reproduction import (
    LockEntry,
    PlannedStage,
    digest,
    planned_stages,
    read_lock,
    reproduction_key,
    settings,
    tree_digest,
)
from pipeline.tracking.runs import common_tags, parent_name, stage_tags
from pipeline.tracking.store import STAGE, Point, Run, Store, TrackingError, now

logger = logging.getLogger(__name__)

CONTENT, REPORT = "octopi.content", "octopi.report"
"""Tags with the hash of what a child was made from, and of the report on the parent."""


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


@dataclass(frozen=True)
class PublishSummary:
    """What publishing did; all counts are of runs."""

    reached: bool
    """False where the server could not be reached; the rest then tells how far publishing came."""
    key: str
    """The reproduction's key, the tag `octopi.key` of its runs."""
    uri: str = ""
    created: int = 0
    updated: int = 0
    unchanged: int = 0
    killed: int = 0
    """Runs of dead processes that were ended."""
    missing: tuple[str, ...] = ()
    """Stages of the plan that DVC has not run yet with these parameters."""


def publish(params: Params, root: Path) -> PublishSummary:
    """Make, complete or leave alone the runs of the reproduction in `root`; a second call adds no run.

    A server that is down costs one warning.

    Raises:
        UserError: where dvc.lock or a metrics file is missing or broken.
    """
    key, lock = reproduction_key(root), read_lock(root)
    try:
        store = Store(params.tracking, root)
        with store.lock():
            return _Publisher(store, params, root, key).publish(lock)
    except TrackingError as error:
        logger.warning("tracking failed, `octopi publish` tries again: %s", error)
        return PublishSummary(reached=False, key=key)


@dataclass(frozen=True)
class _Publisher:
    store: Store
    params: Params
    root: Path
    key: str

    def publish(self, lock: dict[str, LockEntry]) -> PublishSummary:
        known = {run.stage: run for run in reversed(self.store.find(self.key))}
        common = common_tags(self.params, self.root, self.key)
        stages = planned_stages(self.params.plan)
        done = [(stage, lock[stage.title]) for stage in stages if stage.title in lock]
        spans = [timing.span for stage, _ in done if (timing := self._timing(stage))]
        begin, end = (min(b for b, _ in spans), max(e for _, e in spans)) if spans else (now(), now())
        parent, fresh = known.get(""), 0
        if parent is None:
            parent = self.store.create(parent_name(self.params, self.key), {**common, STAGE: ""}, begin)
            fresh = 1
        created = updated = 0
        for stage, entry in done:
            run = known.get(stage.title)
            content = self._content(stage, entry)
            if run and run.status == "FINISHED" and run.tags.get(CONTENT) == content:
                continue
            self._complete(run, parent.run_id, stage, entry, {**common, **stage_tags(stage), CONTENT: content})
            created, updated = created + (run is None), updated + (run is not None)
        self._complete_parent(parent, common, lock, end)
        return PublishSummary(
            reached=True,
            key=self.key,
            uri=self.store.uri,
            created=created + fresh,
            updated=updated,
            unchanged=len(done) - created - updated + (1 - fresh),
            killed=self.store.end_abandoned(),
            missing=tuple(stage.title for stage in stages if stage.title not in lock),
        )

    def _complete(
        self, run: Run | None, parent: str, stage: PlannedStage, entry: LockEntry, tags: dict[str, str]
    ) -> None:
        timing = self._timing(stage)
        start, end = timing.span if timing else (now(), now())
        points = self._points(stage, timing, end)
        if run is None:
            run = self.store.create(stage.title, tags, start, parent)
        else:
            # A live run holds part of the curve already, or all of it.
            present = self.store.points(run.run_id, {p.name for p in points})
            points = [p for p in points if (p.name, p.step, p.value) not in present]
        data = {path: value for path, value in entry.deps.items() if path.startswith("data/")}
        code = sorted((path, value) for path, value in entry.deps.items() if path not in data)
        tags |= {
            "octopi.restored": str(timing is None).lower(),
            "octopi.lock": entry.digest,
            "octopi.inputs": json.dumps(data),
            "octopi.code": digest(json.dumps(code).encode()),
        }
        params = {name: value for name, value in entry.params.items() if not name.startswith("plan.")}
        self.store.log(run.run_id, points, params, tags)
        self.store.add_datasets(run.run_id, data, "training" if stage.trained else "input")
        for folder, name in self._folders(stage):
            if folder.is_dir():
                self.store.add_folder(run.run_id, folder, name)
        self.store.end(run.run_id, "FINISHED", end)

    def _complete_parent(self, parent: Run, common: dict[str, str], lock: dict[str, LockEntry], end: int) -> None:
        report = self.root / "reports" / self.params.report_name
        tags = {
            **common,
            "octopi.dvc_lock": digest((self.root / "dvc.lock").read_bytes()),
            "octopi.params": digest((self.root / PARAMS_FILE).read_bytes()),
            REPORT: tree_digest(report),
        }
        if parent.status == "FINISHED" and tags.items() <= parent.tags.items():
            return
        metrics = report / "metrics.json"
        points = _points(read_json(metrics), now()) if metrics.is_file() else []
        self.store.log(parent.run_id, points, settings(self.params), tags)
        if report.is_dir() and parent.tags.get(REPORT) != tags[REPORT]:
            self.store.add_folder(parent.run_id, report, "report")
        videos = next((e.deps["data/videos.parquet"] for e in lock.values() if "data/videos.parquet" in e.deps), "")
        if videos:
            self.store.add_datasets(parent.run_id, {"data/videos.parquet": videos}, "input")
        self.store.end(parent.run_id, "FINISHED", end)

    def _content(self, stage: PlannedStage, entry: LockEntry) -> str:
        files = (f"runs/{stage.title}.json", f"data/metrics/{stage.title}.json")
        parts = [(self.root / f).read_bytes() if (self.root / f).is_file() else b"" for f in files]
        return digest(b"\n".join([entry.digest.encode(), *parts]))

    def _timing(self, stage: PlannedStage) -> Timing | None:
        path = self.root / "runs" / f"{stage.title}.json"
        return Timing.model_validate(read_json(path)) if path.is_file() else None

    def _points(self, stage: PlannedStage, timing: Timing | None, time: int) -> list[Point]:
        history = self.root / stage.trained / "history.parquet"
        curve = [
            Point(m.name, m.value, m.step, time)
            for m in (read_table(history, Measurement) if stage.trained and history.is_file() else [])
        ]
        metrics = self.root / "data" / "metrics" / f"{stage.title}.json"
        values: dict[str, float] = read_json(metrics) if metrics.is_file() else {}
        last = {p.name: p.value for p in curve}
        # A summary under the name of a curve would stand at its step 0, and mostly repeats its end.
        totals = {f"final/{n}" if n in last else n: value for n, value in values.items() if last.get(n) != value}
        if timing:
            fields = timing.model_dump(exclude={"started"}, exclude_none=True)
            totals |= {f"run/{name}": value for name, value in fields.items()}
        return [*curve, *_points(totals, time)]

    def _folders(self, stage: PlannedStage) -> list[tuple[Path, str]]:
        if stage.name == "lora":
            return [(self.root / stage.trained, "adapter")]
        if stage.name == "report":
            report = self.root / "reports" / self.params.report_name
            return [(report / "tables", "tables"), (report / "figures", "figures")]
        return []


def _points(values: dict[str, float], time: int) -> list[Point]:
    return [Point(name, float(value), 0, time) for name, value in values.items()]
