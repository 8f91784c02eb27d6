"""The reproduction in this folder as MLflow runs, after the last stage.

A reproduction is a parent run. Below it stand one run a stage that really ran and one a variant whose results are new;
what DVC took from its cache is linked by a tag.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.config import Params
from pipeline.core.errors import UserError
from pipeline.core.io import read_json, read_table
from pipeline.core.records import Measurement, Variant
from pipeline.tasks import TASKS
from pipeline.tracking.chain import (
    CHAIN_LOCK,
    REPORTS,
    ChainStage,
    accuracies,
    artifacts,
    datasets,
    digest,
    flatten,
    git,
    milliseconds,
    read_stages,
    settings,
)
from pipeline.tracking.registry import log_model, packaged, register
from pipeline.tracking.store import KIND, PARENT, STAGE, Store, TrackingError, cause, out_of_reach

VARIANT, LOCK, CONTENT, STATE = "octopi.variant", "octopi.lock", "octopi.content", "octopi.state"
"""Tags with what a finished stage, variant and reproduction were made from; written last."""
TABLE = "#/experiments/{}/runs?viewStateShareKey=variants"
"""Where a server has an experiment's table of variants."""
MOST_COLUMNS = 8
"""Changed parameters that the table of variants shows."""
NOTE, VIEW = "mlflow.note.content", "mlflow.sharedViewState.variants"


def publish(params: Params) -> str:
    """Make the runs of the reproduction in this folder; a second call adds nothing.

    Returns:
        A line that says what was added.

    Raises:
        TrackingError: where the server, the database or a file refuses; it says what and why.
        UserError: where a file of the reproduction is missing or broken.
    """
    stages = [stage for stage in read_stages(params) if stage.lock]
    try:
        store = Store(params.tracking)
        with store.lock:
            return _Publication(store, params, stages).publish()
    except UserError:
        raise
    except Exception as error:
        out_of_reach.set()
        raise TrackingError(f"{cause(error, params.tracking)}; `octopi publish` tries again") from error


@dataclass(frozen=True)
class _Publication:
    store: Store
    params: Params
    stages: list[ChainStage]

    def publish(self) -> str:
        store, now = self.store, milliseconds(time.time())
        runs = {stage.title: run for stage in self.stages if (run := store.run_of(stage))}
        fresh = [s for s in self.stages if s.ran and not (s.title in runs and LOCK in runs[s.title].data.tags)]
        state = digest([self.params.report_name, *(stage.lock for stage in self.stages)])
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
        # Keep what a live run logged: settings may have changed since.
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
            content = digest([metrics, stage.outs, *made_of])
            if old := store.find({VARIANT: variant.key, CONTENT: content}):
                if old[0].data.tags.get(PARENT) != parent:
                    links[f"variant.{variant.key}"] = old[0].info.run_id
                models += [(variant, old[0].info.run_id)] if folder else []
                continue
            begin, end = stage.ran or (milliseconds(time.time()),) * 2
            run = store.create(variant.key, "variant", begin, {VARIANT: variant.key, PARENT: parent})
            # Whole tasks before their parts, as the dashboard keeps the order.
            ordered = sorted(metrics.items(), key=lambda metric: ("." in metric[0], metric[0]))
            points = [(name, value, end, 0) for name, value in ordered]
            store.log(run, points, settings(self.params, stage.axes))
            for path, place in artifacts(variant):
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
        runs = store.find({KIND: "variant"})
        every = {name for run in runs for name in run.data.metrics}
        tasks = [*(t for t in TASKS if t in every), *sorted(n for n in every - {*TASKS} if not set("/.") & {*n})]
        for name, value in _front_page(store.experiment, tasks, _changed(runs)).items():
            store.client.set_experiment_tag(store.experiment, name, value)
        return new

    def _complete_parent(self, parent: str, tags: Mapping[str, str]) -> None:
        """Parameters, the report with its metrics, the data, and what the run stands for."""
        from mlflow.entities import DatasetInput, InputTag

        report, now = REPORTS / self.params.report_name, milliseconds(time.time())
        summary = read_json(report / "metrics.json") if (report / "metrics.json").is_file() else {}
        if report.is_dir():
            self.store.client.log_artifacts(parent, str(report), "report")
        for name, data in datasets(self.params):
            context = InputTag("mlflow.data.context", name)
            self.store.client.log_inputs(parent, [DatasetInput(data._to_mlflow_entity(), [context])])
        cached = sum(name.startswith("cached.") for name in tags)
        own = {
            "octopi.dvc_lock": digest([CHAIN_LOCK.read_text(encoding="utf-8")]),
            "octopi.uncommitted": git("status", "--porcelain", "--", "pipeline", "stages", "dvc.yaml", "params.yaml"),
            NOTE: f"{len(self.stages) - cached} stages ran, {cached} came from DVC's cache (tags `cached.*`). "
            "Tables and figures: Artifacts, `report/README.md`.",
        }
        metrics = [(name, float(value), now, 0) for name, value in flatten(summary)]
        known = self.store.client.get_run(parent).data.params
        values = {name: value for name, value in settings(self.params).items() if name not in known}
        self.store.log(parent, metrics, values, {**own, **tags})


def _cached_tag(stage: ChainStage) -> str:
    # MLflow allows no @ in names.
    return f"cached.{stage.title.replace('@', ':')}"


def _changed(runs: Sequence[Any]) -> list[str]:
    """The parameters, besides the factors of the ablation, in which runs differ, those of most values first."""
    values: dict[str, set[str]] = {}
    for run in runs:
        for name, value in run.data.params.items():
            values.setdefault(name, set()).add(value)
    differ = [name for name, found in values.items() if len(found) > 1 and name not in Variant._fields]
    return sorted(differ, key=lambda name: (-len(values[name]), name))[:MOST_COLUMNS]


def _front_page(experiment: str, accuracy: Sequence[str], changed: Sequence[str]) -> dict[str, str]:
    """The experiment's description, and the table of variants that it leads to, written as MLflow's *Share view* does:
    only so do parameters and metrics become columns without a click each."""
    accuracies = [f"metrics.`{name}`" for name in accuracy]
    # The factors last: a run's name has them.
    factors = [f"params.`{axis}`" for axis in (*changed, *Variant._fields)]
    columns = [*accuracies, *factors]
    name = "attributes.`Run Name`"
    view: dict[str, object] = {
        "columnOrder": [name, *columns],
        # A laptop's 1,440 pixels show the name, five accuracies and what differs.
        "columnWidths": {name: 190, **dict.fromkeys(accuracies, 65), **dict.fromkeys(factors, 110)},
        "selectedColumns": columns,
        "searchFilter": f"tags.`{KIND}` = 'variant'",
        # Sorted by time, the table would fold variants below their reproductions.
        "orderByKey": factors[-len(Variant._fields)],
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "modelVersionFilter": "All Runs",
        "runsExpanded": {},
        "datasetsFilter": [],
        "runsPinned": [],
        "runsHidden": [],
    }
    return {
        NOTE: f"[All variants with their accuracies]({TABLE.format(experiment)}) · docs/dashboard.md",
        VIEW: json.dumps(view),
    }
