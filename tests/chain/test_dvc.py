"""dvc.yaml agrees with the code: what a stage can import is among its dependencies, by folder or by file."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest
import yaml
from dvc.dependency import ParamsDependency
from dvc.repo import Repo
from dvc.stage.cache import _get_cache_hash
from dvc.stage.serialize import to_single_stage_lockfile

from pipeline import config
from pipeline.core import layout
from pipeline.core.records import Lora, Variant
from tests.closure import ROOT, closure
from tests.project import OBJECTS, REDUCED, copy_project

TOLD = {
    *("pipeline/__init__.py", "pipeline/config/__init__.py", "pipeline/config/params.py", "pipeline/tracking"),
    "pipeline/running",
}
"""How a stage is told what to do and says what it did. They change no result. Of `config.py`, which every stage reads,
that holds for all but what it computes: a parameter is a dependency by its value, and params.yaml has them all."""

COMPUTED = {"fold_of", "replicate_of", "touches", "variants"}
"""What `config.py` computes of parameters, so that it is a dependency of a stage which calls it."""


def stages() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
    return found


DATA = ("pipeline/physiclear/", "pipeline/pretrained")


def code(name: str) -> list[str]:
    """Of its dependencies what is imported; a catalogue is data, and so is a model."""
    deps: list[str] = stages()[name]["deps"]
    return [d for d in deps if d.split("/")[0] in ("pipeline", "stages") and not d.startswith(DATA)]


def data_of(module: str) -> Iterator[str]:
    """What is no code in a module's folder, and Jinja's templates there, in Markdown or not: the module may read it."""
    folder = (ROOT / module).parent
    for file in (*folder.glob("*"), *folder.glob("templates/*")) if folder != ROOT / "pipeline" else ():
        if file.is_file() and (file.suffix not in (".py", ".md") or file.parent.name == "templates"):
            yield file.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("name", sorted(stages()))
def test_dependencies_cover_what_a_stage_can_import(name: str) -> None:
    reached = closure(ROOT / "stages" / f"{name}.py", unfollowed=["pipeline/tracking/live.py"])
    others = set(reached) - {"pipeline/config/__init__.py"}
    called = {word for file in others for word in re.findall(r"\.(\w+)\b", (ROOT / file).read_text())}
    told = TOLD - ({"pipeline/config/__init__.py"} if called & COMPUTED else set())
    told -= {"pipeline/tracking"} if name == "publish" else set()
    read = [file for module in reached for file in data_of(module)]
    covered = (*told, *code(name))
    if name == "report":  # Its provenance has a hash over the code of all stages before it.
        before = stages().keys() - {"report", "package", "publish"}
        reached += [dependency for other in before for dependency in code(other)]
    missing = {m for m in (*reached, *read) if not any(m == d or m.startswith(f"{d}/") for d in covered)}
    assert not missing, f"add to the dependencies of {name} in dvc.yaml"
    idle = [d for d in code(name) if d in told or not any(m == d or m.startswith(f"{d}/") for m in reached)]
    assert not idle, f"{name} has no use for these dependencies"


HEAVY = {"dvc", "fastapi", "hydra", "matplotlib", "mlflow", "pandas", "statsmodels", "torch", "transformers"}
CHEAP = ("weights", "invent", "synthesize", "extract_frames", "split", "audit", "questions", "grade")


@pytest.mark.parametrize("name", CHEAP)
def test_a_stage_loads_nothing_that_it_has_no_use_for(name: str) -> None:
    """Which takes seconds, and thirty processes of a chain start."""
    tree = ast.walk(ast.parse((ROOT / "stages" / f"{name}.py").read_text()))
    code = [ast.unparse(node) for node in tree if isinstance(node, ast.Import | ast.ImportFrom)]
    code += ["import sys", "print(*{name.partition('.')[0] for name in sys.modules})"]
    code.sort(key=lambda line: "__future__" not in line)
    loaded = subprocess.check_output([sys.executable, "-c", "\n".join(code)], text=True, cwd=ROOT).split()
    assert not HEAVY & {*loaded}


def test_the_layout_is_that_of_the_outputs() -> None:
    axes: Any = [f"${{item.{axis}}}" for axis in Variant._fields]
    variant, places = Variant(*axes), {path for path in vars(layout).values() if isinstance(path, Path)}
    made = {layout.answers_dir(variant), layout.encoder_dir(variant.seed), layout.AUDIT / "passed"}
    made |= {layout.trained_dir(variant._replace(lora=lora)) for lora in Lora}
    made |= {layout.split_file(0).parent, layout.embeddings_dir(variant.encoder, 0).parent, layout.PRETRAINED.parent}
    made |= {place for place in places if place.parent == layout.DATA} - {layout.AUDIT}
    assert {str(path) for path in made} <= {str(out) for stage in stages().values() for out in stage.get("outs", [])}


def test_config_computes_nothing_else() -> None:
    """`report_name` is where dvc.yaml looks for the report, and what begins with _ checks a value."""
    sections = [kind for kind in vars(config).values() if isinstance(kind, type) and issubclass(kind, config.Section)]
    own = {n for s in sections for n, value in vars(s).items() if isinstance(value, FunctionType | property)}
    assert {name for name in own if not name.startswith("_")} == {*COMPUTED, "report_name"}


def leaves(values: Any, key: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if not isinstance(values, dict):
        yield key
        return
    for name, value in values.items():
        yield from leaves(value, (*key, name))


def test_every_listed_parameter_changes_the_stage_s_key_in_the_run_cache(tmp_path: Path) -> None:
    """The key by which DVC brings results back, as it computes it from the real dvc.yaml.

    It leaves out what is called `size` or `nfiles`: no parameter may be.
    """
    for file in ("dvc.yaml", "params.yaml"):
        shutil.copy(ROOT / file, tmp_path / file)
    with Repo.init(str(tmp_path), no_scm=True) as repo:
        found = {stage.name.partition("@")[0]: stage for stage in repo.index.stages}
        listed = {name: [d for d in stage.deps if isinstance(d, ParamsDependency)] for name, stage in found.items()}

        def hashed(name: str) -> str:
            for dependency in listed[name]:
                dependency.save()
            return str(_get_cache_hash(to_single_stage_lockfile(found[name]), key=True))

        before = {name: hashed(name) for name in found}
        every = {name: stage.get("params", []) for name, stage in stages().items()}
        values = yaml.safe_load((tmp_path / "params.yaml").read_text())
        checked, silent = set(), []
        for leaf in leaves(values):
            *above, last = leaf
            section = values
            for part in above:
                section = section[part]
            old = section[last]
            section[last] = not old if isinstance(old, bool) else old + 1 if isinstance(old, int | float) else ["other"]
            (tmp_path / "params.yaml").write_text(yaml.safe_dump(values))
            dotted = ".".join(leaf)
            for name in found:
                keys = [key for key in every[name] if f"{dotted}.".startswith(f"{key}.")]
                checked |= {(name, key) for key in keys}
                silent += [f"{name}: {dotted}"] if keys and hashed(name) == before[name] else []
            section[last] = old
    assert checked == {(name, key) for name, keys in every.items() for key in keys}
    assert not silent, "the run cache would bring back the results of another value"


def test_a_split_without_a_test_object_is_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """DVC warns of every empty file at every stage that depends on it, and there are eight that answer."""
    project = copy_project(tmp_path / "untested")
    learnt = ",".join(o for o in OBJECTS if o not in ("bath_towel", "ice_block", "toilet_brush_bristles"))
    project.run("octopi", "scale", *REDUCED, f"scenes.objects=[{learnt}]")
    said = [line for line in project.run("dvc", "repro", "questions").splitlines() if "WARNING" in line]
    with Repo(str(project.folder)) as repo:
        for stage in (stage for stage in repo.index.stages if stage.name.startswith("answer@")):
            for dependency in (dependency for dependency in stage.deps if dependency.exists):
                dependency.save()
    assert [line for line in caplog.messages if "is empty" in line] == []
    assert len(said) == 1
    assert "7 of 7 test objects have no videos (bath_towel, " in said[0]


RUNS_ALL = {"package", "publish", "report"}
EDITS = {
    "pipeline/evaluation/rows.py": RUNS_ALL,
    "pipeline/report/tables.py": {"report", "publish"},
    "pipeline/running/progress.py": set(),
    "pipeline/weights/backbones.py": {
        *("weights", "pretrain", "finetune_encoder", "embed", "evaluate"),
        "report",
        "package",
    },
    "pipeline/evaluation/grading.py": {"grade", "evaluate", *RUNS_ALL},
    "pipeline/tasks/pc.py": {"questions", "grade", "evaluate", *RUNS_ALL},
    "pipeline/language/chat.py": {"align", "lora", "answer", "evaluate", "report", "package"},
}
"""A row of a report, a column of its tables, a line of progress, a backbone, a grader, a prompt and its grader, a chat
format: and the stages that an edit makes stale. What follows these runs where their outputs come out otherwise."""


@pytest.mark.parametrize("file", EDITS)
def test_an_edit_makes_stale_what_it_can_change(file: str) -> None:
    assert (ROOT / file).is_file()
    stale = {n for n in stages() if any(file == d or file.startswith(f"{d}/") for d in code(n))}
    assert stale == EDITS[file]


def test_what_computes_with_floats_depends_on_the_kernels() -> None:
    assert {n for n, own in stages().items() if "kernels" not in own.get("params", [])} == {
        *("split", "questions", "grade", "publish")
    }


NONE = {
    "data.dir": "stands in the paths of dependencies",
    **dict.fromkeys(("tracking.uri", "tracking.experiment", "tracking.live", "tracking.timeout_seconds"), "only shows"),
    "packaged": "which variants are copied",
    "runtime.parallel": "every backend gives the same bytes",
    "runtime.save_steps": "a resumed training ends as one that was not",
    # Sums are added in another order, as on another processor; dvc.lock is to hold on the next machine.
    **dict.fromkeys(("runtime.device", "runtime.threads"), "the machine's"),
    **dict.fromkeys(("runtime.launcher", "runtime.gradient_checkpointing"), "the machine's"),
}
"""Parameters of no stage that computes, and why."""


def test_every_parameter_is_a_stages_or_is_known_to_change_nothing() -> None:
    """Stages that only show or copy what others made list whole sections, and do not count."""
    listed = [k for name, s in stages().items() if name not in ("report", "package") for k in s.get("params", [])]
    found = {".".join(leaf) for leaf in leaves(yaml.safe_load((ROOT / "params.yaml").read_text()))}
    covered = {leaf for leaf in found for key in listed if f"{leaf}.".startswith(f"{key}.")}
    assert found - covered == NONE.keys()


def test_a_command_is_the_same_whatever_the_parameters() -> None:
    """DVC runs a stage anew where its command is another."""
    assert {f.stem for f in (ROOT / "stages").glob("*.py")} == set(stages()), "every script is a stage"
    for name, own in stages().items():
        filled = set(re.findall(r"\$\{(.*?)\}", own["cmd"]))
        assert filled == {f"item.{axis}" for axis in own.get("matrix", {})}, name
