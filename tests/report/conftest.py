"""One report for the tests that only read it, and a small scores.csv whose figures are known by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from pipeline.report.build import write_report
from pipeline.report.load import EFFECT_COLUMNS, SCORE_COLUMNS
from tests.fake_run import fake_params, write_run


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a report over two seeds."""
    root = tmp_path_factory.mktemp("run")
    params = write_run(root, fake_params("ablation.seeds=[0,1]", "ablation.touch=[removed,swapped]"))
    write_report(params, root)
    return root / "reports" / params.report_name


def score(
    task: str = "PC", measure: str = "choice", *, variant: str = "finetuned with all", **other: Any
) -> dict[str, Any]:
    """A row of scores.csv: half of 40 answers right, a tenth unread; `variant` is encoder, lora and opd."""
    named = dict(zip(("encoder", "lora", "opd"), variant.split(" "), strict=True))
    figures = {"n": 40, "right": 20.0, "unread": 4.0, "accuracy": 0.5, "low": 0.35, "high": 0.65, "chance": 1 / 3}
    return {"task": task, "measure": measure, **named, "touch": "real", "seed": "all", **figures, **other}


def effect(part: str = "lora", change: str = "with - without", **other: Any) -> dict[str, Any]:
    """A row of effects.csv: ten points, sure of nothing."""
    figures = {"difference": 0.1, "low": -0.1, "high": 0.3, "p": 0.2, "p_holm": 0.8, "smallest_effect": 0.25}
    counts = {"n": 40, "objects": 12, "seeds": 1}
    return {"part": part, "change": change, "task": "PC", "measure": "choice", **figures, **counts, **other}


def scores_of(*rows: dict[str, Any]) -> pd.DataFrame:
    frame = pd.DataFrame(list(rows), columns=list(SCORE_COLUMNS))
    return frame.astype(dict.fromkeys(SCORE_COLUMNS[7:], float))


def effects_of(*rows: dict[str, Any]) -> pd.DataFrame:
    frame = pd.DataFrame(list(rows), columns=list(EFFECT_COLUMNS))
    return frame.astype(dict.fromkeys(EFFECT_COLUMNS[4:], float))
