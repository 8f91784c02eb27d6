"""Reports for tests of the page, made of those in Git, and the page as tests read it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pandas as pd

from tests.checkpoints import edit
from tests.closure import ROOT

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
