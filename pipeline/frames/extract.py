"""Which frames of a video matter, and how samples are drawn from them.

Paper, "Data Processing": salient are the frames with the top 30 % total intensity difference to the frame before;
training draws five of them at random, evaluation takes five at uniform intervals from the first.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from itertools import accumulate
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from pipeline.artifacts import atomic, write_table
from pipeline.config import FramesConfig
from pipeline.errors import UserError
from pipeline.records import Frame, Video
from pipeline.runtime import cores
from pipeline.videos import Image, decode

FRAMES_FILE = "frames.npy"
TABLE_FILE = "frames.parquet"

Scored = tuple[int, int, Image]
"""Score, frame index, fitted frame."""


def salient_count(frames: int, fraction: float) -> int:
    """How many frames of a video are salient: the fraction of its differences, rounded up, and at least one.

    The fraction is taken as the decimal that was written, so that 0.07 of 100 is 7 and not 7.000000000000001.
    """
    return max(1, math.ceil(Fraction(str(fraction)) * (frames - 1)))


def difference(frame: Image, before: Image) -> int:
    """Sum of |frame - before| over pixels and channels, exact: OpenCV adds up blocks of integers in a double."""
    return int(cv2.norm(frame, before, cv2.NORM_L1))


def fit(frame: Image, config: FramesConfig) -> Image:
    """A BGR frame as size x size x RGB: its central square (`crop`) or all of it (`squash`), resized.

    CLIP's own way resizes first and crops then, which is the same picture to a fraction of a pixel for more work.
    """
    height, width = frame.shape[:2]
    if config.fit == "crop":
        side = min(height, width)
        top, left = (height - side) // 2, (width - side) // 2
        frame = frame[top : top + side, left : left + side]
    grows = config.size > min(frame.shape[:2])
    resized = cv2.resize(frame, (config.size, config.size), interpolation=cv2.INTER_CUBIC if grows else cv2.INTER_AREA)
    rgb: Image = cv2.cvtColor(resized, cv2.COLOR_BGR2RGB)
    return rgb


def salient_frames(frames: Iterator[Image], count: int, config: FramesConfig) -> tuple[list[Scored], int]:
    """The `count` frames that differ most from the frame before, in time order, and how many frames came in all.

    One pass that holds two raw frames and at most `count` fitted ones. Equal scores go to the earlier frame. The
    first frame has no predecessor: it does not compete, and is kept (with score 0) only where it is alone.
    """
    best: list[tuple[int, int, Image]] = []  # A heap whose smallest entry, (score, -index), is the next to go.
    first = before = next(frames, None)
    if first is None or before is None:
        return [], 0
    index = 0
    for index, frame in enumerate(frames, 1):
        score = difference(frame, before)
        before = frame
        if len(best) < count:
            heapq.heappush(best, (score, -index, fit(frame, config)))
        elif (score, -index) > best[0][:2]:
            heapq.heapreplace(best, (score, -index, fit(frame, config)))
    if not best:
        return [(0, 0, fit(first, config))], 1
    return sorted(((score, -back, image) for score, back, image in best), key=lambda s: s[1]), index + 1


def extract_frames(videos: Sequence[Video], folder: Path, config: FramesConfig, out: Path) -> list[Frame]:
    """Write the salient frames of all videos to `out/frames.npy` and `out/frames.parquet`.

    The array is uint8, frames x size x size x RGB, and opens with `np.load(mmap_mode="r")`; row `row` of it is the
    frame that the table says. Each video's place is known from its frame count, so threads write into the file
    directly: memory does not grow with the number of videos, and the result does not depend on their order.

    Raises:
        UserError: if there is no video, or one no longer decodes to the frames that were counted.
    """
    if not videos:
        raise UserError(f"{folder}: no videos to take frames from; see `octopi data check {folder}`")
    counts = [salient_count(video.frames, config.salient_fraction) for video in videos]
    starts = [0, *accumulate(counts)]
    with atomic(out / FRAMES_FILE) as temporary:
        offset = _allocate(temporary, (starts[-1], config.size, config.size, 3))

        def extract(position: int) -> list[Frame]:
            video, row = videos[position], starts[position]
            scored, decoded = salient_frames(decode(folder / video.path), counts[position], config)
            if decoded != video.frames:
                raise UserError(
                    f"{folder / video.path}: {decoded} frames decode where {video.frames} were counted; it has changed "
                    "since: run `dvc repro` again"
                )
            with temporary.open("r+b") as stream:
                stream.seek(offset + row * config.size * config.size * 3)
                stream.writelines(image.data for _, _, image in scored)
            return [
                Frame(video_id=video.video_id, frame_index=index, score=score, row=row + number)
                for number, (score, index, _) in enumerate(scored)
            ]

        with ThreadPoolExecutor(cores()) as pool:
            mapped = pool.map(extract, range(len(videos)))
            progress: Any = tqdm(mapped, total=len(videos), desc="frames", unit="video", disable=None)
            try:
                frames = [frame for rows in progress for frame in rows]
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        write_table(out / TABLE_FILE, Frame, frames)
    return frames


def _allocate(path: Path, shape: tuple[int, ...]) -> int:
    """Create a .npy file of zeros (sparse where the disk allows); return where its data begin, in bytes.

    The data are then written as to any file: pages of a memory map would count as this process's memory.
    """
    return int(np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape).offset)


def sample_training(count: int, k: int, rng: random.Random) -> tuple[int, ...]:
    """`k` random positions in a list of `count` salient frames, sorted; repeated only where there are fewer than k."""
    chosen = rng.sample(range(count), k) if count >= k else rng.choices(range(count), k=k)
    return tuple(sorted(chosen))


def sample_evaluation(count: int, k: int) -> tuple[int, ...]:
    """`k` positions at uniform intervals from the first of `count` salient frames."""
    return tuple(i * count // k for i in range(k))
