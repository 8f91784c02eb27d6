"""What a person does with the folder: clone it on Windows, put it where a path has a space, move it."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

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
