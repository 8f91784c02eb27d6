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
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import reduce
from pathlib import Path
from threading import Event
from typing import Any, ParamSpec, TypeVar

import yaml

from pipeline.config import Params, TrackingConfig
from pipeline.errors import UserError
from pipeline.io import read_json, read_table
from pipeline.params import PARAMS_FILE
from pipeline.records import Encoder, Graded, Lora, Measurement, Part, Touch, Variant, Video
from pipeline.registry import log_model, packaged, register
from pipeline.stage import DATA, RUNS, Stage
from pipeline.tasks import TASKS

logger = logging.getLogger(__name__)
P = ParamSpec("P")
T = TypeVar("T")

MLRUNS, REPORTS, CHAIN, CHAIN_LOCK = Path("mlruns"), Path("reports"), Path("dvc.yaml"), Path("dvc.lock")
KIND, STAGE, VARIANT, FOLDER = "octopi.kind", "octopi.stage", "octopi.variant", "octopi.folder"
LOCK, CONTENT, STATE = "octopi.lock", "octopi.content", "octopi.state"
"""Tags with what a finished stage, variant and reproduction were made from; written last."""
NOTE, VIEW, PARENT = "mlflow.note.content", "mlflow.sharedViewState.variants", "mlflow.parentRunId"
A_CALL, LONGEST_PARAM, LONGEST_TAG = 100, 6000, 8000
"""MLflow's limits: items a call, and the length of values."""
LOCK_SECONDS = 120
"""Longer than anybody publishes; a crash frees the lock."""

out_of_reach = Event()
"""Set by the first call that fails: this process makes no other, so that a dead server costs its time once."""


class TrackingError(UserError):
    """The tracking server or database is out of reach."""


def _attempt(call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
    """Call, unless tracking is out of reach already. A failure is one warning: the training is worth more."""
    if not out_of_reach.is_set():
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

    Yields:
        Callbacks for the Trainer: none where `tracking.live` is off (MLflow is then not even imported), in all but the
        first process of a distributed training, and where tracking is out of reach.
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
                # Forgets a run that could not be ended, or MLflow would try again when the process ends.
                mlflow.end_run(status)


def _begin(run: Stage) -> list[Any]:
    store = _Store(run.params.tracking)
    import mlflow

    stages, started = read_stages(run.params), _milliseconds(run.started)
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
    return [_callback()]


def _callback() -> Any:
    from transformers.integrations import MLflowCallback

    from pipeline.training.trainer import measured

    class Callback(MLflowCallback):
        """Logs the names of history.parquet; at once and not behind a queue, so that a failure shows."""

        def setup(self, args: Any, state: Any, model: Any) -> None:
            _attempt(super().setup, args, state, model)
            self._async_log, self._initialized = False, True

        def on_log(self, args: Any, state: Any, control: Any, logs: Any, model: Any = None, **more: Any) -> None:
            if values := measured(logs):
                _attempt(super().on_log, args, state, control, values, model, **more)

    return Callback()


# ---- what lies on disk ----


@dataclass(frozen=True)
class ChainStage:
    """A stage of dvc.yaml with one value a matrix axis, and the last time that it really ran here."""

    title: str
    """As DVC names it, e.g. `align@finetuned-all-0`."""
    axes: Mapping[str, str]
    lock: str
    """Hash of its entry in dvc.lock; empty where it did not run yet with these parameters."""
    outs: Mapping[str, str]
    """Path to hash of what it made."""
    ran: tuple[int, int] | None
    """Start and end in milliseconds since 1970, as all times here; None where DVC only ever restored it."""
    metrics: Mapping[str, float]
    """The stage's own, and what it cost: `system/seconds`, `system/startup_seconds`, `system/peak_memory_mb`."""


def read_stages(params: Params) -> list[ChainStage]:
    """The stages of dvc.yaml, in its order and without `publish`, as dvc.lock and runs/ know them.

    Raises:
        UserError: where one of the two files is missing, or no YAML of DVC's.
    """
    chain, entries = map(_stages_in, (CHAIN, CHAIN_LOCK))
    chain.pop("publish", None)
    today, values = settings(params), params.model_dump(mode="json")

    def choices(axis: Any) -> list[Any]:
        """A list, or the parameter that is named like `${ablation.seeds}`."""
        return list(reduce(lambda v, key: v[key], axis[2:-1].split("."), values) if isinstance(axis, str) else axis)

    found = []
    for name, stage in chain.items():
        matrix = {axis: choices(value) for axis, value in stage.get("matrix", {}).items()}
        for choice in itertools.product(*matrix.values()):
            title = f"{name}@{'-'.join(map(str, choice))}" if matrix else name
            entry = entries.get(title) or {}
            if not dict(_flatten((entry.get("params") or {}).get(str(PARAMS_FILE)) or {})).items() <= today.items():
                entry = {}
            outs = {out["path"]: str(out.get("md5")) for out in entry.get("outs") or ()}
            axes = dict(zip(matrix, map(str, choice), strict=True))
            found.append(ChainStage(title, axes, _digest(entry) if entry else "", outs, *_last_run(title)))
    return found


def _last_run(title: str) -> tuple[tuple[int, int] | None, dict[str, float]]:
    path = RUNS / f"{title}.json"
    if not path.is_file():
        return None, {}
    run = read_json(path)
    started, ended = (_milliseconds(datetime.fromisoformat(run[end]).timestamp()) for end in ("started", "ended"))
    costs = {f"system/{name}": run[name] for name in ("seconds", "startup_seconds", "peak_memory_mb")}
    return (started, ended), {**run["metrics"], **costs}


def settings(params: Params, axes: Mapping[str, str] | None = None) -> dict[str, str]:
    """Resolved parameters by dotted key, lists as JSON; `axes` come first and in place of those of their name."""
    return {**(axes or {}), **dict(_flatten(params.model_dump(mode="json"))), **(axes or {})}


def accuracies(params: Params) -> dict[str, dict[str, float]]:
    """Metrics of each variant by its key, from the report's scores.csv (of folds, from each fold's own answers).

    `accuracy/PC` is the share of right answers (0 to 1), `low/PC` and `high/PC` its interval, `swapped/PC` the share
    with another object's video; parts of an answer are named like `accuracy/OPD.hardness`.
    """
    found: dict[str, dict[str, float]] = {}
    for row in _score_rows(params):
        if row["lora"] and row["seed"].isdigit():
            whole = TASKS[row["task"]].measure if row["task"] in TASKS else "choice"
            task = row["task"] if row["measure"] == whole else f"{row['task']}.{row['measure']}"
            cells = {f"accuracy/{task}": row["accuracy"], f"low/{task}": row["low"], f"high/{task}": row["high"]}
            if row["touch"] != Touch.REAL:
                cells = {f"{row['touch']}/{task}": row["accuracy"]}
            key = "-".join(row[axis] for axis in Variant._fields)
            found.setdefault(key, {}).update({name: round(float(cell), 4) for name, cell in cells.items() if cell})
    return found


def _score_rows(params: Params) -> Iterator[Mapping[str, str]]:
    path = REPORTS / params.report_name / "scores.csv"
    if params.split.fold_of(0) is None:
        yield from csv.DictReader(path.read_text(encoding="utf-8").splitlines()) if path.is_file() else ()
    elif (DATA / "graded.parquet").is_file():
        from pipeline.evaluation.scores import score_rows
        from pipeline.videos.catalogue import load_catalogue

        # The report pools folds, but a run in the dashboard is one model.
        graded = read_table(DATA / "graded.parquet", Graded)
        each = [g.model_copy(update={"seed": g.trained}) for g in graded]
        for row in score_rows(each, load_catalogue(Path(params.data.catalogue))):
            yield {name: "" if cell is None else str(cell) for name, cell in row}


def _artifacts(variant: Variant) -> Iterator[tuple[Path, str]]:
    """What a variant said and is made of: folders and files, with their place among the artifacts."""
    key = f"{variant.encoder}-{variant.opd}-{variant.seed}"
    yield DATA / "answers" / variant.key, "predictions"
    yield DATA / "models" / variant.lora / key, "model"
    if variant.lora is Lora.WITH:
        yield DATA / "models" / Lora.WITHOUT / key, "alignment"
    if variant.encoder is Encoder.FINETUNED:
        yield DATA / "encoder" / str(variant.seed), "encoder"


def _datasets(params: Params) -> Iterator[tuple[str, Any]]:
    """Training, validation and test videos of each split as MLflow's datasets; digests are over ids and contents."""
    import pandas as pd
    from mlflow.data import from_pandas

    from pipeline.videos.split import read_splits

    videos = DATA / "videos.parquet"
    if not videos.is_file() or not (DATA / "splits").is_dir():
        return
    contents = {video.video_id: video.sha256 for video in read_table(videos, Video)}
    for seed, assignments in read_splits(DATA, params.split, params.ablation.seeds).items():
        fold = params.split.fold_of(seed)
        for part in (Part.TRAIN, Part.VALIDATION, Part.TEST):
            rows = sorted((a.video_id, a.object_id, contents[a.video_id]) for a in assignments if a.part == part)
            frame = pd.DataFrame(rows, columns=["video_id", "object_id", "sha256"])
            name = part.value if fold is None else f"{part}-fold{fold}"
            with warnings.catch_warnings():
                # MLflow has two readers of local folders, both the same, and says so.
                warnings.simplefilter("ignore")
                yield part.value, from_pandas(frame, source=params.data.dir, name=name)


def _stages_in(path: Path) -> dict[str, dict[str, Any]]:
    try:
        found = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; `dvc repro` makes it") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not YAML ({' '.join(str(error).split())}); restore it from Git") from None
    stages = (found.get("stages") or {}) if isinstance(found, dict) else {}
    if not isinstance(stages, dict) or not all(isinstance(stage, dict) for stage in stages.values()):
        raise UserError(f"{path}: not as DVC writes it; restore it from Git")
    return stages


def _flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value)


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _milliseconds(seconds: float) -> int:
    return int(seconds * 1000)


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def _git(*arguments: str) -> str:
    with suppress(OSError, subprocess.SubprocessError):
        command = ["git", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    return "unknown"


# ---- the experiment ----


class _Store:
    """One experiment of a server, or of the local database."""

    def __init__(self, tracking: TrackingConfig) -> None:
        """Connect, and make the experiment where it is new."""
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
        database = MLRUNS.resolve() / "mlflow.db"
        self.uri = tracking.uri or f"sqlite:///{database}"
        # Several folders may share a server; the local database moves with its folder.
        self.mine = {FOLDER: f"{socket.gethostname()}:{Path.cwd()}"} if tracking.uri else {}
        MLRUNS.mkdir(exist_ok=True)
        self.lock = FileLock(MLRUNS / ".lock", timeout=LOCK_SECONDS)
        # Several first starts at once on a new database break it.
        with self.lock:
            self.client = mlflow.MlflowClient(self.uri)
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
        own["mlflow.source.git.commit"] = _git("rev-parse", "HEAD")
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


# ---- publishing ----


def publish(params: Params) -> str:
    """Make the runs of the reproduction in this folder; a second call adds nothing.

    Returns:
        A line that says what was added.

    Raises:
        TrackingError: where the server or database is out of reach.
        UserError: where a file of the reproduction is missing or broken.
    """
    stages = [stage for stage in read_stages(params) if stage.lock]
    try:
        store = _Store(params.tracking)
        with store.lock:
            return _Publication(store, params, stages).publish()
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
        store, now = self.store, _milliseconds(time.time())
        runs = {stage.title: run for stage in self.stages if (run := store.run_of(stage))}
        fresh = [s for s in self.stages if s.ran and not (s.title in runs and LOCK in runs[s.title].data.tags)]
        state = _digest([self.params.report_name, *(stage.lock for stage in self.stages)])
        parent = store.open_parent(self.params)
        if parent is None:
            if not fresh and (same := store.find({KIND: "reproduction", STATE: state})):
                return f"nothing new since run {same[0].info.run_id}"
            begin = min((s.ran[0] for s in fresh if s.ran), default=now)
            parent = store.create(self.params.report_name, "reproduction", begin)
        for stage in fresh:
            self._complete(stage, parent, runs.get(stage.title))
        links = self._cached(parent, runs, fresh)
        ended = [s.ran[1] for s in self.stages if s.ran and _cached_tag(s) not in links]
        new = self._variants(parent, links)
        self._complete_parent(parent, {**links, STATE: state})
        store.client.set_terminated(parent, "FINISHED", max(ended, default=now))
        return f"run {parent} in {store.uri}: {len(ended)} stages ran, {new} variants are new"

    def _complete(self, stage: ChainStage, parent: str, run: Any | None) -> None:
        """A run of a stage that ran; one that was logged live gets what it lacks."""
        began, ended = stage.ran or (0, 0)
        tags = {STAGE: stage.title, PARENT: parent}
        run_id = run.info.run_id if run else self.store.create(stage.title, "stage", began, tags)
        history = next((path for out in stage.outs if (path := Path(out) / "history.parquet").is_file()), None)
        curve = read_table(history, Measurement) if history else []
        steps = max((m.step for m in curve), default=0) or 1
        logged = set(run.data.metrics if run else ())
        there = {(name, m.step) for name in logged for m in self.store.client.get_metric_history(run_id, name)}
        points = [
            (m.name, m.value, began + (ended - began) * m.step // steps, m.step)
            for m in curve
            if (m.name, m.step) not in there
        ]
        # The end of a curve is no point at its step 0.
        logged |= {m.name for m in curve}
        points += [(name, float(value), ended, 0) for name, value in stage.metrics.items() if name not in logged]
        # What it ran with stays, where settings of no result changed since.
        own = {} if run else settings(self.params, stage.axes)
        self.store.log(run_id, points, own)
        self.store.log(run_id, tags={LOCK: stage.lock})
        self.store.client.set_terminated(run_id, "FINISHED", ended)

    def _cached(self, parent: str, runs: Mapping[str, Any], fresh: Sequence[ChainStage]) -> dict[str, str]:
        """For each stage that did not run: the hash of its entry in dvc.lock, and the run that made it."""
        links = {}
        for stage in self.stages:
            run = runs.get(stage.title)
            if stage in fresh or (run and run.data.tags.get(PARENT) == parent):
                continue
            if run is None or run.data.tags.get(LOCK) != stage.lock:
                run = next(iter(self.store.find({LOCK: stage.lock})), None)
            links[_cached_tag(stage)] = f"{stage.lock} {run.info.run_id if run else ''}".strip()
        return links

    def _variants(self, parent: str, links: dict[str, str]) -> int:
        """Runs of variants whose results are new, and links to those of the others; return how many are new."""
        store, scores, new = self.store, accuracies(self.params), 0
        answers = {stage.title: stage for stage in self.stages}
        models: list[tuple[Variant, str]] = []
        store.kill({KIND: "variant"})
        for variant in self.params.ablation.variants():
            stage = answers.get(f"answer@{variant.key}")
            if stage is None:
                continue
            metrics = scores.get(variant.key, {})
            folder = packaged(variant)
            made_of = [(folder / "config.json").read_text(encoding="utf-8")] if folder else []
            content = _digest([metrics, stage.outs, *made_of])
            if old := store.find({VARIANT: variant.key, CONTENT: content}):
                if old[0].data.tags.get(PARENT) != parent:
                    links[f"variant.{variant.key}"] = old[0].info.run_id
                models += [(variant, old[0].info.run_id)] if folder else []
                continue
            begin, end = stage.ran or (_milliseconds(time.time()),) * 2
            run = store.create(variant.key, "variant", begin, {VARIANT: variant.key, PARENT: parent})
            # Whole tasks before their parts, as the dashboard keeps the order.
            ordered = sorted(metrics.items(), key=lambda metric: ("." in metric[0], metric[0]))
            points = [(name, value, end, 0) for name, value in ordered]
            store.log(run, points, settings(self.params, stage.axes))
            for path, place in _artifacts(variant):
                if path.is_dir():
                    store.client.log_artifacts(run, str(path), place)
            if folder:
                log_model(store.client, run, self.params, variant, folder)
                models.append((variant, run))
            store.log(run, tags={CONTENT: content})
            store.client.set_terminated(run, "FINISHED", end)
            new += 1
        if address := register(store.client, self.params, models):
            links["octopi.model"] = address
        every = {name for metrics in scores.values() for name in metrics}
        tasks = [name for name in every if name.startswith("accuracy/") and "." not in name]
        for name, value in _front_page(store.experiment, sorted(tasks)).items():
            store.client.set_experiment_tag(store.experiment, name, value)
        return new

    def _complete_parent(self, parent: str, tags: Mapping[str, str]) -> None:
        """Parameters, the report with its metrics, the data, and what the run stands for."""
        from mlflow.entities import DatasetInput, InputTag

        report, now = REPORTS / self.params.report_name, _milliseconds(time.time())
        summary = read_json(report / "metrics.json") if (report / "metrics.json").is_file() else {}
        if report.is_dir():
            self.store.client.log_artifacts(parent, str(report), "report")
        for name, data in _datasets(self.params):
            context = InputTag("mlflow.data.context", name)
            self.store.client.log_inputs(parent, [DatasetInput(data._to_mlflow_entity(), [context])])
        cached = sum(name.startswith("cached.") for name in tags)
        own = {
            "octopi.dvc_lock": _digest([CHAIN_LOCK.read_text(encoding="utf-8")]),
            "octopi.uncommitted": _git("status", "--porcelain", "--", "pipeline", "stages", "dvc.yaml", "params.yaml"),
            NOTE: f"{len(self.stages) - cached} stages ran, {cached} came from DVC's cache (tags `cached.*`). "
            "Tables and figures: Artifacts, `report/README.md`.",
        }
        metrics = [(name, float(value), now, 0) for name, value in _flatten(summary)]
        known = self.store.client.get_run(parent).data.params
        values = {name: value for name, value in settings(self.params).items() if name not in known}
        self.store.log(parent, metrics, values, {**own, **tags})


def _cached_tag(stage: ChainStage) -> str:
    # MLflow allows no @ in names.
    return f"cached.{stage.title.replace('@', ':')}"


def _front_page(experiment: str, accuracy: Sequence[str]) -> dict[str, str]:
    """The experiment's description, and the table of variants that it leads to, written as MLflow's *Share view* does:
    only so do parameters and metrics become columns without a click each."""
    columns = [*(f"params.`{axis}`" for axis in Variant._fields), *(f"metrics.`{name}`" for name in accuracy)]
    name = "attributes.`Run Name`"
    view: dict[str, object] = {
        "columnOrder": [name, *columns],
        "columnWidths": {name: 240, **dict.fromkeys(columns, 105)},
        "selectedColumns": columns,
        "searchFilter": f"tags.`{KIND}` = 'variant'",
        # Sorted by time, the table would fold variants below their reproductions.
        "orderByKey": columns[0],
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "modelVersionFilter": "All Runs",
        "runsExpanded": {},
        "datasetsFilter": [],
        "runsPinned": [],
        "runsHidden": [],
    }
    link = f"#/experiments/{experiment}/runs?viewStateShareKey=variants"
    return {NOTE: f"[All variants with their accuracies]({link}) · docs/dashboard.md", VIEW: json.dumps(view)}
