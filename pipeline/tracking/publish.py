"""The reproduction in this folder as MLflow runs, after the last stage.

A reproduction is a parent run. Below it stand one run a stage that really ran and one a variant whose results are new.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pipeline.config import Params
from pipeline.config.params import load_params
from pipeline.core.io import read_json, read_table
from pipeline.core.layout import HISTORY_FILE, MODELS, REPORTS, answers_dir, encoder_dir, trained_dir
from pipeline.core.records import Encoder, Lora, Measurement, Variant
from pipeline.running.errors import UserError
from pipeline.tasks import TASKS
from pipeline.tracking.chain import (
    CHAIN_LOCK,
    ChainStage,
    accuracies,
    axes,
    digest,
    flatten,
    read_stages,
    reported,
    settings,
)  # fmt: skip
from pipeline.tracking.store import KIND, LOCK, PARENT, STAGE, Store, TrackingError, cause, out_of_reach
from pipeline.weights import is_random

VARIANT, REPORT = "octopi.variant", "octopi.report"
"""Tags that name a variant of this folder's chain, or the report that has it, which another chain made."""
CONTENT, STATE = "octopi.content", "octopi.state"
"""Tags with what a finished variant and reproduction were made from; written last."""
PLUMBING = " (a test of the plumbing)"
"""Behind the name of a variant whose base models are random, so that all its accuracies are chance."""
TABLE = "#/experiments/{}/runs?viewStateShareKey={}"
"""Where a server has an experiment's table of variants or stages."""
MOST_COLUMNS = 8
"""Changed parameters that the table of variants shows."""
NOTE, VIEW = "mlflow.note.content", "mlflow.sharedViewState.{}"


def table_address(port: int) -> str:
    """Where `make dashboard` shows the table of all variants of the folder's own database."""
    here = load_params().tracking.model_copy(update={"uri": ""})
    return f"http://127.0.0.1:{port}/{TABLE.format(Store(here).experiment, 'variants')}"


def publish(params: Params) -> str:
    """Make the runs of the reproduction in this folder; a second call adds nothing.

    Returns:
        A line that says what was added.

    Raises:
        TrackingError: where the server, the database or a file refuses; it says what and why.
        UserError: where a file of the reproduction is missing or broken.
    """
    stages = read_stages(params)
    try:
        store = Store(params.tracking)
        with store.lock:
            return _publish(store, params, stages)
    except UserError:
        raise
    except Exception as error:
        out_of_reach.set()
        raise TrackingError(f"{cause(error, params.tracking)}; `octopi publish` tries again") from error


def _publish(store: Store, params: Params, stages: Mapping[str, ChainStage]) -> str:
    now, fresh = int(time.time() * 1000), store.fresh(stages)
    state = digest([params.report_name, *(stage.lock for stage in stages.values())])
    if not fresh and (same := store.find({KIND: "reproduction", STATE: state})):
        store.kill({KIND: "reproduction"})
        return f"nothing new since run {same[0].info.run_id}"
    parent = store.open_reproduction(params, min((began for began, _, _ in fresh.values()), default=now))
    for title, ran in fresh.items():
        _complete(store, params, parent, title, stages[title], *ran)
    ended = [run.info.end_time for run in store.find({KIND: "stage", PARENT: parent}) if LOCK in run.data.tags]
    _committed(store, params, now)
    new, links = _variants(store, params, parent, stages)
    report = REPORTS / params.report_name
    if report.is_dir():
        store.client.log_artifacts(parent, str(report), "report")
    summary = read_json(report / "metrics.json") if (report / "metrics.json").is_file() else {}
    store.log(parent, [(name, float(value), now, 0) for name, value in flatten(summary)])
    about = f"{len(ended)} stages ran, the others came from DVC's cache. Tables: Artifacts, `report/README.md`."
    lock = digest([CHAIN_LOCK.read_text(encoding="utf-8")])
    tags = {"octopi.dvc_lock": lock, NOTE: about, **links, STATE: state}
    store.finish(parent, max(ended, default=now), tags)
    return f"run {parent} in {store.uri}: {len(ended)} stages ran, {new} variants are new"


def _complete(
    store: Store, params: Params, parent: str, title: str, stage: ChainStage, began: int, ended: int, run: Any | None
) -> None:
    """A run of a stage that ran; one that was logged live gets what it lacks."""
    tags, there = {STAGE: title, PARENT: parent}, set[tuple[str, int]]()
    if run:
        run_id = run.info.run_id
        there = {(name, m.step) for name in run.data.metrics for m in store.client.get_metric_history(run_id, name)}
    else:
        run_id = store.create(title, "stage", began, settings(params, axes(title)), tags)
    history = next((path for out in stage.outs if (path := Path(out) / HISTORY_FILE).is_file()), None)
    curve = read_table(history, Measurement) if history else []
    steps = max((m.step for m in curve), default=0) or 1
    points = [(m.name, m.value, began + (ended - began) * m.step // steps, m.step) for m in curve]
    # The end of a curve is no point at its step 0.
    points += [(n, float(value), ended, 0) for n, value in stage.metrics.items() if n not in {m.name for m in curve}]
    store.log(run_id, [point for point in points if (point[0], point[3]) not in there])
    store.finish(run_id, ended, {LOCK: stage.lock})


def _variants(
    store: Store, params: Params, parent: str, stages: Mapping[str, ChainStage]
) -> tuple[int, dict[str, str]]:
    """Runs of variants whose results are new, and the table of all.

    Returns:
        How many are new, and tags with the runs of the others.
    """
    scores, new, links = accuracies(params), 0, dict[str, str]()
    store.kill({KIND: "variant"})
    for variant in params.ablation.variants():
        if (stage := stages.get(f"answer@{variant.key}")) is None:
            continue
        metrics, package = scores.get(variant.key, {}), MODELS / variant.key
        # A folder that is packaged is whole when it has its card.
        card = package / "config.json"
        content = digest([metrics, stage.outs, *([card.read_text(encoding="utf-8")] if card.is_file() else [])])
        if old := store.find({VARIANT: variant.key, CONTENT: content}):
            if old[0].data.tags.get(PARENT) != parent:
                links[f"variant.{variant.key}"] = old[0].info.run_id
            continue
        begin, end = stage.ran or (int(time.time() * 1000),) * 2
        factors = {axis: str(value) for axis, value in variant._asdict().items()}
        tags = {VARIANT: variant.key, PARENT: parent}
        name = variant.key + PLUMBING * (is_random(params.language.weights) or is_random(params.encoder.weights))
        run = store.create(name, "variant", begin, settings(params, factors), tags)
        store.log(run, [(name, value, end, 0) for name, value in _ordered(metrics)])
        made = {"predictions": answers_dir(variant), "model": trained_dir(variant)}
        if variant.lora is not Lora.WITHOUT:
            made["alignment"] = trained_dir(variant._replace(lora=Lora.WITHOUT))
        if variant.encoder is Encoder.FINETUNED:
            made["encoder"] = encoder_dir(variant.seed)
        for place, path in {**made, "package": package}.items():
            if path.is_dir():
                store.client.log_artifacts(run, str(path), place)
        store.finish(run, end, {CONTENT: content})
        new += 1
    for name, value in _front_page(store.experiment, store.find({KIND: "variant"})).items():
        store.client.set_experiment_tag(store.experiment, name, value)
    return new, links


def _committed(store: Store, params: Params, now: int) -> None:
    """Finished runs of the reports in reports/ that another chain made, one a system: so a clone's table has them.

    Those of a report that was replaced or removed since are deleted, but not on a server: others' reports are there.
    """
    tables = {table.parent: digest(table.read_text(encoding="utf-8")) for table in sorted(REPORTS.glob("*/scores.csv"))}
    here = {(report.name, content) for report, content in tables.items()}
    for run in [] if params.tracking.uri else store.find({KIND: "variant"}):
        tags = run.data.tags
        if REPORT in tags and (tags[REPORT], tags.get(CONTENT)) not in here:
            store.client.delete_run(run.info.run_id)
    for report, content in tables.items():
        if report.name == params.report_name or store.find({REPORT: report.name, CONTENT: content}):
            continue
        own = yaml.safe_load((report / "params.yaml").read_text(encoding="utf-8"))
        for values, metrics in reported(report / "scores.csv").items():
            factors = dict(zip(Variant._fields, values, strict=True))
            # A model that `evaluate` asked has no factors.
            name = f"{report.name}: {'-'.join(values[:3] if factors['lora'] else values[:1])}"
            run = store.create(name, "variant", now, {**dict(flatten(own)), **factors}, {REPORT: report.name})
            store.log(run, [(name, value, now, 0) for name, value in _ordered(metrics)])
            for file in ("README.md", "provenance.json", "effects.csv"):
                if (report / file).is_file():
                    store.client.log_artifact(run, str(report / file), "report")
            store.finish(run, now, {CONTENT: content})


def _ordered(metrics: Mapping[str, float]) -> list[tuple[str, float]]:
    """Whole tasks before their parts, as the dashboard keeps the order."""
    return sorted(metrics.items(), key=lambda metric: ("." in metric[0], metric[0]))


def _front_page(experiment: str, runs: Sequence[Any]) -> dict[str, str]:
    """The experiment's description, and the tables of variants and stages that it leads to."""
    import pandas as pd

    every = {name for run in runs for name in run.data.metrics}
    tasks = [*(t for t in TASKS if t in every), *sorted(n for n in every - {*TASKS} if not set("/.") & {*n})]
    here = [run.data.params for run in runs if REPORT not in run.data.tags]
    values = pd.DataFrame(here).drop(columns=list(Variant._fields), errors="ignore")
    counts = values.nunique().sort_index().sort_values(ascending=False, kind="stable")
    # The factors last: a run's name has them.
    factors = [*counts[counts > 1].index[:MOST_COLUMNS], *Variant._fields]
    costs = ["system/seconds", "system/peak_memory_mb"]
    return {
        NOTE: f"[All variants with their accuracies]({TABLE.format(experiment, 'variants')}) · "
        f"[seconds and memory of each stage]({TABLE.format(experiment, 'stages')}) · docs/dashboard.md",
        # A laptop's 1,440 pixels show the name, five accuracies and what differs.
        VIEW.format("variants"): _table("variant", tasks, factors, 65),
        VIEW.format("stages"): _table("stage", costs, [], 190),
    }


def _table(kind: str, measured: Sequence[str], params: Sequence[str], width: int) -> str:
    """A table as MLflow's *Share view* writes it: only so are parameters and metrics columns without a click each.

    It begins with the highest of the first column: sorted by time, it would fold runs below their reproductions.
    """
    name, metrics = "attributes.`Run Name`", [f"metrics.`{each}`" for each in measured]
    others = [f"params.`{each}`" for each in params]
    view: dict[str, object] = {
        "columnOrder": [name, *metrics, *others],
        "columnWidths": {name: 250, **dict.fromkeys(metrics, width), **dict.fromkeys(others, 110)},
        "selectedColumns": [*metrics, *others],
        "searchFilter": f"tags.`{KIND}` = '{kind}'",
        "orderByKey": [*metrics, *others][0],
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "modelVersionFilter": "All Runs",
        "runsExpanded": {},
        **{key: [] for key in ("datasetsFilter", "runsPinned", "runsHidden")},
    }
    return json.dumps(view)
