"""The kept frames and references of a folder of videos, as files that later stages map into memory."""

from __future__ import annotations

import io
import json
import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import ValidationError

from pipeline.config import FramesConfig
from pipeline.errors import UserError
from pipeline.io import atomic, write_table
from pipeline.parallel import run_parallel
from pipeline.records import Finding, Frame, Probe, Record, Video
from pipeline.videos import decoding
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import VideoFile, list_videos, raise_errors
from pipeline.videos.frames.scan import scan
from pipeline.videos.frames.store import FRAMES_FILE, PROBES_FILE, REFERENCES_FILE, TABLE_FILE

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Extraction:
    """What was found in a folder; videos and references go by the same order."""

    videos: tuple[Video, ...]
    """With frames to show: the published selection leaves very short videos out."""
    probes: tuple[Probe, ...]
    """Of all videos that decode."""
    frames: tuple[Frame, ...]


class _Done(Record):
    """A finished video: a line of `done.jsonl`, whose pixels stand in the files at this line's place."""

    stamp: tuple[str, str, str, str, int, int]
    """What the file was listed as, its size and time of change."""
    video: Video
    probe: Probe
    places: tuple[tuple[int, float], ...]
    """Index and score of each kept frame."""


@dataclass(frozen=True)
class _Job:
    file: VideoFile
    config: FramesConfig
    work: Path

    def __str__(self) -> str:
        return str(self.file)

    @property
    def pixels(self) -> Path:
        """Where the process that scans leaves the reference and the kept frames."""
        return self.work / f"{self.file.video_id}.bin"

    def stamp(self) -> tuple[str, str, str, str, int, int]:
        """What tells whether the file, or what videos.csv says of it, has changed; a file that is gone has size -1."""
        file = self.file
        try:
            status = file.path.stat()
        except OSError:
            return file.relative, file.video_id, file.object_id, file.session, -1, 0
        return file.relative, file.video_id, file.object_id, file.session, status.st_size, status.st_mtime_ns


def extract_frames(folder: Path, catalogue: Catalogue, config: FramesConfig, out: Path, partial: Path) -> Extraction:
    """Decode every video of a folder once, several at a time, and write what is kept.

    `out/frames.npy` is uint8, frames x size x size x RGB, row by row as `out/frames.parquet` says;
    `out/references.npy` likewise, one row for each video of the table of videos. Both open with
    `np.load(mmap_mode="r")`. What is finished waits in `partial`, so a killed extraction goes on where it was; memory
    does not grow with the number of videos, and results do not depend on how many processes there are.

    Raises:
        UserError: for the first file that is wrong, naming it and the mend; all of them are listed by
            `octopi data audit`.
    """
    listing = list_videos(folder, catalogue)
    raise_errors(folder, listing.findings)
    for finding in listing.findings:
        log.warning("%s: %s", finding.item, finding.measured)
    work = partial / _fingerprint(folder, config)
    jobs = [_Job(file, config, work) for file in listing.files]
    with _PixelFiles(work, config.size) as files:
        done = files.resume(jobs)
        rest = jobs[len(done) :]
        for job, result in zip(rest, run_parallel(_work, rest, "videos", "video"), strict=True):
            if isinstance(result, Finding):
                raise_errors(folder, [result])
            else:
                files.add(job, result)
                done.append(result)
                _warn(job.file, result.probe)
        used = [d for d in done if d.places]
        if not used:
            raise UserError(f"{folder}: no video has a frame to keep; choose another frames.selection")
        frames: list[Frame] = []
        for d in used:
            for index, score in d.places:
                frames.append(Frame(video_id=d.video.video_id, frame_index=index, score=score, row=len(frames)))
        files.finish(out, frames=len(frames), references=len(used))
    write_table(out / TABLE_FILE, Frame, frames)
    write_table(out / PROBES_FILE, Probe, [d.probe for d in done])
    shutil.rmtree(work)
    return Extraction(tuple(d.video for d in used), tuple(d.probe for d in done), tuple(frames))


class _PixelFiles:
    """The pixels of finished videos, one behind the other, and the list of what they are.

    The list is written after the pixels: what a kill left over behind the last line is cut off when it is resumed.
    """

    def __init__(self, work: Path, size: int) -> None:
        work.mkdir(parents=True, exist_ok=True)
        self.size = size
        self.files = (work / FRAMES_FILE, work / REFERENCES_FILE)
        self.list_file = work / "done.jsonl"
        for file in (*self.files, self.list_file):
            file.touch()
        self.frames, self.references = (file.open("r+b") for file in self.files)
        self.list = self.list_file.open("r+", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for stream in (self.frames, self.references, self.list):
            stream.close()

    def resume(self, jobs: Sequence[_Job]) -> list[_Done]:
        """Take over what is finished of the first jobs, as far as their files are unchanged; drop everything else."""
        done: list[_Done] = []
        lines = 0
        for job, line in zip(jobs, self.list_file.read_bytes().splitlines(keepends=True), strict=False):
            try:
                entry = _Done.model_validate_json(line)
            except ValidationError:  # A line that was being written when the process died.
                break
            if entry.stamp != job.stamp() or not line.endswith(b"\n"):
                break
            done.append(entry)
            lines += len(line)
        kept = sum(len(d.places) for d in done), sum(bool(d.places) for d in done)
        ends = [HEADER_BYTES + count * self.size * self.size * 3 for count in kept]
        streams = (self.frames, self.references)
        if done and any(stream.seek(0, io.SEEK_END) < end for stream, end in zip(streams, ends, strict=True)):
            # The pixels are gone: moved to their place already, or lost with the machine's power.
            done, lines, ends = [], 0, [HEADER_BYTES] * 2
        for stream, end in zip(streams, ends, strict=True):
            stream.truncate(end)
            stream.seek(end)
        self.list.truncate(lines)
        self.list.seek(0, io.SEEK_END)
        return done

    def add(self, job: _Job, done: _Done) -> None:
        """Append a video, and remove the file that it came in."""
        with job.pixels.open("rb") as pixels:
            reference = pixels.read(self.size * self.size * 3)
            if done.places:
                self.references.write(reference)
                shutil.copyfileobj(pixels, self.frames, 1 << 20)
        for stream in (self.references, self.frames):
            stream.flush()
        self.list.write(done.model_dump_json() + "\n")
        self.list.flush()
        job.pixels.unlink()

    def finish(self, out: Path, frames: int, references: int) -> None:
        """Write the headers, which need the counts, and move both files to their place."""
        out.mkdir(parents=True, exist_ok=True)
        for stream, file, count in zip((self.frames, self.references), self.files, (frames, references), strict=True):
            stream.seek(0)
            stream.write(_header((count, self.size, self.size, 3)))
            stream.flush()
            with atomic(out / file.name) as temporary:
                shutil.move(file, temporary)  # Which may be on another, and a full, disk.


def _work(job: _Job) -> _Done | Finding:
    """Scan one video in a process of its own."""
    stamp = job.stamp()
    result = scan(job.file, job.config)
    if isinstance(result, Finding):
        return result
    with job.pixels.open("wb") as stream:
        stream.write(result.reference.data)
        stream.writelines(kept.image.data for kept in result.kept)
    return _Done(
        stamp=stamp,
        video=result.video,
        probe=result.probe,
        places=tuple((kept.index, kept.score) for kept in result.kept),
    )


def _header(shape: tuple[int, ...]) -> bytes:
    """A .npy header; NumPy pads it so that the first dimension may grow without making it longer."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|u1", "fortran_order": False, "shape": shape})
    return stream.getvalue()


HEADER_BYTES = len(_header((0, 64, 64, 3)))


def _warn(file: VideoFile, probe: Probe) -> None:
    if probe.header_frames > probe.frames:
        log.warning(
            "%s: %d of the %d frames in its header decode; is it cut off? The %d are used",
            file.relative,
            probe.frames,
            probe.header_frames,
            probe.frames,
        )
    if probe.kept == 0:
        log.warning("%s: %d frames are too few for frames.selection=release; left out", file.relative, probe.frames)


def _fingerprint(folder: Path, config: FramesConfig) -> str:
    """What a finished video depends on besides its file: the parameters and the code that decodes and measures."""
    sources = [*sorted(Path(__file__).parent.glob("*.py")), Path(decoding.__file__)]
    code = b"".join(path.read_bytes() for path in sources)
    text = json.dumps([str(folder.resolve()), config.model_dump(mode="json")])
    return sha256(code + text.encode()).hexdigest()[:16]
