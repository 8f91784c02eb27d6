"""The run of a reproduction itself: its tags, its figures, its report, and the description that answers questions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pipeline.io import read_json
from pipeline.params import PARAMS_FILE, Params
from pipeline.records import Touch
from pipeline.tracking.committed import VIDEOS, committed
from pipeline.tracking.dashboard import (
    CHANGED,
    CODE,
    COMMIT,
    COMMITTED,
    DATA,
    KIND,
    NOTE,
    PUBLISHED,
    REPRODUCTION,
    Dashboard,
    Reproduction,
)
from pipeline.tracking.left import at_once
from pipeline.tracking.notes import Facts, Moved, note
from pipeline.tracking.reproduction import LockEntry, digest, settings, tree_digest
from pipeline.tracking.runs import parent_name
from pipeline.tracking.standings import standings
from pipeline.tracking.store import LONGEST_TAG, Run, now

REPORT = "octopi.report"
"""Tag with the hash of the report that the run has a copy of."""
HASH_SHOWN = 12
"""Digits that a column has room for; enough to tell two apart."""


@dataclass(frozen=True)
class Parent:
    """Completes the run of the reproduction in `root`."""

    dashboard: Dashboard
    params: Params
    root: Path
    key: str

    def complete(self, run: Run, common: Mapping[str, str], ran: Mapping[str, LockEntry], end: int) -> None:
        """Bring everything on the run up to date; a run that is, is left alone.

        Args:
            run: As found or just made.
            common: The tags of all runs of the reproduction.
            ran: The stages of the plan that have run, by DVC's names.
            end: When the last of them did, in milliseconds since 1970.
        """
        report = self.root / "reports" / self.params.report_name
        file = report / "metrics.json"
        metrics: dict[str, float] = read_json(file) if file.is_file() else {}
        answer = committed(self.params, self.root)
        videos = next((entry.deps[VIDEOS] for entry in ran.values() if VIDEOS in entry.deps), "")
        tags = {
            **common,
            KIND: REPRODUCTION,
            PUBLISHED: run.tags.get(PUBLISHED) or datetime.now(UTC).isoformat(timespec="milliseconds"),
            COMMITTED: answer.answer,
            COMMIT: answer.short,
            CODE: _code(ran),
            DATA: videos[:HASH_SHOWN],
            # The entry of `publish` itself is left out: DVC writes it when publishing is over.
            "octopi.dvc_lock": digest("\n".join(entry.digest for entry in ran.values()).encode()),
            "octopi.params": digest((self.root / PARAMS_FILE).read_bytes()),
            "mlflow.source.name": "dvc repro",
            "mlflow.source.type": "LOCAL",
            REPORT: tree_digest(report),
        }
        values = settings(self.params)
        this = Reproduction(run.run_id, parent_name(self.params, self.key), tags, values, metrics)
        graded = {variant: found for variant in self.params.plan.variants if (found := standings(self.root, variant))}
        before = self._before(this)
        contestants = frozenset(key for key, v in self.params.plan.variants.items() if v.touch is Touch.REAL)
        tags |= {CHANGED: Moved.between(before, this).words if before else "first"}
        tags |= {NOTE: note(Facts(this, before, answer, graded, contestants), self.dashboard)[:LONGEST_TAG]}
        if run.status != "FINISHED" or not tags.items() <= run.tags.items():
            self._write(run, tags, this, report, videos)
            self.dashboard.end(run.run_id, "FINISHED", end)
        self.dashboard.describe(self.key)

    def _write(self, run: Run, tags: Mapping[str, str], this: Reproduction, report: Path, videos: str) -> None:
        points = at_once(this.metrics, now())
        present = self.dashboard.points(run.run_id, this.metrics)
        fresh = [point for point in points if (point.name, point.step, point.value) not in present]
        self.dashboard.log(run.run_id, fresh, this.params, tags)
        if report.is_dir() and run.tags.get(REPORT) != tags[REPORT]:
            self.dashboard.add_folder(run.run_id, report, "report")
        if videos:
            self.dashboard.add_datasets(run.run_id, {VIDEOS: videos}, "input")

    def _before(self, this: Reproduction) -> Reproduction | None:
        """The one of the same scale and source that was published last before this one."""
        every = self.dashboard.reproductions(self.params.scale, self.params.data.source)
        earlier = [r for r in every if r.tags[PUBLISHED] < this.tags[PUBLISHED] and r.run_id != this.run_id]
        return earlier[-1] if earlier else None


def _code(ran: Mapping[str, LockEntry]) -> str:
    """A hash over all that stages read and that is no data of the chain, as they read it last."""
    read = {
        f"{path} {oid}" for entry in ran.values() for path, oid in entry.deps.items() if not path.startswith("data/")
    }
    return digest(json.dumps(sorted(read)).encode())[:HASH_SHOWN]
