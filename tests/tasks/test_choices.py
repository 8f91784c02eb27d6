"""The table of choices says what the code does, wherever a value can be read from it."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.config import Params
from pipeline.core.records import Part
from pipeline.encoder.release import DROPOUT, HIDDEN
from pipeline.encoder.vpt import PUBLISHED_DEVIATION, VisualPrompts
from pipeline.language.connector import Connector
from pipeline.scales import compose
from pipeline.tasks import TASKS
from pipeline.videos.catalogue import load_catalogue
from tests.closure import ROOT

HEADER = ["Element", "Paper", "Published code", "Here", "Why"]
PAPER = compose("paper-7b", [], conf=ROOT / "conf")
RELEASE = compose("paper-7b", ["encoder.recipe=release"], conf=ROOT / "conf")


def rows(text: str) -> list[dict[str, str]]:
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    assert all(len(row) == len(HEADER) for row in cells), "five cells a row"
    return [dict(zip(HEADER, row, strict=True)) for row in cells if row != HEADER and set(row[0]) != {"-"}]


ROWS = rows((ROOT / "docs" / "choices.md").read_text())


def settings(column: str) -> list[tuple[str, str]]:
    """The `key=value` of a column."""
    return [pair for row in ROWS for pair in re.findall(r"`([a-z_]+\.[a-z_]+)=([^`]+)`", row[column])]


def value(params: Params, key: str) -> Any:
    section, name = key.split(".")
    return getattr(getattr(params, section), name)


def test_the_table_is_whole() -> None:
    assert len(ROWS) > 40
    assert all(row["Element"] and row["Paper"] and row["Published code"] and row["Here"] for row in ROWS)
    text = (ROOT / "docs" / "choices.md").read_text()
    for section in re.split(r"^## ", text, flags=re.M)[1:]:
        named = [row["Element"] for row in rows(section)]
        assert len(set(named)) == len(named) > 3


@pytest.mark.parametrize(("column", "params"), [("Here", PAPER), ("Published code", RELEASE)])
def test_what_the_table_says_is_what_the_papers_scale_and_the_recipe_set(column: str, params: Params) -> None:
    stated = settings(column)
    assert [(key, str(value(params, key))) for key, _ in stated] == stated != []


def test_no_setting_of_the_recipe_is_left_out() -> None:
    ours, theirs = PAPER.model_dump(), RELEASE.model_dump()
    differing = {f"{s}.{k}" for s in ours if isinstance(ours[s], dict) for k in ours[s] if ours[s][k] != theirs[s][k]}
    differing -= {"encoder.recipe"}
    assert {"encoder.epochs", "align.max_grad_norm", "lora.projection_schedule", "language.bos"} < differing
    assert differing <= {key for key, _ in settings("Published code")}


@pytest.mark.parametrize("section", ["align", "lora"])
def test_every_setting_of_a_training_stands_in_the_table(section: str) -> None:
    known = {key for key, _ in settings("Here")} | {"lora.target_modules"}
    asked = {f"{section}.{name}" for name in getattr(PAPER, section).model_dump()}
    assert asked - known <= {f"{section}.epochs", f"{section}.micro_batch_size"}


def row(element: str) -> dict[str, str]:
    (found,) = [r for r in ROWS if r["Element"] == element]
    return found


def test_values_that_are_no_settings_are_the_codes() -> None:
    assert " and ".join(PAPER.lora.target_modules) in row("Adapters")["Here"]
    assert str(PUBLISHED_DEVIATION) in row("Start of prompts")["Published code"]
    heads = row("Heads")["Published code"]
    assert f"layer of {HIDDEN}" in heads
    assert f"dropout {DROPOUT}" in heads
    assert VisualPrompts(2, 8, 16, 12).shared is not None
    assert VisualPrompts(2, 8, 16, 12, shared=False).shared is None
    assert Connector(8, 16).delimiters.shape == (2, 16), "two vectors, of the two new tokens"
    assert "two vectors" in row("Word embeddings")["Here"]
    language = load_catalogue(ROOT / "pipeline" / "physiclear").language
    bumps = language.properties[2]
    superlatives = row("Superlative of bumps")
    assert f'"{bumps.most}"' in superlatives["Published code"]
    assert superlatives["Here"] == "the same"
    assert bumps.most.replace("biggest", "smallest") == bumps.least
    catalogue = load_catalogue(ROOT / "pipeline" / "physiclear")
    tested = [catalogue.labels(o) for o, own in catalogue.objects.items() if own.splits["release"] == Part.TEST]
    alike = [a == b for pair in combinations(tested, 2) for a, b in zip(*pair, strict=True)]
    assert f"{sum(alike) / len(alike):.0%}".replace("%", " %") in row("Comparison, answers")["Published code"]
    counts = [str(PAPER.questions.evaluation[task]) for task in ("pc", "pss", "pom")]
    assert ", ".join(counts) in row("Number of test questions")["Here"]
    assert f"and {PAPER.questions.evaluation['psr']}," in row("Number of test questions")["Here"]
    assert {"PSR", "RIPE"} == {name for name, task in TASKS.items() if not task.trained}


def test_both_readings_of_the_scenarios_are_there() -> None:
    raw = yaml.safe_load(Path(ROOT / "pipeline" / "physiclear" / "properties.yaml").read_text())
    sources = {s["source"] for s in raw["scenarios"]}
    named = {v for r in ROWS for k, v in re.findall(r"`(questions\.scenarios)=(\w+)`", " ".join(r.values()))}
    assert sources == named == {"published", "ours"}
