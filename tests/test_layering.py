"""Imports go strictly downward: a module may import only from its own room or from rooms below."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.closure import ROOT, imported

LEVELS = {
    "__init__": 0,
    "errors": 0,
    "revisions": 0,
    "records": 0,
    "decoding": 0,
    "runtime": 0,
    "artifacts": 0,
    "plan": 0,
    "contestants": 0,
    "sections": 0,
    "config": 0,
    "statistics": 0,
    "physiclear": 1,
    "scenes": 2,
    "videos": 2,
    "frames": 3,
    "splits": 2,
    "parallel": 0,
    "audit": 8,
    "prompts": 2,
    "tasks": 2,
    "questions": 3,
    "baseline": 4,
    "data": 4,
    "models": 5,
    "training": 6,
    "evaluation": 6,
    "stability": 6,
    "tracking": 7,
    "reporting": 7,
    "speed": 8,
    "review": 9,
    "comparison": 8,
    "stage": 7,
    "scales": 7,
    "cli": 10,
    "benchmarks": 10,
}


def room(file: Path) -> str | None:
    """The room of a project file, or None outside pipeline/."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return parts[1] if parts[0] == "pipeline" and len(parts) > 1 else None


MODULES = sorted((ROOT / "pipeline").rglob("*.py"))


@pytest.mark.parametrize("file", MODULES, ids=lambda f: str(f.relative_to(ROOT)))
def test_imports_go_downward(file: Path) -> None:
    own = room(file)
    assert own in LEVELS, f"{file}: give its room a level"
    for other in imported(file) - {file}:
        target = room(other)
        assert target is not None, f"{file} imports {other} from outside pipeline/"
        if target not in (own, "__init__"):
            assert LEVELS[target] < LEVELS[own] or LEVELS[own] == 0, f"{own} must not import {target}"


def test_level_zero_has_no_cycle() -> None:
    order = ["__init__", "errors", "records", "runtime", "artifacts", "plan", "contestants", "sections", "config"]
    for position, name in enumerate(order):
        targets = {room(f) for f in imported(ROOT / "pipeline" / f"{name}.py")} - {None}
        assert targets <= set(order[: position + 1]), f"{name} imports upwards"


@pytest.mark.parametrize("name", ["mlflow"])
def test_only_tracking_imports_mlflow(name: str) -> None:
    users = [f for f in MODULES if f"import {name}" in f.read_text() or f"from {name}" in f.read_text()]
    assert {room(f) for f in users} <= {"tracking", "benchmarks"}


def test_stages_hold_no_logic() -> None:
    for file in sorted((ROOT / "stages").glob("*.py")):
        text = file.read_text()
        assert text.count("def ") == 1, f"{file}: logic belongs into pipeline/"
        assert len(text.splitlines()) <= 60, f"{file}: a stage reads, calls and writes"
