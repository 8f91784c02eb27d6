"""dvc.yaml agrees with the code: what a stage can import is among its dependencies, by folder or by file."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from pipeline.config import Params
from pipeline.scales import compose, shipped_scales
from tests.closure import ROOT, closure

TOLD = {
    *("pipeline/__init__.py", "pipeline/errors.py", "pipeline/config.py", "pipeline/params.py", "pipeline/stage.py"),
    *("pipeline/parallel.py", "pipeline/io.py", "pipeline/records.py", "pipeline/tracking", "pipeline/card.py"),
}
"""How a stage is told what to do, says what it did and hands on what it made. They change no result: parameters are
dependencies by value, and a file that does not fit today's records is refused when it is read."""


def stages() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
    return found


def code(name: str) -> list[str]:
    return [d for d in stages()[name]["deps"] if d.startswith(("pipeline/", "stages/"))]


@pytest.mark.parametrize("name", sorted(stages().keys() - {"publish"}))
def test_dependencies_cover_what_a_stage_can_import(name: str) -> None:
    reached = closure(ROOT / "stages" / f"{name}.py", unfollowed=["pipeline/tracking/live.py"])
    covered = (*TOLD, *code(name))
    missing = [m for m in reached if not any(m == d or m.startswith(f"{d}/") for d in covered)]
    assert not missing, f"add to the dependencies of {name} in dvc.yaml"
    idle = [d for d in code(name) if not any(m == d or m.startswith(f"{d}/") for m in reached)]
    assert not idle, f"{name} imports nothing of these dependencies"


def test_dvc_yaml_is_read_on_a_few_screens() -> None:
    assert len((ROOT / "dvc.yaml").read_text().splitlines()) <= 300
    assert len((ROOT / "params.yaml").read_text().splitlines()) <= 150


def test_every_script_is_a_stage() -> None:
    assert {f.stem for f in (ROOT / "stages").glob("*.py")} == set(stages())


@pytest.mark.parametrize("name", sorted(stages()))
def test_params_exist(name: str) -> None:
    for key in stages()[name].get("params", []):
        model: Any = Params
        for part in key.split("."):
            assert part in model.model_fields, f"{name}: {key} is no parameter"
            model = model.model_fields[part].annotation


def test_language_training_does_not_depend_on_the_encoders_code() -> None:
    assert not [d for name in ("align", "lora", "answer") for d in code(name) if "encoder" in d]


@pytest.mark.parametrize("scale", shipped_scales(ROOT / "conf"))
def test_every_scale_has_the_matrices_lists(scale: str) -> None:
    ablation = compose(scale, conf=ROOT / "conf").ablation
    for name in ("align", "lora", "answer"):
        for axis, values in stages()[name]["matrix"].items():
            assert values == f"${{ablation.{axis if axis in ('lora', 'opd') else axis + 's'}}}"
            assert getattr(ablation, values[len("${ablation.") : -1])
