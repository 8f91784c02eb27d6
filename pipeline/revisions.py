"""The project's files as a Git commit holds them, or as they lie on disk: both read the same way.

Paths are relative to the project's folder, with slashes; the folder may stand anywhere in its repository.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pipeline.errors import UserError

WORKING_TREE = "working tree"
SECONDS = 60


class Tree(Protocol):
    """A project at one point of its history."""

    @property
    def name(self) -> str:
        """What a person calls it."""
        ...

    def files(self, folder: str) -> list[str]:
        """All files below a folder, sorted; none where it is absent."""
        ...

    def read(self, paths: Iterable[str]) -> dict[str, bytes]:
        """The contents of those of these files that are there."""
        ...


@dataclass(frozen=True)
class Disk:
    """What lies in the folder now, committed or not."""

    root: Path

    @property
    def name(self) -> str:
        """It has no revision's name."""
        return WORKING_TREE

    def files(self, folder: str) -> list[str]:
        """All files below a folder, sorted; hidden ones are somebody's unfinished writing."""
        found = (p for p in (self.root / folder).rglob("*") if p.is_file() and not p.name.startswith("."))
        return sorted(p.relative_to(self.root).as_posix() for p in found)

    def read(self, paths: Iterable[str]) -> dict[str, bytes]:
        """The contents of those of these files that are there."""
        return {path: (self.root / path).read_bytes() for path in paths if (self.root / path).is_file()}


@dataclass(frozen=True)
class Commit:
    """A commit; make it with `find_commit`."""

    root: Path
    name: str
    """As the person wrote it, and the hash where that is something else."""
    oid: str
    blobs: dict[str, str]
    """File to its object in Git, for all files of the project's folder."""

    def files(self, folder: str) -> list[str]:
        """All files below a folder, sorted."""
        return sorted(path for path in self.blobs if path.startswith(f"{folder}/"))

    def read(self, paths: Iterable[str]) -> dict[str, bytes]:
        """The contents of those of these files that are there, by one process of Git."""
        wanted = [path for path in dict.fromkeys(paths) if path in self.blobs]
        if not wanted:
            return {}
        names = "".join(f"{self.blobs[path]}\n" for path in wanted)
        rest, contents = _git(self.root, "cat-file", "--batch", feed=names.encode()), {}
        for path in wanted:
            header, _, rest = rest.partition(b"\n")
            size = int(header.split()[-1])
            contents[path], rest = rest[:size], rest[size + 1 :]
        return contents


def find_commit(root: Path, revision: str) -> Commit:
    """The commit that a revision (a hash, a tag, a branch, `HEAD~1`) names.

    Raises:
        UserError: where `root` is in no Git repository, or the repository has no such commit.
    """
    try:
        _git(root, "rev-parse", "--git-dir")
    except subprocess.CalledProcessError:
        raise UserError(f"{root.resolve()}: in no Git repository; run this in a clone of the project") from None
    except OSError:
        raise UserError("git: not found; install it") from None
    try:
        oid = _git(root, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}").decode()
    except (subprocess.CalledProcessError, ValueError):
        raise UserError(f"{revision}: no commit of this repository; `git log` lists them") from None
    oid = oid.strip()
    # Like all plumbing that lists, it starts where it is called, and names files from there.
    lines = _git(root, "ls-tree", "-r", "-z", oid).decode("utf-8", "surrogateescape").split("\0")
    blobs = {path: line.split()[2] for line, tab, path in (entry.partition("\t") for entry in lines) if tab}
    name = revision if oid.startswith(revision) else f"{revision} ({oid[:8]})"
    return Commit(root, name, oid, blobs)


def _git(root: Path, *arguments: str, feed: bytes | None = None) -> bytes:
    done = subprocess.run(["git", *arguments], cwd=root, input=feed, capture_output=True, check=True, timeout=SECONDS)
    return done.stdout
