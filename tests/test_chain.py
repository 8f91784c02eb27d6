"""The whole chain, reduced, in a copy of the project: once, again, after a change, and from scratch."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file

from tests.closure import ROOT

PARTS = ("pipeline", "stages", "conf", "standins", "dvc.yaml", "pyproject.toml", ".gitignore", ".dvcignore")
REDUCED = (
    "smoke",
    "ablation.plan=single",
    "scenes.objects=[baseball,controller_base,cotton_ball,pillow,rug,millet,bath_towel,ice_block,toilet_brush_bristles]",
    "scenes.videos_per_object=2",
    "scenes.frames=12",
    "questions.train={opd:12,pc:12,pss:12,pom:12}",
    "questions.evaluation={opd:4,pc:4,pss:4,pom:4,psr:4}",
    "encoder.epochs=1",
    "align.samples=16",
    "lora.samples=16",
    "language.max_new_tokens=24",
)


class Project:
    """A copy of the project in which commands run as a person would type them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(folder),
            "HF_HUB_OFFLINE": "1",
            "GIT_CONFIG_GLOBAL": os.devnull,
        }

    def run(self, *command: str, status: int = 0) -> str:
        """Run a command; return what it printed."""
        done = subprocess.run(
            command, cwd=self.folder, env=self.environment, text=True, capture_output=True, timeout=540, check=False
        )
        output = done.stdout + done.stderr
        assert done.returncode == status, output[-4000:]
        return output


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    folder = tmp_path_factory.mktemp("chain") / "a path with spaces"
    for part in PARTS:
        source, target = ROOT / part, folder / part
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", ".*.part"))
        else:
            shutil.copy(source, target)
    project = Project(folder)
    project.run("git", "init", "--quiet")
    project.run("dvc", "init", "--quiet")
    project.run("dvc", "config", "core.analytics", "false")
    project.run("octopi", "scale", *REDUCED)
    project.run("dvc", "repro")
    return project


def test_tables_and_figures_are_there(project: Project) -> None:
    report = project.folder / "reports" / "smoke-scenes"
    for name in ("README.md", "params.yaml", "provenance.json", "metrics.json", "tables", "figures"):
        assert (report / name).exists(), name
    assert "prove" in (report / "README.md").read_text(), "the smoke report says what its figures are worth"
    assert (project.folder / "mlruns" / "mlflow.db").is_file()


def test_second_time_does_nothing(project: Project) -> None:
    assert "Data and pipelines are up to date." in project.run("dvc", "repro")


def test_changed_grader_regenerates_no_answer(project: Project) -> None:
    grader = project.folder / "pipeline" / "tasks" / "pc.py"
    grader.write_text(grader.read_text() + "\n# changed\n")
    output = project.run("dvc", "repro")
    assert "Running stage 'grade@finetuned-with-all-0'" in output
    for stage in ("answer", "align", "lora", "embed", "finetune_encoder"):
        assert f"Running stage '{stage}" not in output


def test_same_seed_gives_identical_results(project: Project) -> None:
    before = yaml.safe_load((project.folder / "dvc.lock").read_text())
    project.run("dvc", "repro", "--force")
    assert yaml.safe_load((project.folder / "dvc.lock").read_text()) == before


def test_two_processes_train_like_one(project: Project) -> None:
    """The shipped FSDP configuration, on two CPU processes."""
    text = (project.folder / "conf/accelerate/fsdp.yaml").read_text()
    (project.folder / "fsdp.yaml").write_text(
        text.replace("mixed_precision: bf16", "mixed_precision: 'no'\nuse_cpu: true")
    )
    results = []
    project.run("octopi", "scale", *REDUCED, "align.micro_batch_size=8")
    for launcher in (["python"], ["accelerate", "launch", "--config_file", "fsdp.yaml"]):
        project.run(*launcher, "stages/align.py", "finetuned-all-0")
        results.append(load_file(project.folder / "data/align/finetuned-all-0/connector.safetensors"))
    project.run("octopi", "scale", *REDUCED)
    assert results[0].keys() == results[1].keys()
    for name, value in results[0].items():
        torch.testing.assert_close(value, results[1][name], atol=1e-6, rtol=1e-5)


def test_going_back_to_a_scale_restores_it(project: Project) -> None:
    report = project.folder / "reports" / "smoke-scenes" / "metrics.json"
    before = report.read_bytes()
    project.run("octopi", "scale", *REDUCED, "seed=1")
    project.run("octopi", "scale", *REDUCED)
    shutil.rmtree(project.folder / "data" / "lora")
    output = project.run("dvc", "repro")
    assert "is cached - skipping run, checking out outputs" in output
    assert "Running stage 'lora" not in output
    assert report.read_bytes() == before
    # Last, since it leaves the project without its videos.
    shutil.rmtree(project.folder / "data" / "scenes")
    (project.folder / "data" / "scenes" / "videos").mkdir(parents=True)
    message = project.run("python", "stages/catalogue.py", status=1)
    assert "Traceback" not in message
    assert "data/scenes/videos" in message
