"""The reproduction in this folder as MLflow runs, after the last stage.

A reproduction is a parent run. Below it stand one run a stage that really ran and one a variant whose results are new.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.config import Params
from pipeline.config.params import load_params
from pipeline.core.errors import UserError
from pipeline.core.io import read_json, read_table
from pipeline.core.records import Encoder, Lora, Measurement, Variant
from pipeline.core.stage import DATA
from pipeline.tasks import TASKS
from pipeline.tracking.chain import (
    CHAIN_LOCK,
    REPORTS,
    ChainStage,
    accuracies,
    axes,
    digest,
    flatten,
    read_stages,
    settings,
)
from pipeline.tracking.registry import log_model, register
from pipeline.tracking.store import KIND, LOCK, PARENT, STAGE, Store, TrackingError, cause, out_of_reach

VARIANT, CONTENT, STATE = "octopi.variant", "octopi.content", "octopi.state"
"""Tags with what a finished variant and reproduction were made from; written last."""
TABLE = "#/experiments/{}/runs?viewStateShareKey=variants"
"""Where a server has an experiment's table of variants."""
MOST_COLUMNS = 8
"""Changed parameters that the table of variants shows."""
NOTE, VIEW = "mlflow.note.content", "mlflow.sharedViewState.variants"


def table_address(port: int) -> str:
    """Where `make dashboard` shows the table of all variants of the folder's own database."""
    here = load_params().tracking.model_copy(update={"uri": ""})
    return f"http://127.0.0.1:{port}/{TABLE.format(Store(here).experiment)}"


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
    parent = store.open_reproduction(params)
    if parent is None:
        if not fresh and (same := store.find({KIND: "reproduction", STATE: state})):
            return f"nothing new since run {same[0].info.run_id}"
        begin = min((began for began, _, _ in fresh.values()), default=now)
        parent = store.create(params.report_name, "reproduction", begin)
    for title, ran in fresh.items():
        _complete(store, params, parent, title, stages[title], *ran)
    done = store.find({KIND: "stage", PARENT: parent})
    ended = [run.info.end_time for run in done if LOCK in run.data.tags]
    new, links = _variants(store, params, parent, stages)
    report = REPORTS / params.report_name
    if report.is_dir():
        store.client.log_artifacts(parent, str(report), "report")
    summary = read_json(report / "metrics.json") if (report / "metrics.json").is_file() else {}
    # Where publishing was cut off some are there, and MLflow refuses other values.
    known = store.client.get_run(parent).data.params
    own = {name: value for name, value in settings(params).items() if name not in known}
    store.log(parent, [(name, float(value), now, 0) for name, value in flatten(summary)], own)
    about = {
        "octopi.dvc_lock": digest([CHAIN_LOCK.read_text(encoding="utf-8")]),
        NOTE: f"{len(ended)} stages ran, the others came from DVC's cache. Tables and figures: Artifacts, "
        "`report/README.md`.",
    }
    store.log(parent, tags={**about, **links, STATE: state}, end=max(ended, default=now))
    return f"run {parent} in {store.uri}: {len(ended)} stages ran, {new} variants are new"


def _complete(
    store: Store, params: Params, parent: str, title: str, stage: ChainStage, began: int, ended: int, run: Any | None
) -> None:
    """A run of a stage that ran; one that was logged live gets what it lacks."""
    # Keep the parameters that a live run logged: settings may have changed since.
    own = {} if run else settings(params, axes(title))
    run_id = run.info.run_id if run else store.create(title, "stage", began, {STAGE: title, PARENT: parent})
    history = next((path for out in stage.outs if (path := Path(out) / "history.parquet").is_file()), None)
    curve = read_table(history, Measurement) if history else []
    steps = max((m.step for m in curve), default=0) or 1
    logged = set(run.data.metrics if run else ())
    there = {(name, m.step) for name in logged for m in store.client.get_metric_history(run_id, name)}
    times = {m.step: began + (ended - began) * m.step // steps for m in curve}
    points = [(m.name, m.value, times[m.step], m.step) for m in curve if (m.name, m.step) not in there]
    # The end of a curve is no point at its step 0.
    logged |= {m.name for m in curve}
    points += [(name, float(value), ended, 0) for name, value in stage.metrics.items() if name not in logged]
    store.log(run_id, points, own)
    store.log(run_id, tags={LOCK: stage.lock}, end=ended)


def _variants(
    store: Store, params: Params, parent: str, stages: Mapping[str, ChainStage]
) -> tuple[int, dict[str, str]]:
    """Runs of variants whose results are new, the best one's model, and the table of all.

    Returns:
        How many are new, and tags with the runs of the others and the best model's address.
    """
    scores, new, links, models = accuracies(params), 0, dict[str, str](), list[tuple[Variant, str]]()
    store.kill({KIND: "variant"})
    for variant in params.ablation.variants():
        stage = stages.get(f"answer@{variant.key}")
        if stage is None:
            continue
        metrics, folder = scores.get(variant.key, {}), Path("models") / variant.key
        # A folder that is packaged is whole when it has its card.
        card = folder / "config.json"
        made_of = [card.read_text(encoding="utf-8")] if card.is_file() else []
        content = digest([metrics, stage.outs, *made_of])
        if old := store.find({VARIANT: variant.key, CONTENT: content}):
            run = old[0].info.run_id
            if old[0].data.tags.get(PARENT) != parent:
                links[f"variant.{variant.key}"] = run
        else:
            begin, end = stage.ran or (int(time.time() * 1000),) * 2
            run = store.create(variant.key, "variant", begin, {VARIANT: variant.key, PARENT: parent})
            # Whole tasks before their parts, as the dashboard keeps the order.
            ordered = sorted(metrics.items(), key=lambda metric: ("." in metric[0], metric[0]))
            factors = {axis: str(value) for axis, value in variant._asdict().items()}
            store.log(run, [(name, value, end, 0) for name, value in ordered], settings(params, factors))
            trained = f"{variant.encoder}-{variant.opd}-{variant.seed}"
            made = {"predictions": Path("answers") / variant.key, "model": Path("models") / variant.lora / trained}
            if variant.lora is Lora.WITH:
                made["alignment"] = Path("models") / Lora.WITHOUT / trained
            if variant.encoder is Encoder.FINETUNED:
                made["encoder"] = Path("encoder") / str(variant.seed)
            for place, path in made.items():
                if (DATA / path).is_dir():
                    store.client.log_artifacts(run, str(DATA / path), place)
            if made_of:
                log_model(store.client, run, params, variant, folder)
            store.log(run, tags={CONTENT: content}, end=end)
            new += 1
        models += [(variant, run)] if made_of else []
    if models:
        links["octopi.model"] = register(store.client, params, models)
    for name, value in _front_page(store.experiment, store.find({KIND: "variant"})).items():
        store.client.set_experiment_tag(store.experiment, name, value)
    return new, links


def _front_page(experiment: str, runs: Sequence[Any]) -> dict[str, str]:
    """The experiment's description, and the table of variants that it leads to, written as MLflow's *Share view* does:
    only so do parameters and metrics become columns without a click each."""
    import pandas as pd

    every = {name for run in runs for name in run.data.metrics}
    tasks = [*(t for t in TASKS if t in every), *sorted(n for n in every - {*TASKS} if not set("/.") & {*n})]
    values = pd.DataFrame([run.data.params for run in runs]).drop(columns=list(Variant._fields), errors="ignore")
    counts = values.nunique().sort_index().sort_values(ascending=False, kind="stable")
    differ = counts[counts > 1].index[:MOST_COLUMNS]
    accuracy = [f"metrics.`{task}`" for task in tasks]
    # The factors last: a run's name has them.
    factors = [f"params.`{axis}`" for axis in (*differ, *Variant._fields)]
    name = "attributes.`Run Name`"
    view: dict[str, object] = {
        "columnOrder": [name, *accuracy, *factors],
        # A laptop's 1,440 pixels show the name, five accuracies and what differs.
        "columnWidths": {name: 190, **dict.fromkeys(accuracy, 65), **dict.fromkeys(factors, 110)},
        "selectedColumns": [*accuracy, *factors],
        "searchFilter": f"tags.`{KIND}` = 'variant'",
        # Sorted by time, the table would fold variants below their reproductions.
        "orderByKey": factors[-len(Variant._fields)],
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "modelVersionFilter": "All Runs",
        "runsExpanded": {},
        **{key: [] for key in ("datasetsFilter", "runsPinned", "runsHidden")},
    }
    return {
        NOTE: f"[All variants with their accuracies]({TABLE.format(experiment)}) · docs/dashboard.md",
        VIEW: json.dumps(view),
    }
