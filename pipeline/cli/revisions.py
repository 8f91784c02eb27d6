"""The project's files as a Git commit or the disk has them, and what DVC's cache holds of that state."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from dvc.api import DVCFileSystem
from dvc.exceptions import DvcException
from dvc.repo import Repo

from pipeline.core.errors import UserError


@dataclass(frozen=True)
class State:
    """The project at one point of its history; make it with `find_state`."""

    name: str
    """The revision as the person wrote it, with its hash."""
    files: DVCFileSystem

    def read(self, path: str) -> bytes | None:
        """A file from Git, the disk or DVC's cache; None where it is not at hand."""
        try:
            return bytes(self.files.read_bytes(path))
        except (OSError, DvcException):
            return None

    def mapping(self, path: str) -> dict[str, Any]:
        """A file in YAML or JSON; empty where it is absent, a UserError where it is something else."""
        try:
            found = yaml.load(self.read(path) or b"{}", Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        except yaml.YAMLError:
            found = None
        if not isinstance(found, dict):
            raise UserError(f"{path} of {self.name}: not a mapping; restore it from Git")
        return found

    def folders(self, folder: str) -> list[str]:
        """What lies in a folder, sorted; nothing where it is absent."""
        return sorted(self.files.ls(folder, detail=False)) if self.files.isdir(folder) else []


def find_state(root: Path, revision: str | None) -> State:
    """The state that a revision (a hash, a tag, a branch, `HEAD~1`, a DVC experiment) names; the working tree for None.

    Raises:
        UserError: where there is no such commit, or `root` is in no Git repository or no DVC project.
    """
    name = "HEAD" if revision is None else revision
    git = ["git", "rev-parse", "--verify", "--quiet", "--end-of-options"]
    commit = subprocess.run([*git, f"{name}^{{commit}}"], cwd=root, capture_output=True, text=True).stdout.split()
    if not commit:
        # DVC keeps an experiment as refs/exps/<two digits>/<the rest of the commit that it began from>/<its name>.
        listed = ["git", "for-each-ref", "--format=%(refname) %(objectname)", "refs/exps"]
        lines = subprocess.run(listed, cwd=root, capture_output=True, text=True).stdout.splitlines()
        commit = [line.split()[1] for line in lines if line.split()[0].rpartition("/")[2] == name]
    if len(commit) != 1:  # None, or those of a range.
        there = f"no commit of a Git repository in {root.resolve()}"
        raise UserError(f"{revision or name}: {there}; `git log` and `dvc exp list` list them")
    try:
        files = DVCFileSystem(repo=Repo(str(root), rev=None if revision is None else commit[0]))
    except DvcException as error:
        raise UserError(f"{root.resolve()}: {error}") from None
    return State("working tree" if revision is None else f"{revision} ({commit[0][:8]})", files)
