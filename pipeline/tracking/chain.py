"""What lies on disk of a reproduction: stages as DVC knows them, their runs, scores, models and data."""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
import subprocess
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import reduce
from pathlib import Path
from typing import Any

import yaml

from pipeline.config import Params
from pipeline.config.params import CHAIN, PARAMS_FILE
from pipeline.core.errors import UserError
from pipeline.core.io import read_json, read_table
from pipeline.core.records import Encoder, Graded, Lora, Part, Touch, Variant, Video
from pipeline.core.stage import DATA, RUNS
from pipeline.tasks import TASKS

REPORTS, CHAIN_LOCK = Path("reports"), Path("dvc.lock")


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

    Either file is a UserError where it is missing, or no YAML of DVC's.
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
            if not dict(flatten((entry.get("params") or {}).get(str(PARAMS_FILE)) or {})).items() <= today.items():
                entry = {}
            outs = {out["path"]: str(out.get("md5")) for out in entry.get("outs") or ()}
            axes = dict(zip(matrix, map(str, choice), strict=True))
            found.append(ChainStage(title, axes, digest(entry) if entry else "", outs, *_last_run(title)))
    return found


def _last_run(title: str) -> tuple[tuple[int, int] | None, dict[str, float]]:
    path = RUNS / f"{title}.json"
    if not path.is_file():
        return None, {}
    run = read_json(path)
    started, ended = (milliseconds(datetime.fromisoformat(run[end]).timestamp()) for end in ("started", "ended"))
    costs = {f"system/{name}": run[name] for name in ("seconds", "startup_seconds", "peak_memory_mb")}
    return (started, ended), {**run["metrics"], **costs}


def settings(params: Params, axes: Mapping[str, str] | None = None) -> dict[str, str]:
    """Resolved parameters by dotted key, lists as JSON; `axes` come first and in place of those of their name."""
    return {**(axes or {}), **dict(flatten(params.model_dump(mode="json"))), **(axes or {})}


def accuracies(params: Params) -> dict[str, dict[str, float]]:
    """Metrics of each variant by its key, from the report's scores.csv (of folds, from each fold's own answers).

    `PC` is the share of right answers (0 to 1), `low/PC` and `high/PC` its interval, `swapped/PC` the share
    with another object's video; parts of an answer are named like `OPD.hardness`.
    """
    found: dict[str, dict[str, float]] = {}
    for row in _score_rows(params):
        if row["lora"] and row["seed"].isdigit():
            whole = TASKS[row["task"]].measure if row["task"] in TASKS else "choice"
            task = row["task"] if row["measure"] == whole else f"{row['task']}.{row['measure']}"
            cells = {task: row["accuracy"], f"low/{task}": row["low"], f"high/{task}": row["high"]}
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


def artifacts(variant: Variant) -> Iterator[tuple[Path, str]]:
    """What a variant said and is made of: folders and files, with their place among the artifacts."""
    key = f"{variant.encoder}-{variant.opd}-{variant.seed}"
    yield DATA / "answers" / variant.key, "predictions"
    yield DATA / "models" / variant.lora / key, "model"
    if variant.lora is Lora.WITH:
        yield DATA / "models" / Lora.WITHOUT / key, "alignment"
    if variant.encoder is Encoder.FINETUNED:
        yield DATA / "encoder" / str(variant.seed), "encoder"


def datasets(params: Params) -> Iterator[tuple[str, Any]]:
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


def flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested values by dotted key, all but texts as JSON."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value)


def digest(value: object) -> str:
    """A short hash of what can be written as JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def milliseconds(seconds: float) -> int:
    """As MLflow counts time."""
    return int(seconds * 1000)


def git(*arguments: str) -> str:
    """What Git prints; "unknown" where it fails."""
    with suppress(OSError, subprocess.SubprocessError):
        command = ["git", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    return "unknown"
