"""Small videos in memory, honest ones and crafted ones."""

import base64
import struct
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.conftest import encode, moving_square


@cache
def video(seed: int = 0, count: int = 12, suffix: str = ".mp4", codec: str = "mpeg4") -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder, f"v{suffix}")
        return encode(
            path, moving_square(count, seed), codec, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        ).read_bytes()


@cache
def blank(count: int, width: int = 16, height: int = 16) -> bytes:
    """A long or large video of few bytes."""
    with TemporaryDirectory() as folder:
        frame = np.zeros((height, width, 3), np.uint8)
        return encode(Path(folder, "v.mp4"), (frame for _ in range(count)), "mpeg4", "yuv420p").read_bytes()


def recording(
    touched: Sequence[range], length: int, height: int = 48, width: int = 64, drift: float = 0.0
) -> list[np.ndarray]:
    """Pictures (BGR) with noise; a bump brightens one side and darkens the other while touched; the light may drift."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width]
    ground = np.stack([90 + x / 3, 110 + y / 3, 100 + (x + y) / 5], axis=2)
    bump = 40 * np.sign(x - width / 2) * (np.hypot(x - width / 2, y - height / 2) < height / 4)
    pictures = []
    for index in range(length):
        pressed = bump[:, :, None] * any(index in pressed for pressed in touched)
        light = drift * index * np.cos(x / 20)[:, :, None]
        pictures.append(np.clip(ground + light + pressed + rng.normal(0, 1, ground.shape), 0, 255).astype(np.uint8))
    return pictures


def press(file: Path, begin: int = 8) -> Path:
    """A video of a disc of 24 pixels' radius that presses into a sensor of 128 x 96 pixels."""
    frames = recording([range(begin, 26)], 30, height=96, width=128)
    return encode(file, frames, codec="mpeg4", pixels="yuv420p", bits=2_000_000)


def uri(data: bytes, kind: str = "video/mp4") -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def claims_pixels(width: int, height: int) -> bytes:
    """An MP4 whose sample description (ISO/IEC 14496-12, 12.1.3: width 24 bytes behind the type) claims this size, and
    whose codec data, which would say otherwise, are cut off by their type."""
    data = bytearray(video())
    place = data.index(b"mp4v")
    struct.pack_into(">HH", data, place + 4 + 24, width, height)
    esds = data.index(b"esds")
    data[esds : esds + 4] = b"free"
    return bytes(data)


def claims_frames(count: int) -> bytes:
    """An MP4 whose sample table (8.7.3) claims so many frames of a byte each, all of one duration (8.6.1.2)."""
    data = bytearray(video())
    struct.pack_into(">II", data, data.index(b"stsz") + 8, 1, count)
    struct.pack_into(">II", data, data.index(b"stts") + 12, count, 1)
    return bytes(data)


def avi_of_giant_jpegs(width: int, height: int) -> bytes:
    """An AVI whose header is honest-looking and whose JPEGs claim another size in their SOF0 segment."""
    data = bytearray(video(suffix=".avi", codec="mjpeg"))
    place = -1
    while (place := data.find(b"\xff\xc0\x00\x11\x08", place + 1)) >= 0:
        struct.pack_into(">HH", data, place + 5, height, width)
    return bytes(data)
