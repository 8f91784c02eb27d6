"""What the dashboard shows first: the experiment's description, its two prepared tables, and reproductions to compare.

A prepared table is an address with `viewStateShareKey=NAME`, for which MLflow's pages look up the experiment's tag
`mlflow.sharedViewState.NAME`: the filter, the order and the columns as JSON, as its button for sharing a view writes
it. An MLflow that does not know it shows all runs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.records import Task
from pipeline.config import TrackingConfig
from pipeline.tracking.standings import ENDS, figure
from pipeline.tracking.store import KEY, Store

KIND, PUBLISHED, COMMITTED, COMMIT = "octopi.kind", "octopi.published", "octopi.committed", "octopi.commit"
CODE, DATA, CHANGED = "octopi.code", "octopi.data", "octopi.changed"
REPRODUCTION, VARIANT, OTHER = "reproduction", "variant", "stage"
"""Values of `octopi.kind`."""
NOTE = "mlflow.note.content"
VIEW = "mlflow.sharedViewState."
RUN_NAME = "attributes.`Run Name`"
CHANGED_COLUMN = f"tags.`{CHANGED}`"
REPRODUCTIONS, VARIANTS = "reproductions", "variants"
SAME_SCALE = 1000


@dataclass(frozen=True)
class Reproduction:
    """A parent run as found."""

    run_id: str
    name: str
    tags: Mapping[str, str]
    params: Mapping[str, str]
    metrics: Mapping[str, float]


class Dashboard(Store):
    """The experiment as a reviewer opens it."""

    def __init__(self, tracking: TrackingConfig, root: Path) -> None:
        """As a store; MLflow does not print an address for each run that ends."""
        os.environ["MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT"] = "true"
        super().__init__(tracking, root)

    @property
    def page(self) -> str:
        """The experiment's address, relative to the server's."""
        return f"#/experiments/{self._experiment}"

    def link(self, run_id: str, below: str = "") -> str:
        """A run's address, or that of something on its page."""
        return f"{self.page}/runs/{run_id}{below}"

    def view(self, name: str) -> str:
        """The address of a prepared table."""
        return f"{self.page}/runs?viewStateShareKey={name}"

    def side_by_side(self, old: str, new: str) -> str:
        """The address of MLflow's comparison of two runs."""
        # As MLflow's own links have it: JSON, percent-encoded.
        return f"#/compare-runs?runs=%5B%22{old}%22,%22{new}%22%5D&experiments=%5B%22{self._experiment}%22%5D"

    def reproductions(self, scale: str, source: str) -> list[Reproduction]:
        """Reproductions of this scale and source that say when they were published first, the oldest first."""
        tags = ((KIND, REPRODUCTION), ("octopi.scale", scale), ("octopi.source", source))
        query = " and ".join(f"tags.`{name}` = '{value}'" for name, value in tags)
        found = self._try(self._client.search_runs, [self._experiment], query, max_results=SAME_SCALE)
        runs = [
            Reproduction(r.info.run_id, r.info.run_name, dict(r.data.tags), dict(r.data.params), dict(r.data.metrics))
            for r in found
        ]
        return sorted((run for run in runs if PUBLISHED in run.tags), key=lambda run: run.tags[PUBLISHED])

    def describe(self, key: str) -> None:
        """Write the experiment's description and the prepared tables, where they are not as they should be.

        The second table shows the variants of the reproduction with this key.
        """
        known = dict(self._try(self._client.get_experiment, self._experiment).tags)
        for name, value in self._wanted(key).items():
            if known.get(name) != value:
                self._try(self._client.set_experiment_tag, self._experiment, name, value)

    def _wanted(self, key: str) -> dict[str, str]:
        return {
            # Folded, a description shows its first line only: that is where the links must be.
            NOTE: (
                f"[What changed? Is it the committed one?]({self.view(REPRODUCTIONS)}) · "
                f"[Which variant is best?]({self.view(VARIANTS)})\n\n"
                "A run is a reproduction; the runs below it are its stages. The description of each reproduction "
                "answers the three questions; the second table above holds the variants of the one published last. "
                "`octopi compare REV REV` compares any two commits, with paired tests. docs/dashboard.md is the walk.\n"
            ),
            f"{VIEW}{REPRODUCTIONS}": _view(
                f"tags.`{KIND}` = '{REPRODUCTION}'",
                "attributes.start_time",
                [f"tags.`{name}`" for name in (COMMITTED, CHANGED, COMMIT, CODE, DATA)],
            ),
            f"{VIEW}{VARIANTS}": _view(
                f"tags.`{KIND}` = '{VARIANT}' and tags.`{KEY}` = '{key}'",
                "metrics.`accuracy.PC`",
                [
                    *(f"metrics.`{figure(task)}`" for task in Task),
                    *(f"metrics.`{figure(task, end)}`" for task in Task for end in ENDS),
                ],
            ),
        }


def kind(stage: str) -> str:
    """What a run is, by its tag `octopi.stage`."""
    return VARIANT if stage.startswith("grade@") else OTHER if stage else REPRODUCTION


def _view(query: str, order: str, columns: Sequence[str]) -> str:
    """Columns in this order, which would be sorted by name else, and room for the names of runs."""
    return json.dumps(
        {
            "columnOrder": [RUN_NAME, *columns],
            "columnWidths": {RUN_NAME: 280, **dict.fromkeys(columns, 130), CHANGED_COLUMN: 240},
            "searchFilter": query,
            "orderByKey": order,
            "orderByAsc": False,
            "startTime": "ALL",
            "lifecycleFilter": "Active",
            "datasetsFilter": [],
            "modelVersionFilter": "All Runs",
            "selectedColumns": list(columns),
            "runsExpanded": {},
            "runsPinned": [],
            "runsHidden": [],
        }
    )
