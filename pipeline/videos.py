"""Which videos a folder holds: every file is named, decoded to its end and counted before anything trusts it.

Headers lie about frame counts and a video that cannot be opened only says `isOpened() == False`, so a file counts
for the frames that really decode. Threads suffice: OpenCV and hashlib let go of the interpreter while they work.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

# Broken files are reported in a line of our own; FFmpeg's remarks (-8: quiet) would only bury it.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
import cv2
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from pipeline.errors import UserError
from pipeline.physiclear.catalogue import Catalogue
from pipeline.records import Record, Video
from pipeline.runtime import cores

cv2.setNumThreads(1)  # The files are what runs in parallel.

Image = npt.NDArray[np.uint8]
SUFFIXES = (".avi", ".mjpg", ".mkv", ".mov", ".mp4")
FEW_FRAMES = 5
"""Fewer frames than this are named by `inspect`: the samplers then repeat frames."""

log = logging.getLogger(__name__)


class Finding(Record):
    """One remark about a data folder."""

    severity: Literal["error", "warning", "info"]
    item: str
    """The file (relative to the folder) or the folder that it is about."""
    message: str


@dataclass(frozen=True)
class _Claim:
    """A file that says which sample it is."""

    path: Path
    relative: str
    object_id: str
    video_id: str


def open_video(path: Path) -> cv2.VideoCapture:
    """A capture of the file by FFmpeg alone: other back ends would take `x_0.mov` for a sequence of images."""
    return cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])


def decode(path: Path) -> Iterator[Image]:
    """Yield the frames that decode, in order: uint8, height x width x BGR; nothing where the file is no video."""
    capture = open_video(path)
    try:
        while True:
            found, frame = capture.read()
            if not found:
                return
            yield frame
    finally:
        capture.release()


def catalogue_videos(folder: Path, catalogue: Catalogue, object_ids: Collection[str] = ()) -> list[Video]:
    """List the videos of a folder and its subfolders, sorted by object and number, and log warnings.

    Args:
        folder: Holds files `<object>_<number>` with one of `SUFFIXES`.
        catalogue: Whose objects count; videos of other objects are left out with one warning.
        object_ids: Only these objects; empty stands for all of the catalogue.

    Raises:
        UserError: for the first of the errors that `inspect` lists.
    """
    claims, findings = _list(folder, catalogue, object_ids)
    _report(folder, findings)
    videos, findings = _read_all(claims)
    _report(folder, findings)
    return videos


def inspect(folder: Path, catalogue: Catalogue) -> list[Finding]:
    """All that is wrong or noteworthy with a folder of videos, errors first; decodes every file, raises nothing."""
    claims, listed = _list(folder, catalogue, ())
    videos, read = _read_all(claims)
    order = ("error", "warning", "info")
    findings = [*listed, *read, *_overview(folder, videos, catalogue)]
    return sorted(findings, key=lambda f: order.index(f.severity))


def _report(folder: Path, findings: Sequence[Finding]) -> None:
    for finding in findings:
        where = folder if finding.item == str(folder) else folder / finding.item
        if finding.severity == "error":
            raise UserError(f"{where}: {finding.message}")
        log.warning("%s: %s", where, finding.message)


def _list(folder: Path, catalogue: Catalogue, object_ids: Collection[str]) -> tuple[list[_Claim], list[Finding]]:
    """The files that fit, by their names alone, and what is wrong with the others."""

    def folder_error(message: str) -> tuple[list[_Claim], list[Finding]]:
        return [], [*findings, Finding(severity="error", item=str(folder), message=message)]

    findings: list[Finding] = []
    if not folder.is_dir():
        return folder_error("no such folder; set data.dir to the folder of the videos")
    claims, strangers, wanted = [], Counter[str](), set(object_ids) or catalogue.objects.keys()
    files = _video_files(folder)
    for path in files:
        relative = path.relative_to(folder).as_posix()
        match = re.fullmatch(r"(.+)_(\d+)", unicodedata.normalize("NFC", path.stem), flags=re.ASCII)
        if match is None:
            message = "not named <object>_<number>, e.g. baseball_0.mov; rename it, or move it out of the folder"
            findings.append(Finding(severity="error", item=relative, message=message))
        elif match[1] not in catalogue.objects:
            strangers[match[1]] += 1
        elif match[1] in wanted:
            claims.append(_Claim(path, relative, match[1], f"{match[1]}_{int(match[2])}"))
    if not files:
        return folder_error(f"holds no video ({', '.join(SUFFIXES)}); set data.dir to the folder of the videos")
    unknown = f"{strangers.total()} videos of {len(strangers)} objects that the catalogue lacks"
    names = ", ".join(sorted(strangers))
    if not claims and not findings:
        found = f"; there are {unknown}: {names}" if strangers else ""
        return folder_error(f"holds no video of an object asked for{found}; add objects to objects.csv or set data.dir")
    if strangers:
        message = f"{unknown} are left out; list them in objects.csv to use them: {names}"
        findings.append(Finding(severity="warning", item=str(folder), message=message))
    claims.sort(key=lambda c: (c.object_id, int(c.video_id.rpartition("_")[2]), c.relative))
    return claims, findings + _contested(claims)


def _video_files(folder: Path) -> list[Path]:
    """Files that look like videos, sorted; nothing hidden. A dead link counts, so that reading it says so."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        and not path.is_dir()
    )


def _contested(claims: Sequence[_Claim]) -> list[Finding]:
    rivals = defaultdict(list)
    for claim in claims:
        rivals[claim.video_id].append(claim.relative)
    return [
        Finding(severity="error", item=files[0], message=f"{video_id} is also {', '.join(files[1:])}; keep one of them")
        for video_id, files in rivals.items()
        if len(files) > 1
    ]


def _read_all(claims: Sequence[_Claim]) -> tuple[list[Video], list[Finding]]:
    """Decode every file once, several at a time; results keep the order of `claims`."""
    videos: list[Video] = []
    findings: list[Finding] = []
    with ThreadPoolExecutor(cores()) as pool:
        progress: Any = tqdm(pool.map(_read, claims), total=len(claims), desc="videos", unit="video", disable=None)
        for video, remark in progress:
            videos += [video] if video else []
            findings += [remark] if remark else []
    return videos, findings


def _read(claim: _Claim) -> tuple[Video | None, Finding | None]:
    def error(message: str) -> tuple[None, Finding]:
        return None, Finding(severity="error", item=claim.relative, message=message)

    try:
        size = claim.path.stat().st_size
        with claim.path.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as problem:
        return error(f"unreadable ({problem.strerror}); mend its access, or copy it again")
    if size == 0:
        return error("empty (0 bytes); copy it again, or remove it")
    capture = open_video(claim.path)
    fps, promised = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    capture.release()
    count, shapes = 0, set()
    for frame in decode(claim.path):
        count += 1
        shapes.add(frame.shape[:2])
    if count == 0:
        return error("no frame decodes; copy it again, convert it, or remove it")
    if len(shapes) > 1:
        return error(f"frames of {len(shapes)} sizes; convert it to one size, or remove it")
    (height, width) = shapes.pop()
    video = Video(
        video_id=claim.video_id,
        object_id=claim.object_id,
        path=claim.relative,
        sha256=sha256,
        frames=count,
        fps=fps if math.isfinite(fps) and fps > 0 else 0.0,
        width=width,
        height=height,
    )
    if promised > count:
        message = f"{count} of the {promised:.0f} frames in its header decode; is it cut off? The {count} are used"
        return video, Finding(severity="warning", item=claim.relative, message=message)
    return video, None


def _overview(folder: Path, videos: Sequence[Video], catalogue: Catalogue) -> Iterator[Finding]:
    """What only the whole folder shows: twins, very short videos, objects without videos, and counts."""
    first: dict[str, str] = {}
    for video in videos:
        if video.frames < FEW_FRAMES:
            message = f"{video.frames} frame{'s' * (video.frames > 1)} only; samples repeat them"
            yield Finding(severity="warning", item=video.path, message=message)
        twin = first.setdefault(video.sha256, video.path)
        if twin != video.path:
            yield Finding(severity="warning", item=video.path, message=f"has the same content as {twin}; remove one")
    if not videos:
        return
    seen = {video.object_id for video in videos}
    absent = sorted(catalogue.objects.keys() - seen)
    if absent:
        message = f"no video of {len(absent)} objects of the catalogue: {', '.join(absent)}"
        yield Finding(severity="warning", item=str(folder), message=message)
    frames = [video.frames for video in videos]
    message = (
        f"{len(videos)} videos of {len(seen)} objects, {sum(frames)} frames "
        f"({min(frames)} to {max(frames)}, mean {sum(frames) / len(frames):.1f} a video)"
    )
    yield Finding(severity="info", item=str(folder), message=message)
