"""What a person does with the folder: clone it on Windows, put it where a path has a space, move it."""

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.checkpoints import model_folder
from tests.closure import ROOT

UV = f"""#!/bin/sh
mkdir -p .venv/bin
ln -sf {sys.executable} .venv/bin/python
printf '%s\\n' "$@" >> said
"""


def test_a_moved_folder_is_installed_anew_and_a_taken_port_refused(tmp_path: Path) -> None:
    """With a `uv` that writes down what it is told; the old scripts would name an interpreter that is not there."""
    (tmp_path / "uv").write_text(UV)
    (tmp_path / "uv").chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    (clone := tmp_path / "a clone").mkdir()
    for file in ("Makefile", "requirements.lock", "requirements-weights.lock", "pyproject.toml"):
        shutil.copy(ROOT / file, clone)
    for folder in (clone, tmp_path / "a clone moved"):
        clone.rename(folder)
        subprocess.run(["make", "install"], cwd=folder, env=environment, check=True)
        assert f"--python\n{folder}/.venv/bin/python\n" in (folder / "said").read_text()
        assert subprocess.run(["make", "-q", "install"], cwd=folder, env=environment, check=False).returncode == 0
        assert not (folder / ".venv/old").exists()
        (folder / ".venv/old").touch()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        command = f"make dashboard PORT={taken.getsockname()[1]}"
        said = subprocess.run(f"! {command}", shell=True, check=True, cwd=folder, env=environment, capture_output=True)
    assert b"is taken; name another" in said.stdout


def test_a_clone_has_the_bytes_that_hashes_are_of_whatever_git_is_told(tmp_path: Path) -> None:
    shutil.copy(ROOT / ".gitattributes", tmp_path)
    (tmp_path / "a.json").write_bytes(b"one\ntwo\n")
    own = "git init -q && git add . && git -c user.name=a -c user.email=a@b commit -qm a"
    subprocess.run(f"{own} && git clone -qc core.autocrlf=true . b", shell=True, check=True, cwd=tmp_path)
    assert (tmp_path / "b/a.json").read_bytes() == b"one\ntwo\n"


HIDDEN = """
import sys
from importlib.machinery import PathFinder
from pipeline.running.errors import EXTRAS

class Shown(PathFinder):
    @classmethod
    def find_spec(cls, name, *where):
        return None if name.partition(".")[0] in EXTRAS else super().find_spec(name, *where)

sys.meta_path[sys.meta_path.index(PathFinder)] = Shown
"""
USED = """
from pathlib import Path
from pipeline import Octopi
from pipeline.use.adapt import adapt

model = Octopi.from_pretrained()
videos = [f"{sys.argv[1]}/{name}.mp4" for name in ("soft", "hard")]
said = model.describe(videos[0])
assert said.levels["hardness"] == "soft" and "soft" in said.sentence
assert "softer" in model.ask("Which is softer?", videos)
adapt(model, videos, Path("adapted"))
model.remember("mug", videos[0], "touches")
assert model.recognise(videos[0], "touches").objects[0].name == "mug"
"""


@pytest.mark.slow
def test_the_core_answers_without_the_extras(tmp_path: Path) -> None:
    (tmp_path / "octopi").mkdir()
    (tmp_path / "octopi" / "smollm2").symlink_to(model_folder("smollm2"))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-c", HIDDEN + USED, str(ROOT / "examples")]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)


COMMANDS = {"serve": "serve", "demo": "serve", "repro": "train", "scale smoke": "train", "diff HEAD": "train"}


@pytest.mark.parametrize(("command", "extra"), COMMANDS.items())
def test_a_command_names_the_extra_that_it_takes(command: str, extra: str) -> None:
    code = f"{HIDDEN}from pipeline.cli import main\nmain()"
    done = subprocess.run(
        [sys.executable, "-c", code, *command.split()], cwd=ROOT, text=True, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done.stderr
    assert f"octopi-pipeline[{extra}]" in done.stderr
