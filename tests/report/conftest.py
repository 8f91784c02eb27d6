"""A report that tests only read, small ones known by hand, those in Git, and the page as tests read it."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pandas as pd
import pytest

from pipeline.report.build import write_report
from pipeline.report.load import DATASET, EFFECT_COLUMNS, SCORE_COLUMNS, Report, published
from tests.checkpoints import edit
from tests.closure import ROOT
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
    counts = {"n": 40, "sets": 9, "right": 20.0, "unread": 4.0}
    figures = {"accuracy": 0.5, "low": 0.35, "high": 0.65, "chance": 1 / 3}
    return {"task": task, "measure": measure, **named, "touch": "real", "seed": "all", **counts, **figures, **other}


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


STABILITY = """part,case,format,finite,error,bound,verdict
loss,large,float64,True,1e-15,1e-14,pass
loss,large,bfloat16,False,0.5,0.25,fail
"""


def write_reports(root: Path, *names: str) -> Path:
    """reports/ with what the page shows: the report of `smoke` under each of these names, speed and stability.

    Where a name is of another scale, the base models are none of the random ones.
    """
    reports = root / "reports"
    for name in names:
        shutil.copytree(ROOT / "reports" / "smoke-scenes", reports / name)
        scale, source = name.split("-")
        file = reports / name / "provenance.json"
        edit(file, report=name, scale=scale, source=source)
        if scale != "smoke":
            models = json.loads(file.read_text())["base_models"]
            edit(
                file,
                base_models={part: {**model, "folder": f"weights/{part}"} for part, model in models.items()},
            )
    shutil.copy(ROOT / "reports" / "speed_error.csv", reports)
    shutil.copytree(ROOT / "reports" / "speed_error", reports / "speed_error")
    (reports / "stability.csv").write_text(STABILITY)
    return root


def rows_of(file: Path) -> list[dict[str, Any]]:
    """Every cell as the text that stands there."""
    return pd.read_csv(file, dtype=str, keep_default_na=False).to_dict("records")


def write_rows(file: Path, rows: list[dict[str, Any]]) -> None:
    pd.DataFrame(rows).to_csv(file, index=False)


class Page:
    """The elements of a page, which is well-formed as XML too."""

    def __init__(self, file: Path) -> None:
        self.root = ElementTree.fromstring(file.read_text(encoding="utf-8"))

    def all(self, *tags: str, kind: str = "") -> list[ElementTree.Element]:
        return [e for e in self.root.iter() if e.tag in tags or kind in e.get("class", "").split()]

    def named(self, name: str) -> ElementTree.Element:
        (found,) = [e for e in self.root.iter() if e.get("id") == name]
        return found


def words(element: ElementTree.Element) -> str:
    return " ".join(" ".join(element.itertext()).split())
