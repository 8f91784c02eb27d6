"""A copy of the project with the whole chain in it, as small as it goes: minutes of work for the tests that run it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.closure import ROOT

PARTS = ("pipeline", "stages", "conf", "external/.gitkeep", "dvc.yaml", "pyproject.toml", ".gitignore", ".dvcignore")
OBJECTS = (
    *("baseball", "controller_base", "cotton_ball", "pillow", "rice"),
    "millet",
    *("bath_towel", "ice_block", "toilet_brush_bristles"),
)
"""To train on, to choose the encoder by, and to test on in the paper's split."""
REDUCED = (
    "smoke",
    "ablation.encoders=[finetuned]",
    "ablation.lora=[with]",
    "ablation.opd=[all]",
    f"scenes.objects=[{','.join(OBJECTS)}]",
    "scenes.videos_per_object=2",
    "scenes.frames=12",
    "scenes.width=96",
    "scenes.height=72",
    "questions.train={opd:12,pc:12,pss:12,pom:12}",
    "questions.evaluation={opd:4,pc:4,pss:4,pom:4,psr:4}",
    "encoder.epochs=1",
    "align.samples=16",
    "align.train_embeddings=all",
    "lora.samples=16",
    "language.max_new_tokens=24",
    "evaluate.models=[]",
)


ENVIRONMENT = {
    **os.environ,
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    "PYTHONPATH": str(ROOT),
    "GIT_CONFIG_GLOBAL": os.devnull,
}
"""Of what a test starts: this project's commands and code, and nobody's own settings of Git."""


class Project:
    """A copy of the project in which commands run as a person would type them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {**ENVIRONMENT, "PYTHONPATH": str(folder), "HF_HUB_OFFLINE": "1"}

    def run(self, *command: str, status: int = 0) -> str:
        """Run a command; return what it printed."""
        done = subprocess.run(
            command, cwd=self.folder, env=self.environment, text=True, capture_output=True, check=False
        )
        output = done.stdout + done.stderr
        assert done.returncode == status, output[-4000:]
        return output


def copy_project(folder: Path) -> Project:
    """Copy what the chain is made of into a new folder, under Git and DVC."""
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
    (folder / ".dvc" / "config").write_text("[core]\nanalytics = false\n")
    return project
