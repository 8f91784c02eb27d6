"""One experiment of an MLflow server, or of the local database.

Paths are relative to the project's folder, where DVC starts stages, so that the folder may be moved.
"""

from __future__ import annotations

import logging
import os
import re
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Event
from typing import Any, TypeVar

from pipeline.config import Params, TrackingConfig
from pipeline.config.params import main_folder
from pipeline.running.errors import UserError, without_secrets
from pipeline.tracking.chain import ChainStage, settings

logger = logging.getLogger(__name__)
T = TypeVar("T")

MLRUNS = Path("mlruns")
KIND, STAGE, FOLDER, PARENT = "octopi.kind", "octopi.stage", "octopi.folder", "mlflow.parentRunId"
LOCK = "octopi.lock"
"""Tag of a finished stage's run: the hash of its entry in dvc.lock; written last."""

out_of_reach = Event()
"""Set by the first call that fails: this process makes no other, so that a dead server costs its time once."""


class TrackingError(UserError):
    """The tracking server, the database or a file refuses."""


def cause(error: Exception, tracking: TrackingConfig) -> str:
    """What could not be tracked and why, in one line without passwords: what the network or the disk said first, since
    MLflow's own words are about its calls."""
    chain: list[BaseException] = [error]
    while below := chain[-1].__cause__ or (None if chain[-1].__suppress_context__ else chain[-1].__context__):
        chain.append(below)
    first = chain[-1] if any(isinstance(each, OSError) for each in chain) else error
    words, mend = without_secrets(" ".join(str(first).split())), ""
    if re.search(r"\b40[13]\b|PERMISSION_DENIED|UNAUTHENTICATED", words):
        mend = "; set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD to those of the server"
    place = tracking.uri or MLRUNS / "mlflow.db"
    return without_secrets(f"tracking at {place}: {type(first).__name__}: {words[:300]}{mend}")


def attempt(tracking: TrackingConfig, call: Callable[..., T], *args: object) -> T | None:
    """Call, unless tracking has failed before in this process. A failure is only a warning, so that no training is lost
    to it."""
    if not out_of_reach.is_set():
        try:
            return call(*args)
        except Exception as error:
            out_of_reach.set()
            logger.warning("tracking is off, `octopi publish` completes the run: %s", cause(error, tracking))
    return None


class Store:
    """The experiment, by MLflow's client: the fluent calls take a run, a server and tags from the shell's variables."""

    def __init__(self, tracking: TrackingConfig) -> None:
        """Connect, and make the experiment where it is new."""
        # When a server dies, one call of a training, one of the system monitor and one that ends the run may wait.
        seconds = str(max(1, tracking.timeout_seconds // 3))
        os.environ.update(
            MLFLOW_HTTP_REQUEST_MAX_RETRIES="0",
            MLFLOW_HTTP_REQUEST_TIMEOUT=seconds,
            PGCONNECT_TIMEOUT=seconds,
            MLFLOW_DISABLE_TELEMETRY="true",
            MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR="false",
            MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT="true",
        )
        import mlflow.store.db.utils
        from filelock import FileLock

        for name in ("alembic", "mlflow"):
            logging.getLogger(name).setLevel(logging.ERROR)
        # Metrics are logged for the model that MLFLOW_ACTIVE_MODEL_ID names, which this server may not know.
        mlflow.clear_active_model()
        # Ten attempts to open a broken database take 107 s.
        mlflow.store.db.utils.MAX_RETRY_COUNT = 1
        here, home = Path.cwd(), main_folder()
        (home / MLRUNS).mkdir(exist_ok=True)
        if home != here and not MLRUNS.is_symlink():
            MLRUNS.symlink_to(home / MLRUNS)
        self.uri = tracking.uri or f"sqlite:///{MLRUNS.resolve() / 'mlflow.db'}"
        # Several folders may share a server. The local database, which moves with its folder, has experiments' copies.
        folder = f"{socket.gethostname()}:{here}" if tracking.uri else here.relative_to(home).as_posix()
        self.mine = {FOLDER: folder.replace("'", "_")}
        # Longer than anybody publishes; a crash frees the lock.
        self.lock = FileLock(MLRUNS / ".lock", timeout=120)
        # Several first starts at once on a new database break it.
        with self.lock:
            self.client = mlflow.MlflowClient(self.uri, self.uri)
            found = self.client.get_experiment_by_name(tracking.experiment)
            self.experiment = str(found.experiment_id if found else self._make(tracking))
        if found and found.lifecycle_stage != "active":
            mend = f"name another, or restore it: mlflow experiments restore -x {self.experiment}"
            raise TrackingError(f"tracking.experiment: {tracking.experiment} was deleted in MLflow; {mend}")

    def _make(self, tracking: TrackingConfig) -> str:
        from mlflow.entities import ExperimentTag
        from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

        # Without the kind, the dashboard takes the experiment for a chat application's.
        kind = "mlflow.experimentKind", "custom_model_development"
        if tracking.uri:
            return str(self.client.create_experiment(tracking.experiment, tags=dict([kind])))
        # The client makes the path absolute, so that artifacts would stay behind when the folder is moved.
        store = SqlAlchemyStore(self.uri, str(MLRUNS))
        store.artifact_root_uri = (MLRUNS / "artifacts").as_posix()
        return str(store.create_experiment(tracking.experiment, tags=[ExperimentTag(*kind)]))

    def find(self, tags: Mapping[str, str], *conditions: str) -> list[Any]:
        """Runs with all these tags, the youngest first."""
        query = " and ".join([*(f"tags.`{name}` = '{value}'" for name, value in tags.items()), *conditions])
        return list(self.client.search_runs([self.experiment], query, order_by=["attributes.start_time DESC"]))

    def fresh(self, stages: Mapping[str, ChainStage]) -> dict[str, tuple[int, int, Any | None]]:
        """Stages whose last run here has no finished run in MLflow: start, end, and the run that was logged live."""
        found = {}
        for title, stage in stages.items():
            if stage.ran:
                times = "attributes.start_time >= {} and attributes.start_time <= {}".format(*stage.ran)
                run = next(iter(self.find({STAGE: title}, times)), None)
                if run is None or LOCK not in run.data.tags:
                    found[title] = (*stage.ran, run)
        return found

    def kill(self, tags: Mapping[str, str], but: str = "") -> str | None:
        """Mark runs of this folder that nobody will end any more; the youngest of the name `but` is left, and its id
        given."""
        running = self.find({**self.mine, **tags}, "attributes.status = 'RUNNING'")
        left = next((str(run.info.run_id) for run in running if run.info.run_name == but), None)
        for run in running:
            if run.info.run_id != left:
                self.client.set_terminated(run.info.run_id, "KILLED")
        return left

    def open_reproduction(self, params: Params, begin: int) -> str:
        """The reproduction of this folder that nobody published yet, else a new one; those of other scales end."""
        left = self.kill({KIND: "reproduction"}, but=params.report_name)
        return left or self.create(params.report_name, "reproduction", begin, settings(params))

    def create(
        self, name: str, kind: str, start: int, params: Mapping[str, str], tags: Mapping[str, str] | None = None
    ) -> str:
        """Begin a run with these parameters and tags."""
        from mlflow.entities import Param
        from mlflow.utils.git_utils import get_git_commit

        commit = {"mlflow.source.git.commit": get_git_commit(str(Path.cwd())) or "unknown"}
        own = {KIND: kind, **self.mine, "mlflow.user": "octopi", **commit, **(tags or {})}
        run = str(self.client.create_run(self.experiment, start, own, name).info.run_id)
        self.client.log_batch(run, params=[Param(*param) for param in params.items()], synchronous=True)
        return run

    def log(self, run: str, metrics: Sequence[tuple[str, float, int, int]]) -> None:
        """Add metrics: name, value, time and step. In a name, what MLflow does not take becomes a colon."""
        from mlflow.entities import Metric

        taken = [Metric(re.sub(r"[^\w\-./: ]", ":", name), *rest) for name, *rest in metrics]
        # Synchronous, so that a failure shows here.
        self.client.log_batch(run, taken, synchronous=True)

    def finish(self, run: str, end: int, tags: Mapping[str, str]) -> None:
        """Add the tags by which a run is known to be whole, and end it."""
        for name, value in tags.items():
            self.client.set_tag(run, name, value)
        self.client.set_terminated(run, "FINISHED", end)
