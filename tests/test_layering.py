"""Imports go downward, in the order that the folders are to be read in."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.closure import ROOT, imported

CORE = (
    *("__init__", "running.__init__", "running.errors", "running.progress", "core", "config", "running.parallel"),
    *("weights", "training", "running.stage"),
)
"""What the rooms share; of running/ file by file."""
ROOMS = ("videos", "scenes", "tasks", "encoder", "language", "evaluation", "report", "tracking", "use")
TOP = ("scales", "cli")
ORDER = (*CORE, *ROOMS, *TOP)
MODULES = sorted((ROOT / "pipeline").rglob("*.py"))


def room(file: Path) -> str | None:
    """The room of a project file, of running/ the file itself, or None outside pipeline/."""
    top, *parts = file.relative_to(ROOT).with_suffix("").parts
    return None if top != "pipeline" else ".".join(parts) if parts[0] == "running" else parts[0]


def test_what_is_listed_is_there_once() -> None:
    assert sorted(ORDER) == sorted({str(room(file)) for file in MODULES})


@pytest.mark.parametrize("file", MODULES, ids=lambda f: str(f.relative_to(ROOT)))
def test_imports_go_downward(file: Path) -> None:
    own = room(file)
    assert own in ORDER, f"{file}: give its room a place"
    for other in imported(file) - {file}:
        target = room(other)
        assert target is not None, f"{file} imports {other} from outside pipeline/"
        assert ORDER.index(target) <= ORDER.index(own), f"{own} must not import {target}"
        assert (own, target) != ("language", "encoder"), "a change of the encoder must rerun no language training"


def test_only_tracking_imports_mlflow() -> None:
    found = {room(f) for f in MODULES if "import mlflow" in f.read_text() or "from mlflow" in f.read_text()}
    assert found == {"tracking"}
