"""One experiment of an MLflow server, or of the local database.

Paths are relative to the project's folder, where DVC starts stages, so that the folder may be moved.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import Any, ParamSpec, TypeVar

from pipeline.config import Params, TrackingConfig
from pipeline.config.params import main_folder
from pipeline.core.errors import UserError, without_secrets
from pipeline.tracking.chain import ChainStage, git

logger = logging.getLogger(__name__)
P = ParamSpec("P")
T = TypeVar("T")

MLRUNS = Path("mlruns")
KIND, STAGE, FOLDER, PARENT = "octopi.kind", "octopi.stage", "octopi.folder", "mlflow.parentRunId"
A_CALL, LONGEST_PARAM, LONGEST_TAG = 100, 6000, 8000
"""MLflow's limits: items a call, and the length of values."""
LOCK_SECONDS = 120
"""Longer than anybody publishes; a crash frees the lock."""

out_of_reach = Event()
"""Set by the first call that fails: this process makes no other, so that a dead server costs its time once."""


MEANT = re.compile(
    "MLFLOW_(TRACKING|S3|BOTO|GCS|KERBEROS|MYSQL|SQLALCHEMYSTORE|HTTP|WORKSPACE$|ARTIFACT|MULTIPART|"
    "ENABLE_(PROXY_)?MULTIPART|SYSTEM_METRICS_SAMPL)"
)
"""MLflow's variables that say how a server is reached, who asks and how often: a person's to set. Others would have a
curve logged to another run or experiment, or add to what is recorded."""


class TrackingError(UserError):
    """The tracking server, the database or a file refuses."""


def cause(error: Exception, tracking: TrackingConfig) -> str:
    """What could not be tracked and why, in one line without passwords: the first reason of the network or the disk, as
    MLflow's own words are about its calls."""
    chain: list[BaseException] = [error]
    while below := chain[-1].__cause__ or (None if chain[-1].__suppress_context__ else chain[-1].__context__):
        chain.append(below)
    first = chain[-1] if any(isinstance(each, OSError) for each in chain) else error
    words = without_secrets(" ".join(str(first).split()))
    mend = ""
    if re.search(r"\b40[13]\b|PERMISSION_DENIED|UNAUTHENTICATED", words):
        mend = "; set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD to those of the server"
    place = tracking.uri or MLRUNS / "mlflow.db"
    return without_secrets(f"tracking at {place}: {type(first).__name__}: {words[:300]}{mend}")


def attempt(tracking: TrackingConfig, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
    """Call, unless tracking is out of reach already. A failure is one warning: the training is worth more."""
    if not out_of_reach.is_set():
        try:
            return call(*args, **kwargs)
        except Exception as error:
            out_of_reach.set()
            logger.warning("tracking is off, `octopi publish` completes the run: %s", cause(error, tracking))
    return None


class Store:
    """One experiment of a server, or of the local database."""

    def __init__(self, tracking: TrackingConfig) -> None:
        """Connect, and make the experiment where it is new."""
        for name in [name for name in os.environ if "MLFLOW_" in name and not MEANT.match(name)]:
            del os.environ[name]
        # When a server dies, one call of a training, one of the system monitor and one that ends the run may wait.
        seconds = str(max(1, tracking.timeout_seconds // 3))
        os.environ.update(
            MLFLOW_HTTP_REQUEST_MAX_RETRIES="0",
            MLFLOW_HTTP_REQUEST_TIMEOUT=seconds,
            PGCONNECT_TIMEOUT=seconds,
            MLFLOW_DISABLE_TELEMETRY="true",
            MLFLOW_LOGGING_LEVEL="ERROR",
            MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR="false",
            MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT="true",
            # The Trainer's hundred arguments would hide the parameters that a person sets.
            MLFLOW_MAX_LOG_PARAMS="0",
        )
        logging.getLogger("alembic").setLevel(logging.ERROR)
        import mlflow.store.db.utils
        from filelock import FileLock
        from sqlalchemy import event
        from sqlalchemy.engine import Engine

        # Ten attempts to open a broken database take 107 s.
        mlflow.store.db.utils.MAX_RETRY_COUNT = 1
        if not event.contains(Engine, "connect", _do_not_wait_for_the_disk):
            event.listen(Engine, "connect", _do_not_wait_for_the_disk)
        here, home = Path.cwd(), main_folder()
        (home / MLRUNS).mkdir(exist_ok=True)
        if home != here and not MLRUNS.is_symlink():
            MLRUNS.symlink_to(home / MLRUNS)
        database = MLRUNS.resolve() / "mlflow.db"
        self.uri = tracking.uri or f"sqlite:///{database}"
        # Several folders may share a server. The local database, which moves with its folder, has experiments' copies.
        folder = f"{socket.gethostname()}:{here}" if tracking.uri else here.relative_to(home).as_posix()
        self.mine = {FOLDER: folder.replace("'", "_")}
        self.lock = FileLock(MLRUNS / ".lock", timeout=LOCK_SECONDS)
        # Several first starts at once on a new database break it.
        with self.lock:
            self.client = mlflow.MlflowClient(self.uri, self.uri)
            found = self.client.get_experiment_by_name(tracking.experiment)
            if found:
                self.experiment = str(found.experiment_id)
                return
            # Without the kind, the dashboard takes the experiment for a chat application's.
            kind = {"mlflow.experimentKind": "custom_model_development"}
            self.experiment = str(self.client.create_experiment(tracking.experiment, tags=kind))
            if not tracking.uri:
                # MLflow's own call would make the path absolute.
                with closing(sqlite3.connect(database)) as connection, connection:
                    change = "UPDATE experiments SET artifact_location = ? WHERE experiment_id = ?"
                    connection.execute(change, ((MLRUNS / "artifacts").as_posix(), int(self.experiment)))

    def find(self, tags: Mapping[str, str], *conditions: str) -> list[Any]:
        """Runs with all these tags, the youngest first."""
        query = " and ".join([*(f"tags.`{name}` = '{value}'" for name, value in tags.items()), *conditions])
        return list(self.client.search_runs([self.experiment], query, order_by=["attributes.start_time DESC"]))

    def run_of(self, stage: ChainStage) -> Any | None:
        """The run that was made, live or by publishing, when the stage last really ran."""
        if stage.ran is None:
            return None
        times = (f"attributes.start_time {sign} {time}" for sign, time in zip((">=", "<="), stage.ran, strict=True))
        return next(iter(self.find({STAGE: stage.title}, *times)), None)

    def open_parent(self, params: Params) -> str | None:
        """The reproduction of this folder that a training began and nobody published yet; those of other scales end."""
        name = f"attributes.run_name = '{params.report_name}'"
        running = {KIND: "reproduction", **self.mine}, "attributes.status = 'RUNNING'"
        mine = next((str(run.info.run_id) for run in self.find(*running, name)), None)
        self.kill({KIND: "reproduction"}, but=mine)
        return mine

    def kill(self, tags: Mapping[str, str], but: str | None = None) -> None:
        """Mark runs of this folder that nobody will end any more."""
        for run in self.find({**self.mine, **tags}, "attributes.status = 'RUNNING'"):
            if run.info.run_id != but:
                self.client.set_terminated(run.info.run_id, "KILLED")

    def create(self, name: str, kind: str, start: int, tags: Mapping[str, str] | None = None) -> str:
        """Begin a run."""
        own = {KIND: kind, **self.mine, "mlflow.user": "octopi", **(tags or {})}
        own["mlflow.source.git.commit"] = git("rev-parse", "HEAD")
        return str(self.client.create_run(self.experiment, start, own, name).info.run_id)

    def log(
        self,
        run: str,
        metrics: Sequence[tuple[str, float, int, int]] = (),
        params: Mapping[str, str] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """Add metrics (name, value, time, step), parameters and tags to a run."""
        from mlflow.entities import Metric, Param, RunTag

        points = [Metric(*metric) for metric in metrics]
        own = [Param(name, value[:LONGEST_PARAM]) for name, value in (params or {}).items()]
        marks = [RunTag(name, value[:LONGEST_TAG]) for name, value in (tags or {}).items()]
        for i in range(0, max(map(len, (points, own, marks))), A_CALL):
            self.client.log_batch(run, *(items[i : i + A_CALL] for items in (points, own, marks)))


def _do_not_wait_for_the_disk(connection: Any, _: object) -> None:
    """Waiting for each of a thousand small commits makes most of publishing; a power failure may cost the database, and
    `octopi publish` makes it again."""
    if isinstance(connection, sqlite3.Connection):
        connection.execute("PRAGMA synchronous=OFF")
