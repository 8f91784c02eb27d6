"""A robot's recording (ROS 1 or ROS 2 bag) cut into presses, one video each, as the chain and `octopi ask` take them.

A press is where the picture differs from the untouched one by much more than the recording's quiet frames do.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.errors import UserError
from pipeline.io import atomic, remove_rests, write_csv
from pipeline.records import Record
from pipeline.scenes.film import write_film
from pipeline.videos.audit.files import FOUND
from pipeline.videos.decoding import Image
from pipeline.videos.files import is_video
from pipeline.videos.frames.reference import (
    LONGEST,
    contact_strength,
    reference_indices,
    starts_touching,
    thumbnail,
    unsteady_frames,
)

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
ENCODINGS = {"bgr8": 3, "8UC3": 3, "rgb8": 3, "mono8": 1}
"""Channels of the encodings that are read. `8UC3` names no order of colours; OpenCV's, blue first, is the custom."""
RELEASED = 0.75
"""A press ends under this share of the strength that it begins at, so that noise at the threshold cuts none in two."""
QUIET = 0.1
"""Quantile of the strengths that is taken for the recording's quiet level."""
ROUNDING = 0.1
"""Least quiet level, in 8-bit steps: under it a difference is rounding."""
RATES = (1.0, 240.0)
"""Frames a second of a video, at least and at most."""
SHORTEST = 3
"""Frames of a press; what is shorter is a flicker."""


class FrameTime(Record):
    """When a frame of a video was recorded: a row of the CSV beside it."""

    frame: int
    """Position in the video."""
    recorded_ns: int
    """When the bag received the message, in ns since 1970."""
    stamped_ns: int
    """The message's own header stamp, in ns."""
    contact: float
    """Contact strength in 8-bit steps (`pipeline.videos.frames.reference.contact_strength`)."""


@dataclass(frozen=True)
class Shot:
    """One picture of the topic: height x width x BGR, and its times in ns."""

    picture: Image
    recorded: int
    stamped: int


def import_bag(bag: Path, topic: str, out: Path, object_id: str, times: float = FOUND) -> list[Path]:
    """Write every press of a recording as `<object_id>_<n>.mp4` with a CSV of times; numbers go on from those in `out`.

    The bag is read twice, so that no more than one picture is in memory: first to measure contact, then to write.

    Args:
        bag: a ROS 1 `.bag`, a ROS 2 folder, or a ROS 2 `.mcap` or `.db3` file.
        topic: of `sensor_msgs/Image` (`ENCODINGS`) or `sensor_msgs/CompressedImage`.
        times: a press begins at this many times the quiet level.

    Raises:
        UserError: if the bag, the topic or a message cannot be read, or nothing touches the sensor.
    """
    if re.fullmatch(r"[\w-]+", object_id) is None:
        raise UserError(f"--object {object_id!r}: take letters, digits, _ and -, as in objects.csv")
    stamped, received, strengths = _measure(shots(bag, topic))
    ranges = presses(strengths, times)
    if not ranges:
        raise UserError(
            f"{bag}: nothing touches the sensor in {len(strengths)} pictures of {topic} (strongest difference "
            f"{strengths.max():.2f}, a press begins at {_threshold(strengths, times):.2f}); lower --times"
        )
    fps = _rate(bag, stamped, received)
    out.mkdir(parents=True, exist_ok=True)
    remove_rests(out)
    first, source, position, written = _next_number(out, object_id), shots(bag, topic), 0, []
    for number, (begin, end) in enumerate(ranges, first):
        path, rows = out / f"{object_id}_{number}.mp4", list[FrameTime]()
        pressed = itertools.islice(source, begin - position, end - position)
        with atomic(path.with_suffix(".csv")) as table:
            # The suffix says the container, so the unfinished file bears it, too.
            part = path.with_name(f".{path.stem}.{os.getpid()}.part.mp4")
            try:
                write_film(part, _noting(pressed, strengths[begin:end], rows), fps)
                write_csv(table, FrameTime, rows)
                os.replace(part, path)
            finally:
                part.unlink(missing_ok=True)
        written.append(path)
        position = end
    return written


def _noting(pressed: Iterator[Shot], strengths: npt.NDArray[np.float64], rows: list[FrameTime]) -> Iterator[Image]:
    for frame, (shot, strength) in enumerate(zip(pressed, strengths.tolist(), strict=True)):
        times = {"recorded_ns": shot.recorded, "stamped_ns": shot.stamped}
        rows.append(FrameTime(frame=frame, contact=round(strength, 3), **times))
        yield shot.picture


def presses(strengths: npt.NDArray[np.float64], times: float = FOUND) -> list[tuple[int, int]]:
    """Where something touches: (first frame, one behind the last), rising, none overlapping.

    Hysteresis: a press reaches `times` the quiet level, and lasts while strengths lie over `RELEASED` of that.
    Each is widened on both sides by up to `LONGEST` untouched frames, which the chain takes its reference from, but
    not beyond the middle to its neighbour.

    Args:
        strengths: contact strength by frame, in 8-bit steps.
    """
    threshold = _threshold(strengths, times)
    labels, _ = ndimage.label(strengths > RELEASED * threshold)
    found = [
        (place.start, place.stop)
        for (place,) in ndimage.find_objects(labels)
        if place.stop - place.start >= SHORTEST and strengths[place].max() > threshold
    ]
    if not found:
        return []
    middles = [0, *((a[1] + b[0]) // 2 for a, b in itertools.pairwise(found)), len(strengths)]
    return [
        (max(begin - LONGEST, low), min(end + LONGEST, high))
        for (begin, end), low, high in zip(found, middles[:-1], middles[1:], strict=True)
    ]


def shots(bag: Path, topic: str) -> Iterator[Shot]:
    """The pictures of a topic, in the order in which they were received; UserError where one cannot be read."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UserError("reading bags takes the package rosbags: pip install -e '.[robot]'") from None
    if not bag.exists():
        raise UserError(f"{bag}: no such recording; name a .bag, a ROS 2 folder, or an .mcap or .db3 file")
    size = None
    try:
        # Bags of ROS 2 before Iron do not say what their messages look like; images have not changed since.
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            images = sorted({c.topic for c in reader.connections if c.msgtype in IMAGES})
            if not any(c.topic in images for c in connections):
                what = f"holds {connections[0].msgtype} and no images" if connections else "is not in it"
                raise UserError(f"{bag}: {topic} {what}; its image topics: {', '.join(images) or 'none'}")
            for number, (connection, received, raw) in enumerate(reader.messages(connections)):
                message: Any = reader.deserialize(raw, connection.msgtype)
                image = _picture(message, f"{bag}: message {number} of {topic}")
                size = size or image.shape
                if image.shape != size:
                    raise UserError(f"{bag}: pictures of {topic} change their size; record them anew in one size")
                stamp = message.header.stamp
                yield Shot(image, received, stamp.sec * 10**9 + stamp.nanosec)
    except UserError:
        raise
    except Exception as problem:  # A damaged bag fails in the reader, its storage, its index or its messages.
        reason = " ".join(str(problem).split()) or type(problem).__name__
        raise UserError(
            f"{bag}: not a whole recording ({reason}); copy it again, or repair it (rosbag reindex, ros2 bag reindex, "
            "mcap recover)"
        ) from None
    if size is None:
        raise UserError(f"{bag}: no picture of {topic} in it; record it again")


def _picture(message: Any, where: str) -> Image:
    """A message as height x width x BGR."""
    data = np.asarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
        if decoded is None:
            raise UserError(f"{where} is no picture that OpenCV reads (format {message.format!r}); send jpeg or png")
        return np.asarray(decoded, dtype=np.uint8)
    height, width, step = message.height, message.width, message.step
    channels = ENCODINGS.get(message.encoding, 0)
    if not channels:
        raise UserError(f"{where} has encoding {message.encoding!r}; send one of {', '.join(ENCODINGS)}")
    if not height * width or step < width * channels or len(data) < step * height:
        raise UserError(f"{where} says {width}x{height}, {step} bytes a row, and holds {len(data)}; record it again")
    picture = data[: step * height].reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    if message.encoding == "rgb8":
        picture = picture[:, :, ::-1]
    return np.ascontiguousarray(np.broadcast_to(picture, (height, width, 3)))


def _measure(source: Iterator[Shot]) -> tuple[list[int], list[int], npt.NDArray[np.float64]]:
    """Stamps, times of arrival (ns) and contact strengths of all pictures.

    Contact is measured by the untouched picture at the beginning, else at the end.

    First pictures in which the light still changes count as quiet.
    """
    stamped, received, thumbs = list[int](), list[int](), list[Image]()
    for shot in source:
        stamped.append(shot.stamped)
        received.append(shot.recorded)
        frame = av.VideoFrame.from_ndarray(shot.picture, format="bgr24")
        thumbs.append(thumbnail(frame.reformat(format="yuv444p")))
    places, cold = reference_indices(len(thumbs)), unsteady_frames(thumbs, len(thumbs)) % len(thumbs)
    first, last = _mean([thumbs[cold + i] for i in places]), _mean([thumbs[-1 - i] for i in places])
    reference = last if starts_touching(first, last) else first
    strengths = [contact_strength(thumb, reference) for thumb in thumbs[cold:]]
    return stamped, received, np.array([min(strengths)] * cold + strengths)


def _mean(thumbs: Sequence[Image]) -> Image:
    mean: Image = np.rint(np.mean(thumbs, axis=0)).astype(np.uint8)
    return mean


def _threshold(strengths: npt.NDArray[np.float64], times: float) -> float:
    """The strength that a press begins at."""
    return times * max(ROUNDING, float(np.quantile(strengths, QUIET)))


def _rate(bag: Path, stamped: Sequence[int], received: Sequence[int]) -> float:
    """Frames a second, by the stamps where they give a rate that a camera can have (`RATES`), else by arrival.

    It is the median over all runs of `LONGEST` frames: messages arrive in bursts, recordings pause, clocks are set.
    """
    run = min(LONGEST, len(received) - 1)
    by_stamp, by_arrival = (float(np.median(np.subtract(t[run:], t[:-run]))) / run for t in (stamped, received))
    slowest, fastest = RATES
    if by_stamp > 0 and slowest <= 1e9 / by_stamp <= fastest:
        return round(1e9 / by_stamp, 3)
    if by_arrival <= 0:
        raise UserError(f"{bag}: its pictures bear no rising times; record it again")
    return min(fastest, max(slowest, round(1e9 / by_arrival, 3)))


def _next_number(folder: Path, object_id: str) -> int:
    """One more than the largest number that the object's videos in the folder have."""
    names = [re.fullmatch(rf"{re.escape(object_id)}_(\d+)", p.stem) for p in folder.iterdir() if is_video(p)]
    return max((int(m[1]) + 1 for m in names if m), default=0)
