"""One pass over a video: frames go by once, and what later stages need of them is noted or kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline.config import FramesConfig
from pipeline.videos.decoding import Decoder, Header, Image, brightness, picture, turns
from pipeline.videos.frames.fit import fit
from pipeline.videos.frames.reference import (
    brightness_thumbnail,
    contact_strength,
    is_steady,
    reference_indices,
    thumbnail,
)
from pipeline.videos.frames.selection import (
    RELEASE_FEWEST,
    BestFrames,
    Kept,
    changed_pixels,
    difference,
    kept_count,
)

PROBES = 8
"""Frames of a video that are measured for the audit, besides the reference's and the last."""
SIGNATURE_FRAMES = 64
"""Frames of a video that the signature is made from, which tells copies."""


NOTHING: Image = np.zeros((1, 1, 3), np.uint8)


@dataclass(frozen=True)
class Reference:
    """The no-contact picture: size x size x RGB as encoders see it, and the thumbnail that contact is measured on."""

    picture: Image
    thumb: Image


@dataclass
class VideoPass:
    """What one decode of a video found; the defaults are those of a video without frames."""

    header: Header
    frames: int = 0
    sizes: set[tuple[int, int]] = field(default_factory=set)
    """Height and width of the pictures; more than one where the video changes."""
    rotation: int = 0
    """Degrees against the clock."""
    reference: Reference | None = None
    steady: bool = True
    """Whether the light stays the same in the frames whose mean is the reference."""
    first: Image = field(default_factory=lambda: NOTHING)
    last: Image = field(default_factory=lambda: NOTHING)
    """Thumbnails: the mean of the first frames, and the last frame."""
    contact: float = 0.0
    strongest: Image | None = None
    """Largest contact strength so far, and the thumbnail that shows it."""
    strengths: list[float] = field(default_factory=list)
    """In probed frames after the reference's."""
    brightness: list[float] = field(default_factory=list)
    times: list[tuple[int, float]] = field(default_factory=list)
    """Index and time stamp (s) of probed frames that have one."""
    brightness_thumbnails: list[Image] = field(default_factory=list)
    """Taken after the reference's frames."""
    kept: list[Kept] = field(default_factory=list)

    def note(self, thumb: Image) -> float:
        """Note the contact strength and return it; 0 before there is a reference."""
        if self.reference is None:
            return 0.0
        strength = contact_strength(thumb, self.reference.thumb)
        if self.strongest is None or strength > self.contact:
            self.contact, self.strongest = strength, thumb
        return strength


def reference_of(frames: Sequence[av.VideoFrame], config: FramesConfig) -> Reference:
    """The mean of frames."""
    pictures, thumbs = [fit(frame, config) for frame in frames], [thumbnail(frame) for frame in frames]
    return Reference(*(np.rint(np.mean(p, axis=0)).astype(np.uint8) for p in (pictures, thumbs)))


def run_pass(
    path: Path, config: FramesConfig, promised: int | None = None, given: Reference | None = None, unsteady: int = 0
) -> VideoPass:
    """Decode a video once.

    Args:
        promised: how many frames it has, where the header is not to be trusted.
        given: its no-contact reference; None takes it from the first frames.
        unsteady: first frames that are not looked at; only the published rule, which knows no light, may choose them.
    """
    with Decoder(path) as decoder:
        found = VideoPass(decoder.header, reference=given)
        count = decoder.header.frames if promised is None else promised
        best = BestFrames(kept_count(count, config), config)
        look = _by_change(config, best, count)
        places = [unsteady + i for i in reference_indices(count)]
        stride, often = max(1, count // PROBES), max(1, count // SIGNATURE_FRAMES)
        by_contact = config.selection == "contact"  # at every frame, not only where the audit does
        untouched: list[av.VideoFrame] = []
        own, frame = None, None
        for index, frame in enumerate(decoder.frames()):
            found.frames = index + 1
            found.rotation = 90 * turns(frame)
            found.sizes.add((frame.height, frame.width) if found.rotation % 180 == 0 else (frame.width, frame.height))
            if len(found.sizes) > 1:
                return found
            if config.selection == "release" or (index >= unsteady and not by_contact):
                look(index, frame)
            if index < unsteady:
                continue
            if index in places:
                untouched.append(frame)
            elif index == places[-1] + 1:
                found.steady = is_steady([thumbnail(each) for each in (*untouched, frame)])
                own = reference_of(untouched, config)
                found.reference = given or own
            if by_contact or index % stride == 0:
                thumb = thumbnail(frame)
                strength = found.note(thumb)
                if index % stride == 0:
                    found.strengths += [strength] if found.reference else []
                    found.brightness.append(cv2.mean(thumb)[0])
                    found.times += [] if frame.time is None else [(index, frame.time)]
                if by_contact and found.reference:
                    best.offer(strength, index, frame)
            if index % often == 0 and found.reference:
                found.brightness_thumbnails.append(brightness_thumbnail(frame))
        if frame is None:
            return found
        own = own or reference_of(untouched, config)
        found.reference, found.first, found.last = given or own, own.thumb, thumbnail(frame)
        found.kept = best.kept()
        if config.selection == "release" and len(found.kept) < RELEASE_FEWEST:
            found.kept = []
        elif not found.kept:
            # A single frame has no predecessor and shows no contact; it is kept because it is all there is.
            found.kept = [Kept(unsteady, 0.0, fit(untouched[0], config))]
    return found


def _by_change(config: FramesConfig, best: BestFrames, count: int) -> Callable[[int, av.VideoFrame], None]:
    """What `salient` and `release` do with each frame that goes by."""
    before: list[tuple[av.VideoFrame, Image]] = []

    def look(index: int, frame: av.VideoFrame) -> None:
        salient = config.selection == "salient"
        now = brightness(frame) if salient else cv2.cvtColor(picture(frame), cv2.COLOR_BGR2GRAY)
        if before:
            earlier, shown = before.pop()
            if salient:
                best.offer(difference(now, shown), index, frame)
            elif index < count:
                best.offer(changed_pixels(now, shown), index - 1, earlier)
        before.append((frame, now))

    return look
