"""Small videos, slow second implementations of the rules, and a place to extract frames to."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import av
import cv2
import numpy as np
from PIL import Image as Pillow

from pipeline.config import FramesConfig
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.decoding import Decoder, picture, planes
from pipeline.videos.files import VideoFile
from pipeline.videos.frames.extract import Extraction, extract_frames
from pipeline.videos.frames.probe import probe
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.selection import Kept
from pipeline.videos.records import Probe

CONFIG = FramesConfig(pixels=16)
FILES = ("frames.npy", "references.npy", "frames.parquet", "probes.parquet")


def decode(path: Path) -> Iterator[np.ndarray]:
    """The pictures of a video: uint8, height x width x BGR; nothing where the file is no video."""
    with Decoder(path) as decoder:
        for frame in decoder.frames():
            yield picture(frame)


def constant(count: int, value: int = 77) -> list[np.ndarray]:
    return [np.full((30, 40, 3), value, np.uint8)] * count


def pressing(count: int, seed: int = 0, width: int = 80, height: int = 60) -> list[np.ndarray]:
    """Still for a fifth of the time, then bumps of changing place and depth come and go."""
    rng = np.random.default_rng(seed)
    ground = 90 + 20 * np.mgrid[0:height, 0:width][1] / width
    y, x = np.mgrid[0:height, 0:width]
    frames = []
    for i in range(count):
        depth = 60 * max(0.0, math.sin(math.pi * (i / count - 0.2) / 0.8))
        phase = 2 * math.pi * (i // 4) / 7
        bump = depth * np.sin(x / 3 + phase) * np.exp(-(((x - width / 2) / 18) ** 2) - ((y - height / 2) / 14) ** 2)
        noise = rng.normal(0, 0.7, (height, width))
        grey = np.clip(ground + bump + noise, 0, 255)
        frames.append(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8))
    return frames


def frames_of(path: Path) -> list[av.VideoFrame]:
    with Decoder(path) as decoder:
        return list(decoder.frames())


class Scanned(NamedTuple):
    kept: tuple[Kept, ...]
    reference: np.ndarray
    probe: Probe


def scanned(path: Path, config: FramesConfig = CONFIG, video_id: str = "rug_0") -> Scanned:
    file = VideoFile(path, path.name, video_id.rpartition("_")[0], video_id)
    found = scan(file, config)
    assert isinstance(found, Scan)
    return Scanned(found.kept, found.reference, probe(file, found))


@contextmanager
def promising(frames: int) -> Iterator[None]:
    init = Decoder.__init__

    def lying(self: Decoder, path: Path) -> None:
        init(self, path)
        self.header = replace(self.header, frames=frames)

    with patch.object(Decoder, "__init__", lying):
        yield


def salience(frames: Sequence[np.ndarray], fraction: str) -> list[tuple[int, float]]:
    """The paper's rule in plain int64 arithmetic and a stable sort, from planes of brightness."""
    stack = np.stack(frames).astype(np.int64)
    scores = np.abs(stack[1:] - stack[:-1]).sum(axis=(1, 2))
    if len(scores) == 0:
        return [(0, 0)]
    count = -(-Fraction(fraction) * len(scores) // 1)
    best = sorted(np.argsort(-scores, kind="stable")[: int(count)])
    return [(int(i) + 1, int(scores[i])) for i in best]


def luma(path: Path) -> list[np.ndarray]:
    return [planes(frame)[0].copy() for frame in frames_of(path)]


def published(path: Path, promised: int) -> list[tuple[int, int]]:
    """utils/process_dataset.py again: (frame saved, changed pixels), from OpenCV's frames and the header's count."""
    capture = cv2.VideoCapture(str(path))
    there, before = capture.read()
    earlier = cv2.cvtColor(before, cv2.COLOR_BGR2GRAY)
    scores = []
    for i in range(1, promised):
        there, frame = capture.read()
        if not there:
            break
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        scores.append((i, int(np.count_nonzero(cv2.absdiff(grey, earlier)))))
        earlier = grey
    best = sorted(scores, key=lambda item: item[1], reverse=True)[: int(0.3 * promised)]
    return sorted((i - 1, score) for i, score in best) if len(best) >= 5 else []


def pillow(image: np.ndarray, size: int, mode: str) -> np.ndarray:
    """The central square or all of a picture, by PIL's antialiased bicubic filter."""
    height, width = image.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    if mode == "crop":
        image = image[top : top + side, left : left + side]
    return np.asarray(Pillow.fromarray(np.ascontiguousarray(image)).resize((size, size), Pillow.Resampling.BICUBIC))


class Place:
    def __init__(self, folder: Path, root: Path, catalogue: Catalogue) -> None:
        self.folder, self.catalogue = folder, catalogue
        self.out, self.partial, self.log = root / "out é", root / "partial", root / "decoded.txt"

    def extract(self, config: FramesConfig = CONFIG) -> Extraction:
        return extract_frames(self.folder, self.catalogue, config, self.out, self.partial)

    def bytes(self) -> list[bytes]:
        return [(self.out / name).read_bytes() for name in FILES]

    def decoded(self) -> list[str]:
        """Which videos were scanned since the last look, as the processes that did it noted."""
        names = self.log.read_text().split() if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return sorted(names)
