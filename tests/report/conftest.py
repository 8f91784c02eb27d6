"""A report that tests only read, and small reports whose figures are known by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from pipeline.report.build import write_report
from pipeline.report.load import DATASET, EFFECT_COLUMNS, SCORE_COLUMNS, Report, published
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
    figures = {
        "n": 40,
        "sets": 9,
        "right": 20.0,
        "unread": 4.0,
        "accuracy": 0.5,
        "low": 0.35,
        "high": 0.65,
        "chance": 1 / 3,
    }
    return {"task": task, "measure": measure, **named, "touch": "real", "seed": "all", **figures, **other}


def effect(part: str = "lora", change: str = "with - without", **other: Any) -> dict[str, Any]:
    """A row of effects.csv: ten points, sure of nothing."""
    figures = {"difference": 0.1, "low": -0.1, "high": 0.3, "p": 0.2, "p_holm": 0.8, "smallest_effect": 0.25}
    counts = {"n": 40, "objects": 12, "seeds": 1}
    return {"part": part, "change": change, "task": "PC", "measure": "choice", **figures, **counts, **other}


def report(
    scores: Sequence[dict[str, Any]] = (),
    effects: Sequence[dict[str, Any]] = (),
    *,
    name: str = "small-videos",
    dataset: str = DATASET,
    **said: Any,
) -> Report:
    """A report on real videos with these rows; `said` is of its provenance, `language` of its language model."""
    base = {"folder": "weights/x", "taught": "taught by hand", "sha256": "ab" * 32}
    models = {
        "language": {**base, "kind": "Llama", "parameters": 2_200_000, **said.pop("language", {})},
        "encoder": {**base, "kind": "CLIP", "parameters": 1_100_000},
    }
    data = {"source": "videos", "dataset": dataset, "videos": 9, "data_sha256": "d" * 64}
    tested = {"split": "paper", "test_objects": ["a", "b"], "test_videos": 4, "seeds": [0], "settings": ""}
    run = {"scale": "small", "command": "dvc repro", "code_sha256": "c" * 64, "python": "3"}
    system = {"encoder": "the base CLIP with visual prompt tuning", "base_models": models, "facts_told": False}
    facts = {**data, **tested, **run, **system, "packages": {"torch": "2"}, "intervals": "", "properties": {}, **said}
    # Text columns come first, then numbers.
    score_rows = pd.DataFrame(scores, columns=SCORE_COLUMNS).astype(dict.fromkeys(SCORE_COLUMNS[7:], float))
    effect_rows = pd.DataFrame(effects, columns=EFFECT_COLUMNS).astype(dict.fromkeys(EFFECT_COLUMNS[4:], float))
    return Report(Path("reports") / name, score_rows, effect_rows, published(dataset), facts, {})
