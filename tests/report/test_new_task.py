"""A task that somebody adds, one file and one registration, is in scores, effects, tables, README and DVC's metrics."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.records import Opd
from pipeline.report.build import write_report
from pipeline.report.load import Report, load_report
from pipeline.report.tables import TABLES
from pipeline.tasks import TASKS
from pipeline.tasks.base import Draft, Pool
from tests.fake_run import fake_params, write_run
from tests.tasks.test_registry import Hardest


class Hard(Hardest):
    """The file that somebody adds: is this object hard? With a description first, or without."""

    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        draft = super().draft(pool, stratum, rng)
        if draft is None:
            return None
        (short,) = draft.dialogues
        return replace(draft, dialogues=(short, short.model_copy(update={"opd": Opd.ALL})))


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Report]:
    """A report of a run that has the task; it stays registered while the report is read."""
    root: Path = tmp_path_factory.mktemp("new")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, "HARD", Hard())
        params = write_run(root, fake_params("questions.evaluation={opd:4,pc:4,pss:4,pom:4,psr:4,hard:6}"))
        write_report(params, root)
        yield load_report(root / "reports" / params.report_name)


def test_it_has_scores_and_effects_with_its_own_chance(report: Report) -> None:
    scores = report.scores[report.scores["task"] == "HARD"]
    assert len(scores[scores["touch"] == "real"]) == len(report.provenance["seeds"]) * 2 * 8
    assert set(scores["touch"]) == {"real", "swapped"}
    assert set(scores["chance"]) == {0.5}
    assert set(scores["n"]) == {6}
    effects = report.effects[report.effects["task"] == "HARD"]
    assert set(effects["part"]) == {"encoder", "lora", "opd", "touch"}


@pytest.mark.parametrize(
    "key", ["understanding", "encoder_understanding", "lora_understanding", "variants", "touch", "effects"]
)
def test_it_is_in_the_tables_beside_nothing_published(report: Report, key: str) -> None:
    table = next(table for table in TABLES if table.key == key)
    shown = table.build(report.scores, report.effects, report.published)
    rows = shown[shown["Task"] == "Hard or not (HARD)"]
    assert len(rows)
    assert all((rows[c] == "").all() for c in rows.columns if "Published" in c)
    assert list(shown["Task"].drop_duplicates())[-1] == "Hard or not (HARD)"


def test_it_is_in_the_readme_the_metrics_and_the_samples(report: Report) -> None:
    text = (report.folder / "README.md").read_text()
    first = text[: text.index("## What the figures stand on")]
    assert "| Hard or not (HARD) | **" in first
    assert " of 6 tasks" in first
    assert 0 <= json.loads((report.folder / "metrics.json").read_text())["HARD"] <= 1
    assert "HARD" in {sample["task"] for sample in report.samples["samples"]}
