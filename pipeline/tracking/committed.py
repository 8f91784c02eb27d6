"""Is what a reproduction ran with, and what it made, what Git's HEAD holds? Answered from hashes, file by file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pipeline.params import PARAMS_FILE, Params
from pipeline.errors import UserError
from pipeline.revisions import Commit, Disk, find_commit
from pipeline.tracking.reproduction import planned_stages

LOCK_FILE, VIDEOS = "dvc.lock", "data/videos.parquet"
NAMED = 3
COMMIT_SHOWN = 12


@dataclass(frozen=True)
class Check:
    """One part of the answer."""

    what: str
    same: bool
    looked_at: str
    """What was held against the commit and, where it is not the same, what differs."""


@dataclass(frozen=True)
class Committed:
    """The whole answer."""

    commit: str
    """The hash of HEAD; empty without Git."""
    checks: tuple[Check, ...]

    @property
    def answer(self) -> str:
        """`yes`, `no` with what is not, or `unknown`."""
        if not self.commit:
            return "unknown: no Git commit"
        other = [check.what for check in self.checks if not check.same]
        return f"no: {', '.join(other)}" if other else "yes"

    @property
    def short(self) -> str:
        """The commit as people write it."""
        return self.commit[:COMMIT_SHOWN]


def committed(params: Params, root: Path) -> Committed:
    """Hold the reproduction in `root` against HEAD: its code, parameters, data, results and report.

    Code is what dvc.lock says that the stages read, not what lies on disk: an edit that nothing has run with yet
    changes no answer. Folders that are no data of the chain (weights, a catalogue) count with the results, by DVC's
    hashes.
    """
    try:
        head = find_commit(root, "HEAD")
    except UserError:
        return Committed("", ())
    disk = Disk(root)
    titles = [stage.title for stage in planned_stages(params.plan)]
    here, there = (_entries(tree.read([LOCK_FILE]).get(LOCK_FILE, b""), titles) for tree in (disk, head))
    checks = (
        _code(here, head),
        _files("parameters", [str(PARAMS_FILE)], disk, head),
        _data(params, here, there),
        _results(here, there),
        _report(params, disk, head),
    )
    return Committed(head.oid, checks)


def _entries(lock: bytes, titles: Sequence[str]) -> dict[str, Any]:
    """The planned stages of a dvc.lock. A broken one holds none: what differs is the answer, not an error."""
    try:
        stages = (yaml.load(lock, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)) or {}).get("stages") or {}
    except (yaml.YAMLError, AttributeError):
        return {}
    return {title: stages[title] for title in titles if title in stages}


def _hashes(entries: Mapping[str, Any], kind: str) -> dict[str, set[str]]:
    """Path to hash; several where stages ran with different versions of a file."""
    found: dict[str, set[str]] = {}
    for entry in entries.values():
        for item in entry.get(kind) or ():
            found.setdefault(item["path"], set()).add(str(item.get("md5", "")))
    return found


def _code(here: Mapping[str, Any], head: Commit) -> Check:
    made = _hashes(here, "outs")
    read = {
        path: oids
        for path, oids in _hashes(here, "deps").items()
        if path not in made and not path.startswith("data/") and not any(oid.endswith(".dir") for oid in oids)
    }
    contents = head.read(read)
    other = [path for path, oids in sorted(read.items()) if oids != {_md5(contents.get(path))}]
    return Check("code", not other, _words(len(read), "file that stages read", other, "files that stages read"))


def _files(what: str, names: Sequence[str], disk: Disk, head: Commit) -> Check:
    one, other = disk.read(names), head.read(names)
    differ = [name for name in names if one.get(name) != other.get(name)]
    return Check(what, not differ, _words(len(names), names[0] if len(names) == 1 else "file", differ))


def _data(params: Params, here: Mapping[str, Any], there: Mapping[str, Any]) -> Check:
    names = (params.data.dir, VIDEOS)
    one, other = (_hashes(entries, "deps") for entries in (here, there))
    differ = [name for name in names if one.get(name) != other.get(name)]
    return Check("data", not differ, _words(len(names), "hash in dvc.lock", differ, "hashes in dvc.lock"))


def _results(here: Mapping[str, Any], there: Mapping[str, Any]) -> Check:
    differ = [title for title, entry in here.items() if there.get(title) != entry]
    return Check(
        "results", bool(here) and not differ, _words(len(here), "stage in dvc.lock", differ, "stages in dvc.lock")
    )


def _report(params: Params, disk: Disk, head: Commit) -> Check:
    folder = f"reports/{params.report_name}"
    names = sorted({*disk.files(folder), *head.files(folder)})
    if not names:
        return Check("report", False, f"{folder}: none")
    return _files("report", names, disk, head)


def _words(count: int, one: str, differ: Sequence[str], many: str = "") -> str:
    looked_at = one if count == 1 else f"{count} {many or one + 's'}"
    if not differ:
        return looked_at
    more = f" and {len(differ) - NAMED} more" if len(differ) > NAMED else ""
    return f"{looked_at}; not the same: {', '.join(differ[:NAMED])}{more}"


def _md5(content: bytes | None) -> str:
    return "" if content is None else hashlib.md5(content, usedforsecurity=False).hexdigest()
