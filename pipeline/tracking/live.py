"""Watch a training while it runs: its values go to the run that publishing completes afterwards.

A training must never wait for its tracking, let alone die of it. So everything, MLflow's import included, happens in
a thread behind a queue; the first failure is one warning, and the end of tracking for this training.
"""

from __future__ import annotations

import logging
import os
import queue
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pipeline.params import Params
from pipeline.errors import UserError
from pipeline.tracking.reproduction import PlannedStage, planned_stages, reproduction_key
from pipeline.tracking.runs import common_tags, parent_name, stage_tags
from pipeline.tracking.store import PROCESS, STAGE, Point, Run, Status, Store, now, this_process

logger = logging.getLogger(__name__)


class Logger(Protocol):
    """What a training sees of its tracking."""

    def log(self, step: int, values: Mapping[str, float]) -> None:
        """Note values of one optimiser step; returns at once and raises nothing."""


@contextmanager
def live_run(params: Params, stage: str, root: Path) -> Iterator[Logger]:
    """Log a stage, named as DVC names it (`align@finetuned-all-0`), while the block runs.

    Does nothing where `tracking.live` is off, and in all but the first process of a distributed training. At the end
    it waits `tracking.timeout_seconds` for what is still under way.

    Raises:
        UserError: for a stage that the plan does not have.
    """
    planned = next((s for s in planned_stages(params.plan) if s.title == stage), None)
    if planned is None:
        raise UserError(f"stage {stage} is not in the plan of params.yaml; `octopi scale` writes the plan")
    if not params.tracking.live or os.environ.get("RANK", "0") != "0":
        yield _Silent()
        return
    worker = _Worker(params, planned, root)
    status: Status = "FAILED"
    try:
        yield worker
        status = "FINISHED"
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        worker.close(status)


class _Silent:
    def log(self, step: int, values: Mapping[str, float]) -> None:
        """Nothing to do."""


@dataclass(frozen=True)
class _End:
    status: Status


class _Worker:
    def __init__(self, params: Params, stage: PlannedStage, root: Path) -> None:
        self._params, self._stage, self._root = params, stage, root
        self._queue: queue.SimpleQueue[list[Point] | _End] = queue.SimpleQueue()
        self._given_up = threading.Event()
        # A daemon, so that a hanging call cannot keep the process alive.
        self._thread = threading.Thread(target=self._work, name="tracking", daemon=True)
        self._thread.start()

    def log(self, step: int, values: Mapping[str, float]) -> None:
        if not self._given_up.is_set():
            time = now()
            self._queue.put([Point(name, float(value), step, time) for name, value in values.items()])

    def close(self, status: Status) -> None:
        self._queue.put(_End(status))
        self._thread.join(self._params.tracking.timeout_seconds)
        if self._thread.is_alive():
            self._give_up(f"unfinished after {self._params.tracking.timeout_seconds} s (tracking.timeout_seconds)")

    def _work(self) -> None:
        try:
            store = Store(self._params.tracking, self._root)
            run = self._find_or_create(store)
            end = None
            while end is None:
                points, end = self._waiting()
                if self._given_up.is_set():
                    return
                store.log(run.run_id, points)
            store.end(run.run_id, end.status)
        except Exception as error:  # whatever it is, the training is worth more
            self._give_up(str(error))

    def _waiting(self) -> tuple[list[Point], _End | None]:
        """Everything in the queue, after waiting for the first thing; and the end, if it is there."""
        points: list[Point] = []
        while True:
            item = self._queue.get()
            if isinstance(item, _End):
                return points, item
            points += item
            if self._queue.empty():
                return points, None

    def _find_or_create(self, store: Store) -> Run:
        key = reproduction_key(self._root)
        common = {**common_tags(self._params, self._root, key), PROCESS: this_process()}
        with store.lock():
            known = {run.stage: run for run in reversed(store.find(key))}
            parent = known.get("") or store.create(parent_name(self._params, key), {**common, STAGE: ""}, now())
            run = known.get(self._stage.title)
            if run is None:
                run = store.create(self._stage.title, {**common, **stage_tags(self._stage)}, now(), parent.run_id)
            for again in (parent, run):
                if again.status != "RUNNING":
                    store.reopen(again.run_id)
                store.log(again.run_id, tags={PROCESS: this_process()})
        store.end_abandoned()
        return run

    def _give_up(self, reason: str) -> None:
        if not self._given_up.is_set():
            self._given_up.set()
            logger.warning("tracking is off for %s, `octopi publish` completes its run: %s", self._stage.title, reason)
