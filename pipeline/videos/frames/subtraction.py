"""Pictures of the difference between a frame and its video's no-contact reference."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.core.records import GAIN, MIDDLE

Pictures = npt.NDArray[np.uint8]

RING = 8
"""The outer 1/8 of a picture on each side: where contact is least likely."""


def subtract(frames: Pictures, reference: Pictures) -> Pictures:
    """Pictures of the difference to the reference: 128 where nothing differs, two steps for each step of difference.

    Frames and what they become are uint8, frames x side x side x channels; the reference is one of them. A change of
    the light is taken off first, channel by channel: the median difference of the picture's outer ring. The arithmetic
    is signed and saturates, so nothing wraps around.
    """
    difference = frames.astype(np.int16) - reference.astype(np.int16)
    height, width = reference.shape[:2]
    top, left = max(1, height // RING), max(1, width // RING)
    ring = np.ones((height, width), dtype=bool)
    ring[top : height - top, left : width - left] = False
    # Halves go up, not to the even number: then a change of the light by one step shifts the median by just that.
    shift = np.floor(np.median(difference[:, ring], axis=1) + 0.5).astype(np.int16)
    pictures: Pictures = np.clip(MIDDLE + GAIN * (difference - shift[:, None, None]), 0, 255).astype(np.uint8)
    return pictures
