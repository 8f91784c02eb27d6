"""The kept frames and references of a folder of videos, as files that later stages map into memory."""

from __future__ import annotations

import functools
import json
import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from pipeline.config import FramesConfig
from pipeline.core.io import atomic, code_of, fingerprint, write_table
from pipeline.core.records import Record
from pipeline.running.errors import UserError
from pipeline.running.parallel import run_parallel
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import VideoFile, list_videos, raise_errors
from pipeline.videos.frames.probe import probe
from pipeline.videos.frames.scan import scan
from pipeline.videos.frames.store import FRAMES_FILE, PROBES_FILE, REFERENCES_FILE, TABLE_FILE
from pipeline.videos.records import Finding, Frame, Probe, Severity, Video

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Extraction:
    """What was found in a folder; videos and references go by the same order."""

    videos: tuple[Video, ...]
    """Videos with kept frames: the published selection leaves very short ones out."""
    probes: tuple[Probe, ...]
    """Measurements of all videos that decode."""
    frames: tuple[Frame, ...]


class _Done(Record):
    """What was found in a finished video: the metadata of its file, whose tensors are `reference` and `frames`."""

    stamp: str
    """Tells whether the file, or what videos.csv says of it, has changed since (`_stamp`)."""
    probe: Probe
    places: tuple[tuple[int, float], ...]
    """Index and score of each kept frame."""


def extract_frames(folder: Path, catalogue: Catalogue, config: FramesConfig, out: Path, partial: Path) -> Extraction:
    """Decode every video of a folder once, several at a time, and write what is kept.

    `out/frames.npy` is uint8, frames x size x size x RGB, row by row as `out/frames.parquet` says;
    `out/references.npy` likewise, one row for each video of the table of videos. Both open with
    `np.load(mmap_mode="r")`. What is finished waits in `partial`, so a killed extraction goes on where it was; memory
    does not grow with the number of videos, and results do not depend on how many processes there are. The first file
    that is wrong is a UserError that names it and the mend; `octopi data audit` lists all of them.
    """
    listing = list_videos(folder, catalogue)
    raise_errors(folder, listing.findings)
    for finding in (f for f in listing.findings if f.severity is Severity.WARNING):
        log.warning("%s: %s", finding.item, finding.measured)
    work = partial / fingerprint(config, str(folder.resolve()), *code_of("extract_frames"))
    work.mkdir(parents=True, exist_ok=True)
    stamps = [_stamp(file) for file in listing.files]
    found = {file: _finished(file, work) for file in listing.files}
    rest = [file for file, earlier in found.items() if earlier is None]
    scan_one = functools.partial(_work, config=config, work=work)
    for file, result in zip(rest, run_parallel(scan_one, rest, "videos", "video"), strict=True):
        if isinstance(result, Finding):
            raise_errors(folder, [result])
            continue
        found[file], measured = result, result.probe
        if measured.header_frames > measured.frames:
            lost = f"{measured.frames} of the {measured.header_frames} frames in its header decode"
            log.warning("%s: %s; is it cut off? The %d are used", file, lost, measured.frames)
        if measured.kept == 0:
            log.warning("%s: %d frames are too few for frames.selection=release; left out", file, measured.frames)
    if [_stamp(file) for file in list_videos(folder, catalogue).files] != stamps:
        # DVC would take the folder as it is now for the one that was read.
        raise UserError(f"{folder}: videos were added or changed while they were read; run it again, which goes on")
    done = [each for each in found.values() if each is not None]
    used = [each for each in done if each.places]
    if not used:
        raise UserError(f"{folder}: no video has a frame to keep; choose another frames.selection")
    frames: list[Frame] = []
    for each in used:
        for index, score in each.places:
            frames.append(Frame(video_id=each.probe.video_id, frame_index=index, score=score, row=len(frames)))
    for name, tensor, count in ((FRAMES_FILE, "frames", len(frames)), (REFERENCES_FILE, "reference", len(used))):
        with atomic(out / name) as temporary, temporary.open("wb") as stream:
            shape = (count, config.pixels, config.pixels, 3)
            np.lib.format.write_array_header_1_0(stream, {"descr": "|u1", "fortran_order": False, "shape": shape})
            for each in used:
                with safe_open(_pixels(work, each.probe.video_id), "np") as stored:
                    stream.write(stored.get_tensor(tensor).data)
    write_table(out / TABLE_FILE, Frame, frames)
    write_table(out / PROBES_FILE, Probe, [each.probe for each in done])
    shutil.rmtree(work)
    return Extraction(tuple(each.probe for each in used), tuple(each.probe for each in done), tuple(frames))


def _pixels(work: Path, video_id: str) -> Path:
    """Where a finished video waits until all are."""
    return work / f"{video_id}.safetensors"


def _stamp(file: VideoFile) -> str:
    """What a file is listed as, its size and its modification time; only the first where the file is gone."""
    try:
        status = file.path.stat()
        changed = (status.st_size, status.st_mtime_ns)
    except OSError:
        changed = (-1, 0)
    return json.dumps((file.relative, file.video_id, file.object_id, file.session, *changed))


def _finished(file: VideoFile, work: Path) -> _Done | None:
    """What an earlier extraction found; None where there was none, or the video has changed since."""
    try:
        with safe_open(_pixels(work, file.video_id), "np") as stored:
            done = _Done.model_validate_json(stored.metadata()["done"])
    except (OSError, SafetensorError, ValidationError):  # Not there, or cut off when the machine lost its power.
        return None
    return done if done.stamp == _stamp(file) else None


def _work(file: VideoFile, config: FramesConfig, work: Path) -> _Done | Finding:
    """Scan one video in a process of its own, and leave its pixels in `work`."""
    stamp = _stamp(file)  # Before it is read: what changes meanwhile is read anew when it is run again.
    result = scan(file, config)
    if isinstance(result, Finding):
        return result
    done = _Done(stamp=stamp, probe=probe(file, result), places=tuple((kept.index, kept.score) for kept in result.kept))
    pixels = {"reference": result.reference}
    if result.kept:
        pixels["frames"] = np.stack([kept.image for kept in result.kept])
    with atomic(_pixels(work, file.video_id)) as temporary:
        save_file(pixels, temporary, {"done": done.model_dump_json()})
    return done
