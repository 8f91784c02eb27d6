"""The results of a reproduction on disk: its stages, as dvc.lock and runs/ have them, and its accuracies."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.config import Params
from pipeline.config.params import CHAIN, PARAMS_FILE
from pipeline.core.io import check_made, read_json, read_table
from pipeline.core.layout import GRADED, REPORTS, RUNS
from pipeline.core.records import TouchInput, Variant
from pipeline.evaluation.records import Graded, Shown
from pipeline.running.errors import UserError
from pipeline.tasks import TASKS

CHAIN_LOCK = Path("dvc.lock")


class ChainStage(NamedTuple):
    """A stage as dvc.lock has it for these parameters, and the run here that made it."""

    lock: str
    """Hash of its entry in dvc.lock."""
    outs: dict[str, str]
    """Path to hash of what it made."""
    ran: tuple[int, int] | None
    """Start and end in milliseconds since 1970, as all times here; None where DVC restored it, and another ran last."""
    metrics: dict[str, float]
    """The stage's own, and what it cost: `system/seconds`, `system/startup_seconds`, `system/peak_memory_mb`."""
    device: str = ""


def read_stages(params: Params) -> dict[str, ChainStage]:
    """Stages of dvc.yaml, without `publish`, that ran with these parameters, by titles such as `align@finetuned-all-0`.

    dvc.yaml or dvc.lock is a UserError where it is missing, or not as DVC writes it.
    """
    chain, today, found = _stages_in(CHAIN).keys() - {"publish"}, settings(params), {}
    for title, entry in _stages_in(CHAIN_LOCK).items():
        used = dict(flatten((entry.get("params") or {}).get(str(PARAMS_FILE)) or {}))
        if title.partition("@")[0] in chain and used.items() <= today.items():
            outs = {out["path"]: str(out.get("md5")) for out in entry.get("outs") or ()}
            made, path = ChainStage(digest(entry), outs, None, {}), RUNS / f"{title}.json"
            if path.is_file() and (run := read_json(path)).get("outs") == outs:
                began, ended = (datetime.fromisoformat(run[end]).timestamp() for end in ("started", "ended"))
                costs = {f"system/{name}": run[name] for name in ("seconds", "startup_seconds", "peak_memory_mb")}
                times = int(1000 * began), int(1000 * ended)
                made = made._replace(ran=times, metrics={**run["metrics"], **costs}, device=run["device"])
            found[title] = made
    return found


def axes(title: str) -> dict[str, str]:
    """A stage's values on the axes of its matrix: `align@finetuned-all-0` has encoder, opd and seed."""
    name, _, key = title.partition("@")
    names = _stages_in(CHAIN).get(name, {}).get("matrix", {})
    return dict(zip(names, key.split("-", len(names) - 1), strict=False))


def _stages_in(path: Path) -> dict[str, dict[str, Any]]:
    check_made(path)
    try:
        found = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        return {title: dict(stage) for title, stage in (found.get("stages") or {}).items()}
    except (yaml.YAMLError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: not as DVC writes it ({' '.join(str(error).split())}); restore it from Git") from None


def settings(params: Params, own: Mapping[str, str] | None = None) -> dict[str, str]:
    """Resolved parameters by dotted key, lists as JSON; a run's `own` come first, and replace those of the same
    name."""
    return {**(own or {}), **dict(flatten(params.model_dump(mode="json"))), **(own or {})}


def accuracies(params: Params) -> dict[str, dict[str, float]]:
    """Metrics of each variant by its key, from the report's scores.csv. With folds they come from graded answers: each
    fold has a model of its own, but the report pools them.

    `PC` is the share of right answers (0 to 1), `low/PC` and `high/PC` its interval, `swapped/PC` the share
    with another object's video; parts of an answer are named like `OPD.hardness`.
    """
    rows: Iterable[Mapping[str, Any]] = ()
    table = REPORTS / params.report_name / "scores.csv"
    if params.split.fold_of(0) is None:
        rows = csv.DictReader(table.read_text(encoding="utf-8").splitlines()) if table.is_file() else ()
    elif GRADED.is_file():
        from pipeline.evaluation.scores import score_rows
        from pipeline.videos.catalogue import load_catalogue

        own = [g.model_copy(update={"seed": g.trained}) for g in read_table(GRADED, Graded)]
        rows = map(dict, score_rows(own, load_catalogue(Path(params.data.catalogue))))
    found: dict[str, dict[str, float]] = {}
    for row in rows:
        if row["lora"] and row["seed"].isdigit():
            found.setdefault("-".join(row[axis] for axis in Variant._fields), {}).update(_metrics(row))
    return found


def reported(table: Path) -> dict[tuple[str, ...], dict[str, float]]:
    """Metrics of what answered by touch in a report's scores.csv, seeds and folds pooled, by its factors."""
    found: dict[tuple[str, ...], dict[str, float]] = {}
    for row in csv.DictReader(table.read_text(encoding="utf-8").splitlines()):
        model = row["touch"] == Shown.TOUCH  # One that `evaluate` asked; what has no LoRA otherwise are the heads.
        if row["seed"] == "all" and (model or row["lora"]):
            found.setdefault(tuple(row[axis] for axis in Variant._fields), {}).update(_metrics(row))
    return found


def _metrics(row: Mapping[str, Any]) -> dict[str, float]:
    whole = TASKS[row["task"]].measure if row["task"] in TASKS else "choice"
    task = row["task"] if row["measure"] == whole else f"{row['task']}.{row['measure']}"
    cells = {task: row["accuracy"], f"low/{task}": row["low"], f"high/{task}": row["high"]}
    if row["touch"] not in (TouchInput.REAL, Shown.TOUCH):
        cells = {f"{row['touch']}/{task}": row["accuracy"]}
    return {name: round(float(cell), 4) for name, cell in cells.items() if cell not in ("", None)}


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
