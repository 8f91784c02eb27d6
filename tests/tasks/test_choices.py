"""The table of choices says what the code does, wherever a value can be read from it."""

from __future__ import annotations

import re
from typing import Any

import pytest

from pipeline.config import Params
from pipeline.scales import compose
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
