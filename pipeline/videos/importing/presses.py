"""Recordings cut into presses, one video each, as the chain and `octopi ask` take them.

A press is where the picture differs from the untouched one by much more than the recording's quiet frames do.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import av
import cv2
import numpy as np
import numpy.typing as npt

from pipeline.core.io import remove_rests, write_csv
from pipeline.core.records import Record
from pipeline.running.errors import UserError
from pipeline.videos import decoding
from pipeline.videos.audit.files import FOUND
from pipeline.videos.catalogue.csv_reader import Row, check_object_id, read_rows
from pipeline.videos.decoding import Decoder, Image
from pipeline.videos.files import SECTION, add_to_list, is_video
from pipeline.videos.film import write_film
from pipeline.videos.frames.reference import (
    LONGEST,
    contact_strength,
    mean,
    reference_indices,
    starts_touching,
    thumbnail,
    unsteady_frames,
)

log = logging.getLogger(__name__)

PICTURES = (".jpeg", ".jpg", ".png")
TIMES = re.compile(r"\d{9}\.\d|\d\.0\d")
"""Seconds since 1970, or a fraction that begins with 0: pictures are named by time, and not by number."""
RELEASED = 0.75
"""A press ends under this share of the strength that it begins at, so that noise at the threshold cuts none in two."""
QUIET = 0.1
"""Quantile of the strengths that is taken for the recording's quiet level."""
ROUNDING = 0.1
"""Least quiet level, in 8-bit steps: under it a difference is rounding."""
RATES = (1.0, 240.0)
"""Frames a second of a video, at least and at most."""
SHORTEST = 3
"""Minimum number of frames of a press; what is shorter is a flicker."""


class FrameTime(Record):
    """When a frame of a video was recorded: a row of the CSV beside it."""

    frame: int
    """Position in the video."""
    recorded_ns: int
    """When a bag received the message, in ns since 1970; of a film, from its beginning."""
    stamped_ns: int
    """The message's own header stamp, in ns; of a film, as `recorded_ns`."""
    contact: float
    """Contact strength in 8-bit steps (`pipeline.videos.frames.reference.contact_strength`)."""


class NothingTouchesError(UserError):
    """A recording without a press."""


@dataclass(frozen=True)
class Shot:
    """One picture of a recording: height x width x BGR, and its times in ns."""

    picture: Image
    recorded: int
    stamped: int

    def thumb(self) -> Image:
        """The small picture that contact is measured on."""
        return thumbnail(av.VideoFrame.from_ndarray(self.picture, format="bgr24").reformat(format="yuv444p"))


def cut(
    read: Callable[[], Iterator[Shot]],
    name: str,
    out: Path,
    object_id: str,
    times: float = FOUND,
    *,
    whole: bool = False,
) -> list[Path]:
    """Write every press of a recording as `<object_id>_<n>.mp4` with a CSV of times; numbers go on from those in `out`.

    Args:
        read: Begins the recording anew (`film`, or `bags.shots`): first to measure contact, then to write, so that no
            more than one picture is in memory.
        name: What an error calls it.
        times: A press begins at this many times the quiet level.
        whole: Write all of it as one video, without looking for presses.

    Raises:
        UserError: if the recording cannot be read, or nothing touches the sensor.
    """
    check_object_id(name, object_id)
    stamped, received, strengths = _measure(name, read())
    ranges = [(0, len(strengths))] if whole else presses(strengths, times)
    if not ranges:
        raise NothingTouchesError(
            f"{name}: nothing touches the sensor in {len(strengths)} pictures (strongest difference "
            f"{strengths.max():.2f}, a press begins at {_threshold(strengths, times):.2f}); lower --times"
        )
    fps = _rate(name, stamped, received)
    out.mkdir(parents=True, exist_ok=True)
    rests = [re.fullmatch(rf"\.{re.escape(object_id)}_(\d+)\.\d+\.part\.mp4", path.name) for path in out.iterdir()]
    # Of a kill while videos get their names, the first one is left unfinished: the others are written again.
    first = min([first_free(out, object_id), *(int(rest[1]) for rest in rests if rest)])
    remove_rests(out)
    source, position, parts = read(), 0, dict[Path, Path]()
    try:
        for number, (begin, end) in enumerate(ranges, first):
            path = out / f"{object_id}_{number}.mp4"
            # The suffix says the container, so the unfinished file bears it, too.
            parts[path] = path.with_name(f".{path.stem}.{os.getpid()}.part.mp4")
            pressed = itertools.islice(source, begin - position, end - position)
            write_film(parts[path], (shot.picture for shot in pressed), fps)
            position = end
        for path, (begin, end) in zip(parts, ranges, strict=True):
            rows = [
                FrameTime(
                    frame=i - begin,
                    recorded_ns=received[i],
                    stamped_ns=stamped[i],
                    contact=round(float(strengths[i]), 3),
                )
                for i in range(begin, end)
            ]
            write_csv(path.with_suffix(".csv"), FrameTime, rows)
        for path, part in reversed(parts.items()):  # All at the end: who begins anew after an error has none twice.
            os.replace(part, path)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
    return [*parts]


def cut_into(
    read: Callable[[], Iterator[Shot]], name: str, out: Path, object_id: str, times: float, *, whole: bool = False
) -> list[Path]:
    """`cut` into a folder whose list, where it has one, goes on."""
    written = cut(read, name, out, object_id, times, whole=whole)
    add_to_list(out, [{"file": path.name, "object_id": object_id} for path in written])
    return written


def first_free(out: Path, object_id: str) -> int:
    """The number behind the last one that a folder has of an object."""
    taken = [re.fullmatch(rf"{re.escape(object_id)}_(\d+)", path.stem) for path in out.iterdir() if is_video(path)]
    return max((int(match[1]) + 1 for match in taken if match), default=0)


def cut_listed(listed: Path, out: Path, fps: float = 0.0) -> list[Path]:
    """Write what each line of a table names as one video, with the table's other columns in a `videos.csv` beside them.

    Args:
        listed: CSV with the columns `file` (from the table's folder), `object_id`, and, where wanted, `begin` and `end`
            in seconds (empty: from the beginning, to the end) and `session`. One file may stand in many lines.
        fps: As `film`'s.

    Raises:
        UserError: as of `cut`.
    """
    _, rows = read_rows(listed, ("file", "object_id"))
    sections = [[_seconds(where, column, row.get(column, "")) for column in SECTION] for where, row in rows]
    made, written, lines = list[Path](), list[Path](), list[Row]()
    remove_rests(out)
    # All get their names at the end: after an error or a kill all is cut again, and none comes twice.
    with TemporaryDirectory(dir=out, prefix=".", suffix=f".{os.getpid()}.part") as part:
        for (where, row), (begin, end) in zip(rows, sections, strict=True):
            read = partial(film, listed.parent / row["file"], fps, begin or 0.0, end)
            made += cut(read, where, Path(part), row["object_id"], whole=True)
        try:
            for path, (_, row) in zip(made, rows, strict=True):
                to = out / f"{row['object_id']}_{first_free(out, row['object_id'])}.mp4"
                os.replace(path.with_suffix(".csv"), to.with_suffix(".csv"))
                written.append(path.replace(to))
                lines.append({key: value for key, value in row.items() if key not in SECTION} | {"file": to.name})
            add_to_list(out, lines)
        except BaseException:  # A list that cannot be written, as on a full disk.
            for path in written:
                path.unlink()
                path.with_suffix(".csv").unlink()
            raise
    return written


def _seconds(where: str, column: str, text: str) -> float | None:
    try:
        seconds = float(text) if text else None
    except ValueError:
        seconds = math.nan
    if seconds is not None and not 0 <= seconds < math.inf:
        raise UserError(f"{where}: {column} is {text!r}; write seconds from the file's beginning, such as 2.5")
    return seconds


def film(path: Path, fps: float = 0.0, begin: float = 0.0, end: float | None = None) -> Iterator[Shot]:
    """The pictures of a video, or of a folder of PNG or JPEG files by their names (2 before 10).

    From `begin` to `end`, in seconds, at `fps` pictures a second; with 0 a video's pictures are at their own time
    stamps, since telephones record at a rate that varies, and a folder has none. What is cut off or damaged is left
    out, and counted in a warning.
    UserError where no picture decodes, one has another size or too few bits, or the rate is unknown.
    """
    if not path.exists():
        raise UserError(f"{path}: no such file; name a video or a folder of pictures")
    pictures: Iterator[tuple[str, Image | None, float | None]]
    with Decoder(path) as decoder:
        rate = fps or decoder.header.fps
        if path.is_dir():
            files = [file for file in path.iterdir() if file.suffix.lower() in PICTURES]
            number = re.compile(r"(\d+(?:\.\d+)?)" if any(TIMES.search(file.stem) for file in files) else r"(\d+)")
            files.sort(key=lambda file: [Decimal(w) if i % 2 else w for i, w in enumerate(number.split(file.name))])
            pictures = ((str(f), read_picture(np.fromfile(f, np.uint8), str(f)), None) for f in files)
            promised = len(files)
        else:
            pictures = ((str(path), decoding.picture(frame), frame.time) for frame in decoder.frames())
            promised = decoder.header.frames
        if rate <= 0:
            raise UserError(f"{path}: its frames a second are not known; say --fps, or name a video")
        if not RATES[0] <= rate <= RATES[1]:  # NaN fails this, too.
            raise UserError(f"{path}: {rate:g} frames a second; --fps takes {RATES[0]:g} to {RATES[1]:g}")
        size, first, decoded = None, None, 0
        for place, (where, picture, stamp) in enumerate(pictures):
            if picture is None:
                continue
            decoded += 1
            size = size or picture.shape
            if picture.shape != size:
                raise UserError(f"{where}: of another size than the first picture; record them in one size")
            first = stamp if place == 0 else first
            at = round(1e9 * (place / rate if fps or stamp is None or first is None else stamp - first))
            if end is not None and at >= end * 1e9:
                return
            if at >= begin * 1e9:
                yield Shot(picture, at, at)
    if size is None:
        raise UserError(f"{path}: no picture decodes; name a video, or a folder of {', '.join(PICTURES)}")
    if decoded < promised:
        log.warning("%s: %d of %d pictures are cut off or damaged and left out", path, promised - decoded, promised)


def read_picture(data: npt.NDArray[np.uint8], where: str) -> Image | None:
    """A PNG or JPEG file as uint8, height x width x BGR: of 16 bits a value the upper eight.

    None where it does not decode to its end; UserError where the upper bits are empty.
    """
    # `imread` would fill what a file that was cut off lacks with grey.
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH) if len(data) else None
    if picture is not None and picture.dtype == np.uint16:
        if picture.max() < 1 << 14:  # Cameras of 10 or 12 bits often fill the lower ones.
            raise UserError(f"{where}: has no value over {picture.max()} of 65535; save it in 8 bits, bright enough")
        picture >>= 8
    return None if picture is None else picture.astype(np.uint8)


class Contact:
    """A press, picture by picture: over when `SHORTEST` of them in a row lie under `RELEASED` of what it begins at."""

    touched = behind = 0
    """Pictures that lie over it, and those since the last of them."""

    def over(self, strength: float, threshold: float) -> bool:
        """Take in the next picture; whether the press is over with it."""
        held = strength > RELEASED * threshold
        self.touched, self.behind = self.touched + held, 0 if held else self.behind + 1
        return self.behind == SHORTEST


def presses(strengths: npt.NDArray[np.float64], times: float = FOUND) -> list[tuple[int, int]]:
    """Where something touches: (first frame, one behind the last), rising, none overlapping.

    A press begins over `times` the quiet level; strengths are by frame, in 8-bit steps. Each is widened on both sides
    by up to `LONGEST` untouched frames, which the chain takes its reference from, but not beyond the middle to its
    neighbour.
    """
    threshold, begin, contact, found = _threshold(strengths, times), 0, Contact(), list[tuple[int, int]]()
    for place, strength in enumerate([*strengths, *[0.0] * SHORTEST]):  # What lasts to the end is over behind it.
        if not contact.touched:
            begin = place
        if (contact.touched or strength > threshold) and contact.over(strength, threshold):
            if contact.touched >= SHORTEST:
                found.append((begin, place + 1 - SHORTEST))
            contact = Contact()
    if not found:
        return []
    middles = [0, *((a[1] + b[0]) // 2 for a, b in itertools.pairwise(found)), len(strengths)]
    return [
        (max(begin - LONGEST, low), min(end + LONGEST, high))
        for (begin, end), low, high in zip(found, middles[:-1], middles[1:], strict=True)
    ]


def _measure(name: str, source: Iterator[Shot]) -> tuple[list[int], list[int], npt.NDArray[np.float64]]:
    """Stamps, times of arrival (ns) and contact strengths of all pictures, against the untouched picture at one end.

    First pictures in which the light still changes count as quiet.
    """
    stamped, received, thumbs = list[int](), list[int](), list[Image]()
    for shot in source:
        stamped.append(shot.stamped)
        received.append(shot.recorded)
        thumbs.append(shot.thumb())
    if len(thumbs) < SHORTEST:
        wanted = "begin before the contact, and end behind it"
        raise NothingTouchesError(f"{name}: {len(thumbs)} pictures are no press; {wanted}")
    places, cold = reference_indices(len(thumbs)), unsteady_frames(thumbs, len(thumbs)) % len(thumbs)
    first, last = mean([thumbs[cold + i] for i in places]), mean([thumbs[-1 - i] for i in places])
    reference = last if starts_touching(first, last) else first
    strengths = [contact_strength(thumb, reference) for thumb in thumbs[cold:]]
    return stamped, received, np.array([min(strengths)] * cold + strengths)


def begins_at(quiet: float, times: float) -> float:
    """The strength that a press begins at, by the recording's quiet level."""
    return times * max(ROUNDING, quiet)


def _threshold(strengths: npt.NDArray[np.float64], times: float) -> float:
    return begins_at(float(np.quantile(strengths, QUIET)), times)


def _rate(name: str, stamped: Sequence[int], received: Sequence[int]) -> float:
    """Frames a second, by the stamps where they give a rate that a camera can have (`RATES`), else by arrival.

    It is the median over all runs of `LONGEST` frames: messages arrive in bursts, recordings pause, clocks are set.
    """
    run = min(LONGEST, len(received) - 1)
    by_stamp, by_arrival = (float(np.median(np.subtract(t[run:], t[:-run]))) / run for t in (stamped, received))
    slowest, fastest = RATES
    if by_stamp > 0 and slowest <= 1e9 / by_stamp <= fastest:
        return round(1e9 / by_stamp, 3)
    if by_arrival <= 0:
        raise UserError(f"{name}: its pictures bear no rising times; record it again")
    return min(fastest, max(slowest, round(1e9 / by_arrival, 3)))
