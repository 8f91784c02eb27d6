"""Decoding: frames as the codec leaves them, pictures of those that are looked at, and squares that encoders take.

PyAV hands out what the codec decoded, brightness and colour in planes of their own. Differences in brightness need no
more than the first plane; turning a frame into BGR costs as much as decoding it and is left to frames that are kept.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.video.reformatter import VideoReformatter

from pipeline.config import FramesConfig

cv2.setNumThreads(1)  # The files are what runs in parallel.
av.logging.set_level(av.logging.PANIC)  # Broken files are reported in a line of our own.

Image = npt.NDArray[np.uint8]
SUFFIXES = (".avi", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ts", ".webm", ".wmv")
"""Suffixes of video files, wherever they come from."""
CONTAINERS = {"format_whitelist": "asf,avi,matroska,mjpeg,mov,mpeg,mpegts"}
"""Containers that are accepted as videos, by FFmpeg's names. None can refer to other files, as a playlist does."""
PLANAR = frozenset(f"yuv{j}{kind}p" for j in ("", "j") for kind in ("420", "422", "444", "440", "411", "410"))
"""Formats whose first plane is brightness and whose second and third are colour, 8 bits each."""
FULL_RANGE, BT709 = 2, 1
"""As FFmpeg numbers colour ranges and colour spaces."""
HDR = (16, 18)
"""PQ and HLG, as ITU-T H.273 numbers transfer characteristics."""


class _Own(threading.local):
    """What a thread has to itself: a reformatter keeps its tables from frame to frame, so two must not share one."""

    def __init__(self) -> None:
        self.reformatter = VideoReformatter()


_own = _Own()


@dataclass(frozen=True)
class Header:
    """What a file says of itself."""

    frames: int = 0
    """Frames that the header promises; from the duration where it has no number; 0 where it has neither, or guesses."""
    fps: float = 0.0
    """Frames a second; 0 where unknown."""
    hdr: bool = False
    """Whether its brightness follows PQ or HLG, as telephones record by default."""


class Decoder:
    """A video file, decoded once from its beginning. A file that is no video has no frames."""

    def __init__(self, path: Path) -> None:
        self._container: av.container.InputContainer | None = None
        self._stream: av.VideoStream | None = None
        self.header = Header()
        try:
            # Without "file:" a name with a colon would be an address.
            self._container = av.open(f"file:{path}", options=CONTAINERS)
            self._stream = stream = video_stream(self._container)
        except (av.FFmpegError, ValueError):
            return
        stream.thread_type = "NONE"
        stream.codec_context.thread_count = 1
        fps = float(stream.average_rate or 0)
        fps = fps if math.isfinite(fps) and fps > 0 else 0.0
        seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        kind, promised = self._container.format.name, stream.frames
        if promised and "mov" in kind:
            # An edit list may show fewer frames than are stored.
            promised = sum(not entry.is_discard for entry in stream.index_entries)
        # MPEG's own streams have no header; FFmpeg guesses how long they last.
        promised = promised or (0 if kind.startswith("mpeg") else round(seconds * fps))
        self.header = Header(promised, fps, stream.codec_context.color_trc in HDR)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._container is not None:
            self._container.close()

    def frames(self) -> Iterator[av.VideoFrame]:
        """The frames that decode, in order, with square pixels.

        What is damaged is left out: frames that the codec calls corrupt, and those coded as changes to them.
        """
        if self._container is None or self._stream is None:
            return
        packets, corrupt = self._container.demux(self._stream), False
        aspect = float(self._stream.sample_aspect_ratio or 1)
        while True:
            try:
                packet = next(packets, None)
                decoded = [] if packet is None else packet.decode()
            except (av.FFmpegError, ValueError):
                continue
            if packet is None:
                return
            for frame in decoded:
                corrupt = frame.is_corrupt or (corrupt and not frame.key_frame)
                # Narrower or lower, so that no header can make it larger.
                size = max(1, round(frame.width * min(1, aspect))), max(1, round(frame.height / max(1, aspect)))
                if not corrupt:
                    yield frame if aspect == 1 and frame.format.name in PLANAR else _reformat(frame, "yuv444p", *size)


def video_stream(container: av.container.InputContainer) -> av.VideoStream:
    """The video of a file, of several the one that players show; ValueError where there is none."""
    stream = container.streams.best("video")
    if not isinstance(stream, av.VideoStream):
        raise ValueError("no video in it")
    return stream


def picture(frame: av.VideoFrame) -> Image:
    """A frame as uint8, height x width x BGR, mirrored and turned as its metadata say."""
    return upright(np.asarray(_reformat(frame, "bgr24").to_ndarray(), dtype=np.uint8), frame)


def fit(frame: av.VideoFrame, config: FramesConfig) -> Image:
    """A frame as size x size x RGB: its central square (`crop`) or all of it (`squash`), resized, turned upright.

    The planes are resized before they are turned into colours: most formats keep colour at half the size, so little is
    left to do. On real frames (240 to 64 pixels) that is within 1.3 of 255 steps, on average, of an antialiased bicubic
    resize of FFmpeg's RGB picture.
    """
    shown = planes(frame)
    if config.fit == "crop":
        shown = tuple(_square(plane, *shown[0].shape) for plane in shown)
    shown = tuple(_resize(plane, config.pixels) for plane in shown)
    return upright(to_rgb(cv2.merge(shown), frame), frame)


def _square(plane: Image, height: int, width: int) -> Image:
    """Cut a plane to the central square of its picture; in 4:2:2, with colour halved in width alone, it is no
    square."""
    side = min(height, width)
    (top, bottom), (left, right) = (
        ((whole - side) // 2 * own // whole, -(-((whole + side) // 2) * own // whole))
        for whole, own in ((height, plane.shape[0]), (width, plane.shape[1]))
    )
    return plane[top:bottom, left:right]


def _resize(plane: Image, size: int) -> Image:
    """Resize: halve by exact means of 2 x 2 pixels while it is more than twice too large, then interpolate."""
    while min(plane.shape) >= 2 * size and plane.shape[0] % 2 == 0 and plane.shape[1] % 2 == 0:
        plane = cv2.resize(plane, (plane.shape[1] // 2, plane.shape[0] // 2), interpolation=cv2.INTER_AREA)
    if size > min(plane.shape):
        way = cv2.INTER_CUBIC
    else:
        # Odd sides and long rectangles may still be more than twice too large, where linear interpolation skips pixels.
        way = cv2.INTER_LINEAR if max(plane.shape) < 2 * size else cv2.INTER_AREA
    resized: Image = cv2.resize(plane, (size, size), interpolation=way)
    return resized


def to_rgb(yuv: Image, frame: av.VideoFrame) -> Image:
    """Turn brightness and colour differences (uint8, height x width x 3) of a frame into RGB, as its format says.

    ITU-R BT.601, or BT.709 where the stream names it; brightness from 16 to 235 unless the stream says full range.
    """
    full = frame.format.name.startswith("yuvj") or frame.color_range == FULL_RANGE
    rgb: Image = cv2.transform(yuv, _colours(full, frame.colorspace == BT709))
    return rgb


def upright(image: Image, frame: av.VideoFrame) -> Image:
    """A picture of a frame, mirrored left to right and then turned as the metadata ask for."""
    return np.ascontiguousarray(np.rot90(image[:, ::-1] if _mirrors(frame) else image, turns(frame)))


def turns(frame: av.VideoFrame) -> int:
    """Counterclockwise quarter turns that the metadata ask for, after mirroring."""
    # FFmpeg's angle is that of the picture's right side. Mirroring puts the left side there, which is half a turn more.
    return round(frame.rotation / 90 + 2 * _mirrors(frame)) % 4


def _mirrors(frame: av.VideoFrame) -> bool:
    """Whether the display matrix (ISO 14496-12, 8.3.2) swaps left and right, whatever it turns."""
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    return matrix is not None and bool(np.linalg.det(np.frombuffer(matrix, np.int32).reshape(3, 3)) < 0)


def planes(frame: av.VideoFrame) -> tuple[Image, ...]:
    """Brightness and two colour differences, each uint8, height x width of its own: views that keep the frame alive."""
    padded = [np.frombuffer(memoryview(p), np.uint8).reshape(p.height, p.line_size) for p in frame.planes]
    return tuple(plane[:, : own.width] for plane, own in zip(padded, frame.planes, strict=True))


@cache
def _colours(full: bool, bt709: bool) -> npt.NDArray[np.float64]:
    """The 3 x 4 matrix from (Y, U, V, 1) to (R, G, B) in 8-bit steps."""
    red, blue = (0.2126, 0.0722) if bt709 else (0.299, 0.114)
    green = 1 - red - blue
    to_green = -2 * blue * (1 - blue) / green, -2 * red * (1 - red) / green
    matrix = np.array([[1, 0, 2 * (1 - red)], [1, *to_green], [1, 2 * (1 - blue), 0]])
    if not full:
        matrix = matrix * np.array([255 / 219, 255 / 224, 255 / 224])
    return np.column_stack([matrix, -matrix @ np.array([0 if full else 16, 128, 128])])


def _reformat(frame: av.VideoFrame, pixels: str, width: int | None = None, height: int | None = None) -> av.VideoFrame:
    """Convert in one thread: a forked process lacks the threads of its parent, but would wait for them for ever."""
    return _own.reformatter.reformat(frame, width, height, format=pixels, threads=1)
