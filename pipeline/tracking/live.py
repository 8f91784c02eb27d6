"""Trainings are logged while they run. MLflow is imported inside functions only: that costs seconds."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from pipeline.config import TrackingConfig
from pipeline.core.stage import Stage
from pipeline.tracking.chain import milliseconds, read_stages, settings
from pipeline.tracking.store import PARENT, STAGE, Store, attempt


@contextmanager
def live(run: Stage) -> Iterator[list[Any]]:
    """Log a training while the block runs: curves by transformers' MLflowCallback, and the machine's load.

    Yields:
        Callbacks for the Trainer: none where `tracking.live` is off (MLflow is then not even imported), in all but the
        first process of a distributed training, and where tracking is out of reach.
    """
    if not run.params.tracking.live or os.environ.get("RANK", "0") != "0":
        yield []
        return
    status = "FAILED"
    try:
        yield attempt(run.params.tracking, _begin, run) or []
        status = "FINISHED"
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        if mlflow := sys.modules.get("mlflow"):
            attempt(run.params.tracking, mlflow.end_run, status)
            with suppress(Exception):
                # Forgets a run that could not be ended, or MLflow would try again when the process ends.
                mlflow.end_run(status)


def _begin(run: Stage) -> list[Any]:
    store = Store(run.params.tracking)
    import mlflow

    stages, started = read_stages(run.params), milliseconds(run.started)
    with store.lock:
        # A stage runs once at a time: what is still running was killed.
        store.kill({STAGE: run.name})
        parent = store.open_parent(run.params)
        if parent is None:
            fresh = [stage.ran[0] for stage in stages if stage.ran and not store.run_of(stage)]
            parent = store.create(run.params.report_name, "reproduction", min([*fresh, started]))
        child = store.create(run.name, "stage", started, {STAGE: run.name, PARENT: parent})
        axes = next((stage.axes for stage in stages if stage.title == run.name), {})
        store.log(child, params=settings(run.params, axes))
    mlflow.set_tracking_uri(store.uri)
    # The callback logs to the active run.
    mlflow.start_run(run_id=child, log_system_metrics=True)
    return [_callback(run.params.tracking)]


def _callback(tracking: TrackingConfig) -> Any:
    from transformers.integrations import MLflowCallback

    from pipeline.training.trainer import measured

    class Callback(MLflowCallback):
        """Logs the names of history.parquet; at once and not behind a queue, so that a failure shows."""

        def setup(self, args: Any, state: Any, model: Any) -> None:
            attempt(tracking, super().setup, args, state, model)
            self._async_log, self._initialized = False, True

        def on_log(self, args: Any, state: Any, control: Any, logs: Any, model: Any = None, **more: Any) -> None:
            if values := measured(logs):
                attempt(tracking, super().on_log, args, state, control, values, model, **more)

    return Callback()
