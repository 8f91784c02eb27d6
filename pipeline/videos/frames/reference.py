"""The no-contact reference of a video, and how strongly a frame differs from it.

A GelSight picture without contact is the sensor's own: smooth light, dust, scratches. What is touched is the difference
to it. The reference is the mean of the video's first frames, or of its last where the video starts in contact. First
frames in which the light still changes, as a camera's do that has just been started, are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import av
import cv2
import numpy as np

from pipeline.videos.decoding import Image, planes

SHARE, LONGEST = 10, 8
"""The reference spans the first tenth of a video, at most 8 frames: a third to half a second at 10 and 25 a second."""
MOST_FRAMES = 4
"""Maximum number of these frames in the mean, evenly spaced: without motion, neighbours are copies of each other."""
THUMB = 80
"""Longer side of the small picture that contact is measured on, in pixels."""
DETAILED = 1.12
"""A video counts as starting in contact from this ratio of detail in its first picture to its last: contact adds
detail. Untouched real videos lie between .95 and 1.08 (99 % of them)."""
UNSTEADY = 1.0
"""The light changes where three quarters of a picture become brighter, or darker, by more than so many 8-bit steps:
contact makes some parts brighter and others darker. In the first frames of 370 real videos nothing changes by that."""


def reference_indices(frames: int) -> tuple[int, ...]:
    """Which of a video's first frames the reference is the mean of, in rising order."""
    span = max(1, min(LONGEST, frames // SHARE))
    return tuple(range(0, span, -(-span // MOST_FRAMES)))


def unsteady_frames(thumbs: Iterable[Image], frames: int) -> int:
    """Number of first frames to skip until the light is steady enough for a reference; all where it never is.

    Thumbnails come in the video's order, and no more are drawn than it takes.
    """
    places = [*reference_indices(frames), reference_indices(frames)[-1] + 1]
    drawn: list[Image] = []
    for thumb in thumbs:
        drawn.append(thumb)
        begin = len(drawn) - 1 - places[-1]
        if begin >= 0 and is_steady([drawn[begin + place] for place in places]):
            return begin
    return frames


def is_steady(thumbs: Sequence[Image]) -> bool:
    """Whether frames have the light of the last one (`UNSTEADY`), by their thumbnails."""
    for thumb in thumbs[:-1]:
        # A lower quartile above the limit means that three quarters are brighter; an upper one below minus it, darker.
        low, high = np.quantile(thumb.astype(np.int16) - thumbs[-1], (0.25, 0.75), axis=(0, 1))
        if max(low.max(), -high.min()) > UNSTEADY:
            return False
    return True


def mean(pictures: Sequence[Image]) -> Image:
    """The mean picture, rounded."""
    rounded: Image = np.rint(np.mean(pictures, axis=0)).astype(np.uint8)
    return rounded


def thumbnail(frame: av.VideoFrame) -> Image:
    """A frame with its longer side at `THUMB` pixels: uint8, height x width x (brightness, two colour differences)."""
    shown = planes(frame)
    height, width = shown[0].shape
    scale = THUMB / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small: Image = cv2.merge([cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR) for plane in shown])
    return small


def contact_strength(thumb: Image, reference: Image) -> float:
    """The contact strength: mean |thumb - reference| less |mean(thumb - reference)|, in 8-bit steps over all channels.

    Contact makes some parts brighter and others darker; a change of the light shifts all alike and cancels out. Never
    negative (triangle inequality), 0 for equal pictures and for a uniform shift that does not saturate.
    """
    channels = 1 if thumb.ndim == 2 else thumb.shape[2]
    shift = sum(abs(a - b) for a, b in zip(cv2.mean(thumb), cv2.mean(reference), strict=True)) / channels
    return max(0.0, float(cv2.norm(thumb, reference, cv2.NORM_L1)) / thumb.size - shift)


def detail(thumb: Image) -> float:
    """Deviation of the brightness finer than 4 pixels of the thumbnail: contact adds it, light does not."""
    brightness = thumb[:, :, 0].astype(np.float32)
    return float((brightness - cv2.GaussianBlur(brightness, (0, 0), 4)).std())


def starts_touching(first: Image, last: Image) -> bool:
    """Whether a video that begins with `first` and ends with `last` (thumbnails) begins in contact and ends without."""
    return detail(first) > DETAILED * max(detail(last), 1e-6)
