"""Make or complete the runs of a reproduction from what its stages left on disk.

Stages that DVC restored from its cache wrote nothing while they "ran", and most others finish sooner than MLflow
imports. So runs are made afterwards: one parent a reproduction, one child a stage, found again by their tags and
only ever completed, never doubled.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path

from pipeline.params import Params
from pipeline.tracking.dashboard import KIND, Dashboard, kind
from pipeline.tracking.left import content, folders, points, timing
from pipeline.tracking.parent import Parent
from pipeline.tracking.reproduction import (
    LockEntry,
    PlannedStage,
    digest,
    planned_stages,
    read_lock,
    reproduction_key,
)
from pipeline.tracking.runs import common_tags, parent_name, stage_tags
from pipeline.tracking.store import STAGE, Run, TrackingError, now

logger = logging.getLogger(__name__)

CONTENT = "octopi.content"
"""Tag with the hash of what a child was made from."""


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
        store = Dashboard(params.tracking, root)
        with store.lock():
            return _Publisher(store, params, root, key).publish(lock)
    except TrackingError as error:
        logger.warning("tracking failed, `octopi publish` tries again: %s", error)
        return PublishSummary(reached=False, key=key)


@dataclass(frozen=True)
class _Publisher:
    store: Dashboard
    params: Params
    root: Path
    key: str

    def publish(self, lock: dict[str, LockEntry]) -> PublishSummary:
        known = {run.stage: run for run in reversed(self.store.find(self.key))}
        common = common_tags(self.params, self.root, self.key)
        stages = planned_stages(self.params.plan)
        done = [(stage, lock[stage.title]) for stage in stages if stage.title in lock]
        spans = [ran.span for stage, _ in done if (ran := timing(stage, self.root))]
        begin, end = (min(b for b, _ in spans), max(e for _, e in spans)) if spans else (now(), now())
        parent, fresh = known.get(""), 0
        if parent is None:
            parent = self.store.create(parent_name(self.params, self.key), {**common, STAGE: ""}, begin)
            fresh = 1
        created = updated = 0
        for stage, entry in done:
            run = known.get(stage.title)
            made_from = content(stage, entry, self.root)
            if run and run.status == "FINISHED" and run.tags.get(CONTENT) == made_from:
                continue
            own = {**stage_tags(stage), KIND: kind(stage.title), CONTENT: made_from}
            self._complete(run, parent.run_id, stage, entry, {**common, **own})
            created, updated = created + (run is None), updated + (run is not None)
        entries = {stage.title: entry for stage, entry in done}
        Parent(self.store, self.params, self.root, self.key).complete(parent, common, entries, end)
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
        ran = timing(stage, self.root)
        start, end = ran.span if ran else (now(), now())
        found = points(stage, ran, end, self.root)
        if run is None:
            run = self.store.create(stage.title, tags, start, parent)
        else:
            # A live run holds part of the curve already, or all of it.
            present = self.store.points(run.run_id, {p.name for p in found})
            found = [p for p in found if (p.name, p.step, p.value) not in present]
        data = {path: value for path, value in entry.deps.items() if path.startswith("data/")}
        code = sorted((path, value) for path, value in entry.deps.items() if path not in data)
        tags |= {
            "octopi.restored": str(ran is None).lower(),
            "octopi.lock": entry.digest,
            "octopi.inputs": json.dumps(data),
            "octopi.code": digest(json.dumps(code).encode()),
        }
        params = {name: value for name, value in entry.params.items() if not name.startswith("plan.")}
        self.store.log(run.run_id, found, params, tags)
        self.store.add_datasets(run.run_id, data, "training" if stage.trained else "input")
        for folder, name in folders(stage, self.params, self.root):
            if folder.is_dir():
                self.store.add_folder(run.run_id, folder, name)
        self.store.end(run.run_id, "FINISHED", end)
