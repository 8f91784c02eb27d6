"""Video files: which ones a folder holds, and whose they are."""

from __future__ import annotations

import csv
import os
import posixpath
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.core.io import atomic
from pipeline.running.errors import UserError, readable
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.catalogue.csv_reader import read_rows
from pipeline.videos.decoding import SUFFIXES
from pipeline.videos.records import Finding, Severity, finding

LIST_FILE = "videos.csv"
"""Optional, in the videos' folder: columns `file`, `object_id` and, where known, `session`."""
SECTION = ("begin", "end")
"""Columns of a table that `octopi import video` cuts by; the chain itself takes whole files."""

PASSED = "passed over"
"""Name of the check that lists files which are no videos."""


@dataclass(frozen=True)
class VideoFile:
    """A video file: which video of which object it is."""

    path: Path
    relative: str
    """Path relative to the data folder, with forward slashes."""
    object_id: str
    video_id: str
    session: str = ""
    """The recording session that videos.csv names; empty where none is known."""

    def __str__(self) -> str:
        return self.relative


@dataclass(frozen=True)
class Listing:
    """What a folder's names say: the files that fit, and what is wrong with the others."""

    files: tuple[VideoFile, ...]
    findings: tuple[Finding, ...]
    unknown_objects: tuple[str, ...] = ()
    """Objects that have videos here but are not in the catalogue, sorted."""


def list_videos(folder: Path, catalogue: Catalogue) -> Listing:
    """The videos of a folder and its subfolders, sorted by object and number; nothing is opened.

    A file is named `<object>_<number>` with one of `SUFFIXES`, or stands in the folder's `videos.csv`, and then only
    the files of that list count. Videos of objects that the catalogue lacks are left out with one warning.
    """
    if not folder.is_dir():
        what = "a file and no folder" if folder.exists() else "no such folder"
        return Listing((), (_error(str(folder), f"{what}; set data.dir to the folder of the videos"),))
    paths, findings = video_files(folder)
    if not paths:
        kinds = ", ".join(SUFFIXES)
        empty = _error(str(folder), f"holds no video ({kinds}); set data.dir to the folder of the videos")
        return Listing((), (*findings, empty))
    # The chain's tables are UTF-8 and cannot hold such a name; `octopi describe` lists it with escapes.
    relative = {path: path.relative_to(folder).as_posix() for path in paths}
    findings += [_error(n, "its name is no text in UTF-8; rename it") for n in relative.values() if readable(n) != n]
    paths = [path for path, name in relative.items() if readable(name) == name]
    listed = folder / LIST_FILE
    named, problems = _from_list(listed, folder, paths) if listed.is_file() else _from_names(folder, paths)
    findings += problems
    files = [f for f in named if f.object_id in catalogue.objects]
    unknown = Counter(f.object_id for f in named if f.object_id not in catalogue.objects)
    counted = f"{unknown.total()} videos of {len(unknown)} objects that the catalogue lacks"
    names = ", ".join(sorted(unknown))
    if unknown and not files and all(f.severity is not Severity.ERROR for f in problems):
        message = f"holds no video of an object of the catalogue; there are {counted}: {names}; add them to objects.csv"
        findings.append(_error(str(folder), message))
    elif unknown:
        message = f"{counted} are left out; list them in objects.csv to use them: {names}"
        findings.append(finding("name", str(folder), message, severity=Severity.WARNING))
    files.sort(key=lambda f: (f.object_id, int(f.video_id.rpartition("_")[2]), f.relative))
    for video_id, group in groupby(files, lambda f: f.video_id):
        first, *others = (f.relative for f in group)
        if others:
            findings.append(_error(first, f"{video_id} is also {', '.join(others)}; keep one of them"))
    return Listing(tuple(files), tuple(findings), tuple(sorted(unknown)))


@contextmanager
def extending(folder: Path) -> Iterator[None]:
    """Let one import or studio at a time add videos to a folder: two would give the same numbers, and lose lines.

    UserError where another one runs, or its videos.csv is unreadable, or a table of sections, which lines would spoil.
    """
    listed, lock = folder / LIST_FILE, folder / ".import.lock"
    if listed.is_file() and {*SECTION} & {*read_rows(listed, ("file", "object_id"))[0]}:
        raise UserError(f"{listed}: names sections of files, and would be lost; name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(lock, timeout=0), ExitStack() as end:
            end.callback(lock.unlink, missing_ok=True)
            yield
    except Timeout:
        raise UserError(f"{folder}: an import or a studio writes into it; let it end, or name another folder") from None


def add_to_list(folder: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Add new videos to a folder's videos.csv, of which the chain takes the files alone; all its columns stay.

    A folder without one gets it where a line says more than its file's name does, with older videos by their names.
    """
    listed, columns = folder / LIST_FILE, ["file", "object_id"]
    if listed.is_file():
        header, found = read_rows(listed, columns)
        before = [row for _, row in found]
    elif any(value for row in rows for key, value in row.items() if key not in columns):
        new = {row["file"] for row in rows}
        older = [file for file in _from_names(folder, video_files(folder)[0])[0] if file.relative not in new]
        older.sort(key=lambda file: (file.object_id, int(file.video_id.rpartition("_")[2])))
        header, before = columns, [{"file": file.relative, "object_id": file.object_id} for file in older]
    else:
        return
    with atomic(listed) as part, part.open("w", encoding="utf-8", newline="") as stream:
        fields = dict.fromkeys([*header, *(key for row in rows for key in row)])
        writer = csv.DictWriter(stream, fields, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows([*before, *rows])


def raise_errors(folder: Path, findings: Sequence[Finding]) -> None:
    """Raise the first error as a UserError that names the file."""
    for found in findings:
        if found.severity is Severity.ERROR:
            where = folder if found.item == readable(str(folder)) else folder / found.item
            raise UserError(readable(f"{where}: {found.measured}"))


def _error(item: str, message: str) -> Finding:
    return finding("name", item, message, severity=Severity.ERROR)


def is_video(path: Path) -> bool:
    """Whether a file is taken for a video: by its name alone. What it holds is found when it is decoded."""
    return path.suffix.lower() in SUFFIXES


def video_files(folder: Path) -> tuple[list[Path], list[Finding]]:
    """The videos of a folder and its subfolders, sorted, and what is passed over or cannot be looked into.

    A dead link counts, so that reading it says so. A pipe or a device does not: reading it may never end. A linked
    folder is not entered: DVC does not look behind such a link either, so a change there would rerun nothing.
    """
    paths, findings, others = [], [], Counter[str]()

    def unreadable(error: OSError) -> None:
        where = Path(error.filename).relative_to(folder).as_posix()
        findings.append(_error(where, f"cannot be read ({error.strerror}); make it readable, or move it"))

    for place, folders, names in os.walk(folder, onerror=unreadable, followlinks=False):
        hidden = [name for name in (*folders, *names) if name.startswith(".")]
        others["hidden"] += len(hidden)
        for path in (Path(place, name) for name in sorted({*folders, *names} - {*hidden})):
            where = path.relative_to(folder).as_posix()
            if path.name in folders:
                if path.is_symlink():
                    message = "a linked folder is not looked into, nor by DVC; link the files, or name it as the folder"
                    findings.append(finding(PASSED, where, message, severity=Severity.WARNING))
            elif not is_video(path):
                others[readable(path.suffix.lower()) or "without a suffix"] += where != LIST_FILE
            elif path.exists() and not path.is_file():
                findings.append(_error(where, "is no file but a pipe, socket or device; move it"))
            else:
                paths.append(path)
        folders[:] = sorted({*folders} - {*hidden})
    if others.total():
        kinds = sorted((-count, kind) for kind, count in others.items() if count)
        counted = ", ".join(f"{-count} {kind}" for count, kind in kinds)
        message = f"{others.total()} are no videos by their names: {counted}"
        findings.append(finding(PASSED, str(folder), message))
    return sorted(paths), findings


def _from_names(folder: Path, paths: Sequence[Path]) -> tuple[list[VideoFile], list[Finding]]:
    files, findings = [], []
    for path in paths:
        relative = path.relative_to(folder).as_posix()
        match = re.fullmatch(r"([\w-]+)_([0-9]+)", unicodedata.normalize("NFC", path.stem))
        if match is None:
            message = "not named <object>_<number>, e.g. baseball_0.mov; rename it, move it, or list it in videos.csv"
            findings.append(_error(relative, message))
        else:
            files.append(VideoFile(path, relative, match[1], f"{match[1]}_{int(match[2])}"))
    return files, findings


def _from_list(listed: Path, folder: Path, paths: Sequence[Path]) -> tuple[list[VideoFile], list[Finding]]:
    """The files that videos.csv names; numbers count up within an object, in the list's order."""
    try:
        _, rows = read_rows(listed, ("file", "object_id"))
    except UserError as problem:
        return [], [_error(LIST_FILE, str(problem).removeprefix(str(listed)).lstrip(":, "))]
    if any(row.get(column) for column in SECTION for _, row in rows):
        message = f"names sections, but whole files are used; cut them: octopi import video {listed} --out FOLDER"
        return [], [_error(LIST_FILE, message)]
    files: dict[str, VideoFile] = {}
    findings: list[Finding] = []
    numbers: Counter[str] = Counter()
    there = {unicodedata.normalize("NFC", path.relative_to(folder).as_posix()): path for path in paths}
    for place, row in rows:
        line = place.removeprefix(str(listed)).lstrip(", ")
        name, object_id = (unicodedata.normalize("NFC", row[column]) for column in ("file", "object_id"))
        # As people and spreadsheets of Windows write it.
        name = name if name in {"", *there} else posixpath.normpath(name.replace("\\", "/"))
        if name not in there:
            findings.append(
                _error(LIST_FILE, f"{line}: no video {name!r} in the folder; correct the line or remove it")
            )
        elif name in files:
            findings.append(_error(LIST_FILE, f"{line}: {name} is listed twice; keep one line"))
        elif not object_id:
            findings.append(_error(LIST_FILE, f"{line}: {name} has no object_id; fill it in, or remove the line"))
        else:
            relative = there[name].relative_to(folder).as_posix()
            video_id = f"{object_id}_{numbers[object_id]}"
            files[name] = VideoFile(there[name], relative, object_id, video_id, row.get("session", ""))
            numbers[object_id] += 1
    if not rows:
        findings.append(_error(LIST_FILE, "lists no video; add a line for each, or remove the list"))
    unlisted = len(paths) - len(files)
    if unlisted and not findings:
        message = f"{unlisted} videos of the folder are not listed and are left out"
        findings.append(finding("name", LIST_FILE, message, severity=Severity.WARNING))
    return list(files.values()), findings
