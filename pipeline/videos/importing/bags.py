"""The pictures of a robot's recording (a ROS 1 or ROS 2 bag)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.running.errors import UserError
from pipeline.videos.decoding import Image
from pipeline.videos.frames.reference import LONGEST
from pipeline.videos.importing.presses import Shot, read_picture

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, cv2.COLOR_GRAY2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
}
"""Bytes a pixel of the encodings that are read (sensor_msgs/image_encodings.hpp), and OpenCV's way to BGR. `8UC3` names
no order of colours; OpenCV's, blue first, is the custom."""


def shots(bag: Path, topic: str) -> Iterator[Shot]:
    """The pictures of a topic, in the order in which they were received; UserError where one cannot be read."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UserError("reading bags takes the package rosbags: pip install -e '.[robot]'") from None
    if not bag.exists():
        raise UserError(f"{bag}: no such recording; name a .bag, a ROS 2 folder, or an .mcap or .db3 file")
    size, times = None, list[tuple[int, int]]()
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
                times.append((received, message.header.stamp.sec * 10**9 + message.header.stamp.nanosec))
                yield Shot(image, *times[-1])
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
    if len(times) > 1 and _mixed(times):
        raise UserError(f"{bag}: its clock was set back, so pictures of {topic} are mixed up; record it again")


def _mixed(times: Sequence[tuple[int, int]]) -> bool:
    """Whether the clock that a bag is sorted by was set back, by arrivals and stamps in ns.

    Stamps then fall several times, or once where arrivals have a gap. A single fall between even arrivals means only
    that the camera's own clock was set.
    """
    waits, steps = np.diff(np.array(times), axis=0).T
    fell = steps < -2 * np.median(np.diff(np.sort([stamp for _, stamp in times])))
    return bool(fell.sum() > 1 or (waits[fell] > LONGEST * waits.mean()).any())


def _picture(message: Any, where: str) -> Image:
    """A message as height x width x BGR."""
    data = np.asarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        decoded = read_picture(data, where)
        if decoded is None:
            raise UserError(f"{where} is no picture that OpenCV reads (format {message.format!r}); send jpeg or png")
        # Red-first pixels went into an encoder that takes blue first: they are swapped back.
        return np.ascontiguousarray(decoded[:, :, ::-1]) if "compressed rgb" in message.format else decoded
    height, width, step = message.height, message.width, message.step
    size, way = ENCODINGS.get(message.encoding, (0, None))
    if not size:
        raise UserError(f"{where} has encoding {message.encoding!r}; send one of {', '.join(ENCODINGS)}")
    whole = height * width and step >= width * size and len(data) >= step * height
    if not whole or (size == 2 and width % 2):  # Two pixels share their colour.
        raise UserError(f"{where} says {width}x{height}, {step} bytes a row, and holds {len(data)}; record it again")
    picture = data[: step * height].reshape(height, step)[:, : width * size].reshape(height, width, size)
    return np.asarray(picture.copy() if way is None else cv2.cvtColor(picture.copy(), way), dtype=np.uint8)
