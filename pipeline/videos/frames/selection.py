"""Selection of the frames of a video that are kept. A video is read once; memory holds no more than the kept share.

`salient`: paper, "Data Processing": the 30 % with the largest total intensity difference to the frame before; intensity
is the brightness that the codec keeps.
`release`: what the published code does (github.com/clear-nus/octopi, utils/process_dataset.py): it scores a frame by
the number of changed grey pixels, takes the number of frames from the header, saves the frame *before* each chosen one,
and leaves out videos that would keep fewer than five.
`contact`: this project's own rule, the largest contact strength against the no-contact reference.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from fractions import Fraction

import av
import cv2
import numpy as np

from pipeline.config import FramesConfig
from pipeline.videos.decoding import Image, fit, picture, planes

RELEASE_FEWEST = 5
HELD_BYTES = 64 * 2**20


@dataclass(frozen=True)
class Kept:
    """A frame that was kept: its place in the video, what it was chosen by, and its picture."""

    index: int
    score: float
    image: Image
    """size x size x RGB."""


def kept_count(frames: int, config: FramesConfig) -> int:
    """How many of a video's frames a selection keeps at most; at least one, except by the published rule.

    The fraction is taken as the decimal that was written, so that 0.07 of 100 is 7 and not 7.000000000000001. Only the
    published rule multiplies as floats do, and rounds down.
    """
    if config.selection == "release":
        return int(config.fraction * frames)
    candidates = frames - 1 if config.selection == "salient" else frames  # The first frame has no predecessor.
    return max(1, math.ceil(Fraction(str(config.fraction)) * candidates))


def difference(brightness: Image, before: Image) -> float:
    """Sum of |brightness - before| over all pixels, exact: OpenCV adds up blocks of integers in a double."""
    return float(cv2.norm(brightness, before, cv2.NORM_L1))


class BestFrames:
    """The best frames so far: those with the largest scores, equal scores in favour of the earlier frame.

    Frames are held as decoded and resized at the end, since most candidates are displaced by better ones. Only if the
    held frames could take more than `HELD_BYTES`, each is resized at once. The number of frames in the video is from
    its header or from a first pass.
    """

    def __init__(self, frames: int, config: FramesConfig) -> None:
        self.frames, self.config = frames, config
        self.capacity = kept_count(frames, config)
        # Smallest (score, -index) first: the next to go. An index comes once, so that frames are never compared.
        self._heap: list[tuple[float, int, av.VideoFrame | Image]] = []
        self._before: tuple[av.VideoFrame, Image] | None = None

    def consider(self, index: int, frame: av.VideoFrame) -> None:
        """Score the change from the frame before, and offer this frame, or by the published rule the one before."""
        salient = self.config.selection == "salient"
        now = planes(frame)[0] if salient else cv2.cvtColor(picture(frame), cv2.COLOR_BGR2GRAY)
        if self._before is not None:
            earlier, shown = self._before
            if salient:
                self.offer(difference(now, shown), index, frame)
            elif index < self.frames:
                changed = cv2.countNonZero(cv2.absdiff(now, shown))
                self.offer(float(changed), index - 1, earlier)
        self._before = frame, now

    def offer(self, score: float, index: int, frame: av.VideoFrame) -> None:
        """Keep a frame if it is among the best."""
        full = len(self._heap) >= self.capacity
        # The heap is empty where the published rule keeps no frame at all (capacity 0).
        if full and (not self._heap or (score, -index) <= self._heap[0][:2]):
            return
        # 1.5 bytes a pixel: 4:2:0 keeps brightness in full and two colour planes at a quarter of the size.
        heavy = self.capacity * frame.width * frame.height * 1.5 > HELD_BYTES
        held = fit(frame, self.config) if heavy else frame
        (heapq.heapreplace if full else heapq.heappush)(self._heap, (score, -index, held))

    def kept(self) -> list[Kept]:
        """What was kept, in time order."""
        chosen = sorted(self._heap, key=lambda one: -one[1])
        return [Kept(-i, score, h if isinstance(h, np.ndarray) else fit(h, self.config)) for score, i, h in chosen]
