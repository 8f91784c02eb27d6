"""The tracking server or local database, reduced to the few calls that are needed. The only importer of MLflow.

Whatever goes wrong behind it (no server, a slow one, a broken database) is a `TrackingError`.
"""

from __future__ import annotations

import logging
import math
import os
import socket
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, ParamSpec, TypeVar

from pipeline.config import TrackingConfig

if TYPE_CHECKING:
    from mlflow import MlflowClient

Status = Literal["RUNNING", "FINISHED", "FAILED", "KILLED"]
P = ParamSpec("P")
T = TypeVar("T")

# MLflow's limits: 1000 items a call, 100 of them parameters and 100 tags; the longest values.
METRICS_A_CALL, PARAMS_A_CALL, TAGS_A_CALL = 800, 100, 100
LONGEST_PARAM, LONGEST_TAG = 6000, 8000
EVERY_RUN = 50_000
LOCK_SECONDS = 120  # longer than anybody holds it; a crash frees it

KEY, STAGE, PROCESS = "octopi.key", "octopi.stage", "octopi.process"


class TrackingError(Exception):
    """Tracking is out of reach; one line that says why."""


@dataclass(frozen=True)
class Point:
    """One value of a metric; `time` in milliseconds since 1970."""

    name: str
    value: float
    step: int
    time: int


@dataclass(frozen=True)
class Run:
    """A run as found or made."""

    run_id: str
    status: str
    tags: Mapping[str, str]

    @property
    def stage(self) -> str:
        """DVC's name of the stage; empty for a parent."""
        return self.tags.get(STAGE, "")

    @property
    def abandoned(self) -> bool:
        """Whether it still counts as running although its process on this machine is gone."""
        host, _, pid = self.tags.get(PROCESS, "").rpartition(":")
        return self.status == "RUNNING" and host == socket.gethostname() and not _alive(int(pid))


def this_process() -> str:
    """What the tag `octopi.process` says while a run is being written."""
    return f"{socket.gethostname()}:{os.getpid()}"


def now() -> int:
    """Milliseconds since 1970."""
    return time.time_ns() // 1_000_000


def local_uri(root: Path) -> str:
    """The database of a reproduction without a server, as an absolute URI."""
    return f"sqlite:///{root.resolve() / 'mlruns' / 'mlflow.db'}"


class Store:
    """One experiment of one server or database. Construct it where seconds do not matter: MLflow is imported here."""

    def __init__(self, tracking: TrackingConfig, root: Path) -> None:
        """Connect to the server or open the database of `root`, and make the experiment where it is new."""
        self.uri = tracking.uri or local_uri(root)
        self._lock_file = root.resolve() / "mlruns" / ".lock"
        self._lock_file.parent.mkdir(parents=True, exist_ok=True)
        _prepare(tracking.timeout_seconds)
        with self.lock():
            self._client: MlflowClient = self._try(_client, self.uri)
            self._experiment = self._try(_experiment, self._client, self.uri, tracking.experiment)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other stages of this working tree out while runs are looked for and made."""
        from filelock import FileLock, Timeout

        try:
            with FileLock(self._lock_file, timeout=LOCK_SECONDS):
                yield
        except Timeout:
            raise TrackingError(f"{self._lock_file} is held by another process") from None

    def find(self, key: str) -> list[Run]:
        """All runs of a reproduction, the oldest first."""
        return self._search(f"tags.`{KEY}` = '{key}'")

    def end_abandoned(self) -> int:
        """End, as KILLED, runs that a dead process of this machine left running; return how many."""
        left = [run for run in self._search("attributes.status = 'RUNNING'") if run.abandoned]
        for run in left:
            self.end(run.run_id, "KILLED")
        return len(left)

    def create(self, name: str, tags: Mapping[str, str], start: int, parent: str = "") -> Run:
        """A new run; `parent` is the id of the run that it is shown below."""
        whole = {**tags, **({"mlflow.parentRunId": parent} if parent else {})}
        run = self._try(self._client.create_run, self._experiment, start_time=start, tags=whole, run_name=name)
        return Run(run.info.run_id, "RUNNING", whole)

    def log(
        self,
        run_id: str,
        points: Sequence[Point] = (),
        params: Mapping[str, str] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """Metrics, parameters and tags in as few calls as MLflow's limits allow."""
        from mlflow.entities import Metric, Param, RunTag

        metrics = [Metric(p.name, p.value, p.time, p.step) for p in points]
        settings = [Param(name, value[:LONGEST_PARAM]) for name, value in (params or {}).items()]
        marks = [RunTag(name, value[:LONGEST_TAG]) for name, value in (tags or {}).items()]
        sizes = ((metrics, METRICS_A_CALL), (settings, PARAMS_A_CALL), (marks, TAGS_A_CALL))
        for i in range(max(math.ceil(len(items) / size) for items, size in sizes)):
            self._try(
                self._client.log_batch,
                run_id,
                metrics=metrics[i * METRICS_A_CALL : (i + 1) * METRICS_A_CALL],
                params=settings[i * PARAMS_A_CALL : (i + 1) * PARAMS_A_CALL],
                tags=marks[i * TAGS_A_CALL : (i + 1) * TAGS_A_CALL],
            )

    def points(self, run_id: str, names: Iterable[str]) -> set[tuple[str, int, float]]:
        """Name, step and value of all that is logged under these names."""
        return {
            (m.key, m.step, m.value) for name in names for m in self._try(self._client.get_metric_history, run_id, name)
        }

    def add_datasets(self, run_id: str, digests: Mapping[str, str], context: str) -> None:
        """Name input files by path and hash, without reading them."""
        from mlflow.entities import Dataset, DatasetInput, InputTag

        tag = InputTag("mlflow.data.context", context)
        inputs = [
            DatasetInput(Dataset(name=path, digest=value[:36], source_type="local", source=path), [tag])
            for path, value in digests.items()
        ]
        if inputs:
            self._try(self._client.log_inputs, run_id, inputs)

    def add_folder(self, run_id: str, folder: Path, name: str) -> None:
        """Copy a folder to the run's artifacts as `name`."""
        self._try(self._client.log_artifacts, run_id, str(folder), name)

    def end(self, run_id: str, status: Status, at: int | None = None) -> None:
        """Set the final status and time."""
        self._try(self._client.set_terminated, run_id, status, end_time=at or now())

    def reopen(self, run_id: str) -> None:
        """Let a run count as running again."""
        self._try(self._client.update_run, run_id, status="RUNNING")

    def _search(self, query: str) -> list[Run]:
        found = self._try(
            self._client.search_runs,
            [self._experiment],
            query,
            max_results=EVERY_RUN,
            order_by=["attributes.start_time ASC"],
        )
        return [Run(r.info.run_id, r.info.status, dict(r.data.tags)) for r in found]

    def _try(self, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        from mlflow.exceptions import MlflowException
        from sqlalchemy.exc import SQLAlchemyError

        try:
            return call(*args, **kwargs)
        except (MlflowException, SQLAlchemyError, OSError) as error:
            reason = " ".join(str(error).split())[:200]
            raise TrackingError(f"{self.uri}: {type(error).__name__}: {reason}") from error


def _prepare(timeout: int) -> None:
    """Tell MLflow, before it is imported, to give up soon, to be quiet and to call nobody."""
    os.environ.update(
        # Two attempts share the time: one lost packet costs no tracking, a dead server no more than the limit.
        MLFLOW_HTTP_REQUEST_MAX_RETRIES="1",
        MLFLOW_HTTP_REQUEST_TIMEOUT=str(max(1, timeout // 2)),
        MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR="0",
        MLFLOW_DISABLE_TELEMETRY="true",
        MLFLOW_LOGGING_LEVEL="ERROR",
    )
    logging.getLogger("alembic").setLevel(logging.ERROR)


def _client(uri: str) -> MlflowClient:
    from mlflow import MlflowClient
    from sqlalchemy import event
    from sqlalchemy.engine import Engine

    if uri.startswith("sqlite:"):
        # Waiting for the disk after each of hundreds of small commits made three quarters of publishing. A power
        # failure may cost the database; `octopi publish` makes it again.
        if not event.contains(Engine, "connect", _do_not_wait_for_the_disk):
            event.listen(Engine, "connect", _do_not_wait_for_the_disk)
        Path(uri.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
    return MlflowClient(uri)


def _experiment(client: MlflowClient, uri: str, name: str) -> str:
    found = client.get_experiment_by_name(name)
    if found:
        return str(found.experiment_id)
    database = Path(uri.removeprefix("sqlite:///"))
    location = (database.parent / "artifacts").as_uri() if uri.startswith("sqlite:") else None
    # Without the tag the dashboard takes an experiment for a chat application's and hides the training views.
    return str(client.create_experiment(name, location, {"mlflow.experimentKind": "custom_model_development"}))


def _do_not_wait_for_the_disk(connection: object, _: object) -> None:
    if isinstance(connection, sqlite3.Connection):
        connection.execute("PRAGMA synchronous=OFF")


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
