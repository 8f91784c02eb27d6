"""MLflow: trainings are logged while they run, everything else by `publish` after the last stage.

A reproduction is a parent run. Below it stand one run a stage that really ran and one a variant whose results are new;
what DVC took from its cache is linked by a tag. Paths are relative to the project's folder, where DVC starts stages, so
that the folder may be moved. MLflow is imported inside functions only: that costs seconds.
"""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
import logging
import os
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from threading import Event
from typing import Any, ParamSpec, TypeVar

import yaml

from pipeline.config import Params, TrackingConfig
from pipeline.errors import UserError
from pipeline.io import read_json, read_table
from pipeline.params import PARAMS_FILE
from pipeline.records import WHOLE, Assignment, Lora, Measurement, Part, Touch, Variant, Video
from pipeline.records import Encoder as EncoderAxis
from pipeline.stage import DATA, RUNS, Stage

logger = logging.getLogger(__name__)
P = ParamSpec("P")
T = TypeVar("T")

MLRUNS = Path("mlruns")
DATABASE, ARTIFACTS, LOCK_FILE = MLRUNS / "mlflow.db", MLRUNS / "artifacts", MLRUNS / ".lock"
REPORTS, CHAIN, CHAIN_LOCK = Path("reports"), Path("dvc.yaml"), Path("dvc.lock")
KIND, STAGE, VARIANT, FOLDER = "octopi.kind", "octopi.stage", "octopi.variant", "octopi.folder"
PROCESS, LOCK, CONTENT, STATE = "octopi.process", "octopi.lock", "octopi.content", "octopi.state"
NOTE, VIEW, PARENT = "mlflow.note.content", "mlflow.sharedViewState.variants", "mlflow.parentRunId"
A_CALL, LONGEST_PARAM, LONGEST_TAG = 100, 6000, 8000
"""MLflow's limits: items a call, and the length of values."""
LOCK_SECONDS = 120
"""Longer than anybody publishes; a crash frees the lock."""

out_of_reach = Event()
"""Set by the first call that fails: this process makes no other, so that a dead server costs its time once."""


class TrackingError(UserError):
    """The tracking server or database is out of reach."""


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def _attempt(call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
    """Call, unless tracking is out of reach already. A failure is one warning: the training is worth more."""
    if out_of_reach.is_set():
        return None
    try:
        return call(*args, **kwargs)
    except Exception as error:
        out_of_reach.set()
        logger.warning("tracking is off, `octopi publish` completes the run: %s", _words(error))
        return None


# ---- trainings ----


@contextmanager
def live(run: Stage) -> Iterator[list[Any]]:
    """Log a training while the block runs: curves by transformers' MLflowCallback, and the machine's load.

    Args:
        run: The stage that trains. Where `tracking.live` is off, MLflow is not even imported.

    Yields:
        The callbacks to give to the Trainer; none where there is nothing to log to, or in a second process.
    """
    if not run.params.tracking.live or os.environ.get("RANK", "0") != "0":
        yield []
        return
    status = "FAILED"
    try:
        yield _attempt(_begin, run) or []
        status = "FINISHED"
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        if mlflow := sys.modules.get("mlflow"):
            _attempt(mlflow.end_run, status)
            with suppress(Exception):
                # Forgets the run where it could not be ended, or MLflow would try again when the process ends.
                mlflow.end_run(status)


def _begin(run: Stage) -> list[Any]:
    store = _Store(run.params.tracking)
    import mlflow

    with store.lock:
        store.end_abandoned(run.name)
        stages = read_stages(run.params)
        parent = store.open_parent(run.params)
        if parent is None:
            fresh = [s.ran.started for s in stages if s.ran and not store.run_of(s)]
            parent = store.create_parent(run.params, min([*fresh, _milliseconds(run.started)]))
        axes = next((s.axes for s in stages if s.title == run.name), {})
        child = store.create(run.name, "stage", _milliseconds(run.started), {STAGE: run.name}, parent)
        store.log(child, params=settings(run.params) | axes)
    mlflow.set_tracking_uri(store.uri)
    # What becomes the active run here is the one that the Trainer's callback logs to.
    mlflow.start_run(run_id=child, log_system_metrics=True)
    return [_callback()]


def _callback() -> Any:
    from transformers.integrations import MLflowCallback

    from pipeline.training import measured

    class Callback(MLflowCallback):
        """Logs the same names as history.parquet; at once, not behind a queue, so that a failure shows."""

        def setup(self, args: Any, state: Any, model: Any) -> None:
            _attempt(super().setup, args, state, model)
            self._async_log = False
            self._initialized = True

        def on_log(self, args: Any, state: Any, control: Any, logs: Any, model: Any = None, **more: Any) -> None:
            if values := measured(logs):
                _attempt(super().on_log, args, state, control, values, model, **more)

    return Callback()


# ---- what lies on disk ----


@dataclass(frozen=True)
class Ran:
    """The last time that a stage really ran."""

    started: int
    """Milliseconds since 1970, as all times here."""
    ended: int
    metrics: Mapping[str, float]
    """The stage's own, and `run/seconds`, `run/startup_seconds`, `run/peak_memory_mb`."""


@dataclass(frozen=True)
class ChainStage:
    """A stage of dvc.yaml with one value a matrix axis."""

    title: str
    """As DVC names it, e.g. `align@finetuned-all-0`."""
    axes: Mapping[str, str]
    lock: str
    """Hash of its entry in dvc.lock; empty where it did not run yet with these parameters."""
    outs: Mapping[str, str]
    """Path to hash of what it made."""
    ran: Ran | None
    """None where DVC restored it on a machine that it never ran on."""


def settings(params: Params) -> dict[str, str]:
    """Resolved parameters by dotted key; lists as JSON."""
    return dict(_flatten(params.model_dump(mode="json")))


def read_stages(params: Params) -> list[ChainStage]:
    """The stages of dvc.yaml, in its order and without `publish`, as dvc.lock and runs/ know them.

    Raises:
        UserError: where one of the two files is missing or not YAML.
    """
    chain, entries = (_read_yaml(path).get("stages") or {} for path in (CHAIN, CHAIN_LOCK))
    today, values = settings(params), params.model_dump(mode="json")
    found = []
    for name, stage in chain.items():
        matrix = {axis: _resolve(choices, values) for axis, choices in stage.get("matrix", {}).items()}
        for choice in itertools.product(*matrix.values()) if name != "publish" else ():
            title = f"{name}@{'-'.join(map(str, choice))}" if matrix else name
            entry = entries.get(title) or {}
            made_with = dict(_flatten((entry.get("params") or {}).get(str(PARAMS_FILE)) or {}))
            if not made_with.items() <= today.items():
                entry = {}
            found.append(
                ChainStage(
                    title,
                    dict(zip(matrix, map(str, choice), strict=True)),
                    _digest(entry) if entry else "",
                    {out["path"]: str(out.get("md5")) for out in entry.get("outs") or ()},
                    _read_run(RUNS / f"{title}.json"),
                )
            )
    return found


def _read_run(path: Path) -> Ran | None:
    if not path.is_file():
        return None
    run = read_json(path)
    costs = {f"run/{name}": run[name] for name in ("seconds", "startup_seconds", "peak_memory_mb")}
    started, ended = (_milliseconds(datetime.fromisoformat(run[end]).timestamp()) for end in ("started", "ended"))
    return Ran(started, ended, {**run["metrics"], **costs})


def accuracies(params: Params) -> dict[str, dict[str, float]]:
    """Metrics of each variant by its key, from the report's scores.csv: whatever tasks it has.

    `accuracy/PC` is the share of right answers (0 to 1), `low/PC` and `high/PC` its interval, `swapped/PC` the share
    with another object's video; parts of an answer are named like `accuracy/OPD.hardness`.
    """
    path = REPORTS / params.report_name / "scores.csv"
    found: dict[str, dict[str, float]] = {}
    if not path.is_file():
        return found
    with path.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            if not row["lora"] or not row["seed"].isdigit():
                continue
            task = row["task"] if row["measure"] in WHOLE else f"{row['task']}.{row['measure']}"
            real = row["touch"] == Touch.REAL
            cells = {f"accuracy/{task}" if real else f"{row['touch']}/{task}": row["accuracy"]}
            if real:
                cells |= {f"low/{task}": row["low"], f"high/{task}": row["high"]}
            key = "-".join(row[axis] for axis in ("encoder", "lora", "opd", "seed"))
            found.setdefault(key, {}).update({name: float(cell) for name, cell in cells.items() if cell})
    return found


def _artifacts(variant: Variant) -> list[tuple[Path, str]]:
    """What a variant is made of and what it said: files and folders, with their place among the artifacts."""
    trained = DATA / "models"
    key = f"{variant.encoder}-{variant.opd}-{variant.seed}"
    found = [(DATA / "answers" / variant.key, "predictions"), (trained / variant.lora / key, "model")]
    if variant.lora is Lora.WITH:
        found.append((trained / Lora.WITHOUT / key, "alignment"))
    if variant.encoder is EncoderAxis.FINETUNED:
        found.append((DATA / "encoder" / str(variant.seed) / "encoder.safetensors", "encoder"))
    return [(path, place) for path, place in found if path.exists()]


def _flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value)


def _resolve(choices: Any, values: Any) -> list[Any]:
    """The list that a matrix axis names, like `${ablation.seeds}`."""
    if isinstance(choices, str):
        for key in choices.removeprefix("${").removesuffix("}").split("."):
            values = values[key]
        return list(values)
    return list(choices)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        return yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)) or {}
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; `dvc repro` makes it") from None
    except yaml.YAMLError as error:
        raise UserError(f"{path}: not YAML ({' '.join(str(error).split())}); restore it from Git") from None


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _milliseconds(seconds: float) -> int:
    return int(seconds * 1000)


def _git(*arguments: str) -> str:
    with suppress(OSError, subprocess.SubprocessError):
        command = ["git", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    return "unknown"


def this_process(pid: int | None = None) -> str:
    """Names a process of this machine so that no later one is taken for it; empty where it runs no more."""
    import psutil

    with suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        return f"{socket.gethostname()}:{process.pid}:{process.create_time():.0f}"
    return ""


# ---- the experiment ----


class _Store:
    """One experiment of a server or of the local database."""

    def __init__(self, tracking: TrackingConfig) -> None:
        """Connect, and make the experiment where it is new."""
        # When a server dies, one call of a training, one of the system monitor and one that ends the run may wait.
        seconds = max(1, tracking.timeout_seconds // 3)
        os.environ.update(
            MLFLOW_HTTP_REQUEST_MAX_RETRIES="0",
            MLFLOW_HTTP_REQUEST_TIMEOUT=str(seconds),
            PGCONNECT_TIMEOUT=str(seconds),
            MLFLOW_DISABLE_TELEMETRY="true",
            MLFLOW_LOGGING_LEVEL="ERROR",
            MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT="true",
            # The Trainer's hundred arguments hide the parameters that a person sets.
            MLFLOW_MAX_LOG_PARAMS="0",
        )
        logging.getLogger("alembic").setLevel(logging.ERROR)
        import mlflow.store.db.utils
        from filelock import FileLock
        from sqlalchemy import event
        from sqlalchemy.engine import Engine

        # Ten attempts to open a broken database take 107 s.
        mlflow.store.db.utils.MAX_RETRY_COUNT = 1
        local = not tracking.uri
        self.uri = f"sqlite:///{DATABASE.resolve()}" if local else tracking.uri
        self.folder = "" if local else f"{socket.gethostname()}:{Path.cwd()}"
        if local and not event.contains(Engine, "connect", _do_not_wait_for_the_disk):
            event.listen(Engine, "connect", _do_not_wait_for_the_disk)
        MLRUNS.mkdir(exist_ok=True)
        self.lock = FileLock(LOCK_FILE, timeout=LOCK_SECONDS)
        with self.lock:
            self.client = mlflow.MlflowClient(self.uri)
            found = self.client.get_experiment_by_name(tracking.experiment)
            self.experiment = found.experiment_id if found else self._create(tracking.experiment, local)

    def _create(self, name: str, local: bool) -> str:
        # Without the kind, the dashboard takes the experiment for a chat application's and hides the training views.
        kind = {"mlflow.experimentKind": "custom_model_development"}
        experiment = str(self.client.create_experiment(name, tags=kind | _front_page()))
        if local:
            # MLflow's own calls make the path absolute.
            with closing(sqlite3.connect(DATABASE)) as database, database:
                change = "UPDATE experiments SET artifact_location = ? WHERE experiment_id = ?"
                database.execute(change, (ARTIFACTS.as_posix(), int(experiment)))
        return experiment

    def find(self, tags: Mapping[str, str], *conditions: str) -> list[Any]:
        """Runs with all these tags, the youngest first."""
        query = " and ".join([*(f"tags.`{name}` = '{value}'" for name, value in tags.items()), *conditions])
        return list(self.client.search_runs([self.experiment], query, order_by=["attributes.start_time DESC"]))

    def run_of(self, stage: ChainStage) -> Any | None:
        """The run that was made, live or by publishing, when the stage last really ran."""
        if stage.ran is None:
            return None
        times = (f"attributes.start_time >= {stage.ran.started}", f"attributes.start_time <= {stage.ran.ended}")
        return next(iter(self.find({STAGE: stage.title}, *times)), None)

    def open_parent(self, params: Params) -> str | None:
        """The reproduction of this folder that a training began and nobody published yet. Those of other scales end."""
        mine = None
        for run in self.find({KIND: "reproduction", FOLDER: self.folder}, "attributes.status = 'RUNNING'"):
            if run.info.run_name == params.report_name and mine is None:
                mine = str(run.info.run_id)
            else:
                self.client.set_terminated(run.info.run_id, "KILLED")
        return mine

    def create_parent(self, params: Params, start: int) -> str:
        """Begin a reproduction."""
        return self.create(params.report_name, "reproduction", start, {FOLDER: self.folder})

    def create(self, name: str, kind: str, start: int, tags: Mapping[str, str], parent: str = "") -> str:
        """Begin a run, below `parent` where that is given."""
        tags = {KIND: kind, PROCESS: this_process(), "mlflow.user": "octopi", **tags}
        tags["mlflow.source.git.commit"] = _git("rev-parse", "HEAD")
        if parent:
            tags[PARENT] = parent
        run = self.client.create_run(self.experiment, start_time=start, tags=tags, run_name=name)
        return str(run.info.run_id)

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
        for i in range(0, max(len(points), len(own), len(marks)), A_CALL):
            self.client.log_batch(run, points[i : i + A_CALL], own[i : i + A_CALL], marks[i : i + A_CALL])

    def add_file(self, run: str, path: Path, place: str) -> None:
        """Copy a file or folder to the run's artifacts."""
        (self.client.log_artifacts if path.is_dir() else self.client.log_artifact)(run, str(path), place)

    def end_abandoned(self, stage: str = "") -> None:
        """Mark runs of this machine's dead processes as KILLED: of one stage, or all but reproductions."""
        for run in self.find({STAGE: stage} if stage else {}, "attributes.status = 'RUNNING'"):
            name = run.data.tags.get(PROCESS, "")
            host, _, rest = name.partition(":")
            if run.data.tags[KIND] == "reproduction" or host != socket.gethostname():
                continue
            if this_process(int(rest.split(":")[0])) != name:
                self.client.set_terminated(run.info.run_id, "KILLED")


def _do_not_wait_for_the_disk(connection: Any, _: object) -> None:
    """Waiting for each of a thousand small commits makes most of publishing. A power failure may cost the database, and
    `octopi publish` makes it again."""
    if isinstance(connection, sqlite3.Connection):
        connection.execute("PRAGMA synchronous=OFF")


# ---- publishing ----


def publish(params: Params) -> str:
    """Make the runs of the reproduction in this folder; a second call adds nothing.

    Returns:
        A line that says what was added.

    Raises:
        TrackingError: where the server or database is out of reach.
        UserError: where a file of the reproduction is missing or broken.
    """
    stages = read_stages(params)
    try:
        store = _Store(params.tracking)
        with store.lock:
            return _Publication(store, params, [stage for stage in stages if stage.lock]).publish()
    except UserError:
        raise
    except Exception as error:
        out_of_reach.set()
        raise TrackingError(f"tracking is out of reach, `octopi publish` tries again: {_words(error)}") from error


@dataclass(frozen=True)
class _Publication:
    store: _Store
    params: Params
    stages: list[ChainStage]

    def publish(self) -> str:
        store = self.store
        runs = {stage.title: store.run_of(stage) for stage in self.stages}
        fresh = [s for s in self.stages if s.ran and not (runs[s.title] and LOCK in runs[s.title].data.tags)]
        state = _digest([self.params.report_name, *(stage.lock for stage in self.stages)])
        parent = store.open_parent(self.params)
        if parent is None:
            if not fresh and (same := store.find({KIND: "reproduction", STATE: state})):
                return f"nothing new since run {same[0].info.run_id}"
            begin = min((s.ran.started for s in fresh if s.ran), default=_milliseconds(time.time()))
            parent = store.create_parent(self.params, begin)
        for stage in fresh:
            self._complete(stage, parent, runs[stage.title])
        links = self._links(parent, runs)
        new = self._variants(parent, links)
        self._complete_parent(parent, links | {STATE: state})
        store.end_abandoned()
        ended = [s.ran.ended for s in self.stages if s.ran and f"cached.{_tag(s.title)}" not in links]
        store.client.set_terminated(parent, "FINISHED", max(ended, default=None))
        return f"run {parent} in {store.uri}: {len(fresh)} stages ran, {new} new variants"

    def _complete(self, stage: ChainStage, parent: str, run: Any | None) -> None:
        """A run of a stage that ran; one that was logged live gets what it lacks."""
        assert stage.ran
        began, ended = stage.ran.started, stage.ran.ended
        run_id = (
            run.info.run_id if run else self.store.create(stage.title, "stage", began, {STAGE: stage.title}, parent)
        )
        history = next((path for out in stage.outs if (path := Path(out) / "history.parquet").is_file()), None)
        curve = read_table(history, Measurement) if history else []
        last = max((m.step for m in curve), default=0) or 1
        logged = set(run.data.metrics) if run else set()
        there = {(name, m.step) for name in logged for m in self.store.client.get_metric_history(run_id, name)}
        points = [
            (m.name, m.value, began + (ended - began) * m.step // last, m.step)
            for m in curve
            if (m.name, m.step) not in there
        ]
        # The end of a curve is no point at its step 0.
        names = {m.name for m in curve} | logged
        points += [(name, float(value), ended, 0) for name, value in stage.ran.metrics.items() if name not in names]
        self.store.log(run_id, points, settings(self.params) | stage.axes)
        self.store.log(run_id, tags={LOCK: stage.lock})
        self.store.client.set_terminated(run_id, "FINISHED", ended)

    def _links(self, parent: str, runs: Mapping[str, Any]) -> dict[str, str]:
        """`cached.<stage>` for each stage that did not run: the hash of its entry in dvc.lock, and its earlier run."""
        links = {}
        for stage in self.stages:
            run = runs[stage.title]
            if (stage.ran and run is None) or (run and run.data.tags.get(PARENT) == parent):
                continue
            if run is None or run.data.tags.get(LOCK) != stage.lock:
                run = next(iter(self.store.find({LOCK: stage.lock})), None)
            links[f"cached.{_tag(stage.title)}"] = f"{stage.lock} {run.info.run_id if run else ''}".strip()
        return links

    def _variants(self, parent: str, links: dict[str, str]) -> int:
        """Runs of variants whose results are new, and links to those of the others; return how many are new."""
        scores, new = accuracies(self.params), 0
        answers = {stage.title: stage for stage in self.stages}
        for variant in self.params.ablation.variants():
            stage = answers.get(f"answer@{variant.key}")
            if stage is None:
                continue
            metrics = scores.get(variant.key, {})
            content = _digest([metrics, stage.outs])
            if old := self.store.find({VARIANT: variant.key, CONTENT: content}):
                if old[0].data.tags.get(PARENT) != parent:
                    links[f"variant.{variant.key}"] = old[0].info.run_id
                continue
            now = _milliseconds(time.time())
            begin, end = (stage.ran.started, stage.ran.ended) if stage.ran else (now, now)
            run = self.store.create(variant.key, "variant", begin, {VARIANT: variant.key}, parent)
            axes = {axis: str(value) for axis, value in variant._asdict().items()}
            points = [(name, value, end, 0) for name, value in metrics.items()]
            self.store.log(run, points, settings(self.params) | axes)
            for path, place in _artifacts(variant):
                self.store.add_file(run, path, place)
            self.store.log(run, tags={CONTENT: content})
            self.store.client.set_terminated(run, "FINISHED", end)
            new += 1
        return new

    def _complete_parent(self, parent: str, tags: Mapping[str, str]) -> None:
        """Parameters, the report with its metrics, the data, and what the run stands for."""
        from mlflow.entities import DatasetInput, InputTag

        report = REPORTS / self.params.report_name
        summary = read_json(report / "metrics.json") if (report / "metrics.json").is_file() else {}
        now = _milliseconds(time.time())
        metrics = [(name, float(value), now, 0) for name, value in _flatten(summary)]
        if report.is_dir():
            self.store.add_file(parent, report, "report")
        inputs = [
            DatasetInput(data._to_mlflow_entity(), [InputTag("mlflow.data.context", name)])
            for name, data in _datasets(self.params).items()
        ]
        if inputs:
            self.store.client.log_inputs(parent, inputs)
        cached = sum(name.startswith("cached.") for name in tags)
        own = {
            "octopi.dvc_lock": _digest(CHAIN_LOCK.read_text(encoding="utf-8")),
            "octopi.uncommitted": _git("status", "--porcelain", "--", "pipeline", "stages", "dvc.yaml", "params.yaml"),
            NOTE: f"{len(self.stages) - cached} stages ran, {cached} came from DVC's cache (tags `cached.*`). "
            "Tables and figures: Artifacts, `report/README.md`.",
        }
        self.store.log(parent, metrics, settings(self.params), own | tags)


def _datasets(params: Params) -> dict[str, Any]:
    """Training, validation and test videos as MLflow's datasets; the digest is over names and contents of the files."""
    import pandas as pd
    from mlflow.data import from_pandas

    splits, videos = DATA / "splits.parquet", DATA / "videos.parquet"
    if not (splits.is_file() and videos.is_file()):
        return {}
    contents = {video.video_id: video.sha256 for video in read_table(videos, Video)}
    found = {}
    for part in (Part.TRAIN, Part.VALIDATION, Part.TEST):
        rows = [
            (a.video_id, a.object_id, contents[a.video_id]) for a in read_table(splits, Assignment) if a.part == part
        ]
        frame = pd.DataFrame(sorted(rows), columns=["video_id", "object_id", "sha256"])
        found[part.value] = from_pandas(frame, source=params.data.dir, name=part.value)
    return found


def _tag(title: str) -> str:
    """MLflow allows no @ in names."""
    return title.replace("@", ":")


def _front_page() -> dict[str, str]:
    """The experiment's description, and the table of variants that it leads to, as MLflow's button for sharing a view
    writes it."""
    return {}
