"""Trainings are logged while they run. MLflow is imported inside functions only: that costs seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pipeline.running.stage import Stage, main_process
from pipeline.tracking.chain import axes, read_stages, settings
from pipeline.tracking.store import PARENT, STAGE, Store, attempt


@contextmanager
def live(run: Stage) -> Iterator[list[Any]]:
    """Log a training while the block runs: its curves, and the machine's load.

    Yields:
        Callbacks for the Trainer: none where `tracking.live` is off (MLflow is then not even imported), in all but the
        first process of a distributed training, and where tracking is out of reach.
    """
    tracking = run.params.tracking
    begun = attempt(tracking, _begin, run) if tracking.live and main_process() else None
    if begun is None:
        yield []
        return
    store, child, monitor = begun
    status = "FAILED"
    try:
        from transformers import TrainerCallback

        from pipeline.training.trainer import logged_figures

        class Curves(TrainerCallback):
            """Logs what history.parquet is to hold, under the same names."""

            def on_log(self, args: Any, state: Any, control: Any, logs: Any = None, **more: Any) -> None:
                now = int(time.time() * 1000)
                points = [(name, value, now, state.global_step) for name, value in logged_figures(logs or {}).items()]
                attempt(tracking, store.log, child, points)

        yield [Curves()]
        status = "FINISHED"
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        monitor.finish()
        attempt(tracking, store.client.set_terminated, child, status)


def _begin(run: Stage) -> tuple[Store, str, Any]:
    """Begin the stage's run below this folder's reproduction, and the watch on the machine's load."""
    store, started = Store(run.params.tracking), int(run.started * 1000)
    from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

    with store.lock:
        # A stage runs once at a time: what is still running was killed.
        store.kill({STAGE: run.name})
        earlier = [began for began, _, _ in store.fresh(read_stages(run.params)).values()]
        parent = store.open_reproduction(run.params, min([started, *earlier]))
        own = settings(run.params, axes(run.name))
        child = store.create(run.name, "stage", started, own, {STAGE: run.name, PARENT: parent})
    monitor = SystemMetricsMonitor(child, tracking_uri=store.uri)
    monitor.start()
    return store, child, monitor
