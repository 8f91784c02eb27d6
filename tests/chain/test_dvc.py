"""dvc.yaml agrees with the code: each stage names every module that it reaches, and no other."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from pipeline.params import Params
from pipeline.scales import compose, shipped_scales
from tests.closure import ROOT, closure


def stages() -> dict[str, dict[str, Any]]:
    text = yaml.safe_load((ROOT / "dvc.yaml").read_text())
    return {name: stage.get("do", stage) for name, stage in text["stages"].items()}


@pytest.mark.parametrize("name", sorted(stages()))
def test_stage_names_the_modules_it_reaches(name: str) -> None:
    named = sorted(d for d in stages()[name]["deps"] if d.endswith(".py"))
    reached = closure(ROOT / "stages" / f"{name}.py")
    assert named == reached, "dvc.yaml should list under deps:\n" + "\n".join(f"  - {m}" for m in reached)


def test_every_script_is_a_stage() -> None:
    assert {f.stem for f in (ROOT / "stages").glob("*.py")} == set(stages())


@pytest.mark.parametrize("name", sorted(stages()))
def test_params_exist(name: str) -> None:
    for key in stages()[name].get("params", []):
        model: Any = Params
        for part in key.split("."):
            assert part in model.model_fields, f"{name}: {key} is no parameter"
            model = model.model_fields[part].annotation


def test_generating_does_not_depend_on_grading() -> None:
    deps = stages()["answer"]["deps"]
    assert not [d for d in deps if "tasks/" in d or "grading" in d]


def test_a_changed_report_is_published() -> None:
    """The dashboard keeps a copy of the report, which may change where no score does, by a new table or figure."""
    outs = [out for name in ("report", "compare_encoders") for out in stages()[name]["outs"]]
    written = [path for out in outs for path in ([out] if isinstance(out, str) else out) if path.startswith("reports/")]
    assert len(written) == 8
    read = tuple(f"{dep}/" for dep in stages()["publish"]["deps"])
    assert not [path for path in written if not path.startswith(read)]


@pytest.mark.parametrize("scale", shipped_scales(ROOT / "conf"))
def test_foreach_keys_are_in_the_plan(scale: str) -> None:
    plan = compose(scale, conf=ROOT / "conf").plan
    assert set(plan.lora) <= set(plan.align)
    for variant in plan.variants.values():
        kind, key = variant.model_dir.removeprefix("data/").split("/")
        assert key in getattr(plan, kind)
        assert variant.embeddings in plan.embeddings
