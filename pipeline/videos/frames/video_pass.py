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
    """Whether the light is in the frames that make a reference."""
    first: Image | None = None
    last: Image | None = None
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

    def probe(self, index: int, frame: av.VideoFrame, thumb: Image, strength: float) -> None:
        """Note what the audit wants of every few frames."""
        if self.reference is not None:
            self.strengths.append(strength)
        self.brightness.append(cv2.mean(thumb)[0])
        if frame.time is not None:
            self.times.append((index, frame.time))


class ReferenceMean:
    """The mean of the frames that make the no-contact reference."""

    def __init__(self, config: FramesConfig) -> None:
        self.config = config
        self.pictures: list[Image] = []
        self.thumbs: list[Image] = []

    def add(self, frame: av.VideoFrame) -> None:
        """Take a frame in."""
        self.pictures.append(fit(frame, self.config))
        self.thumbs.append(thumbnail(frame))

    def mean(self) -> Reference:
        """The mean so far, of at least one frame."""
        return Reference(*(np.rint(np.mean(p, axis=0)).astype(np.uint8) for p in (self.pictures, self.thumbs)))


def run_pass(
    path: Path,
    config: FramesConfig,
    promised: int | None = None,
    given: Reference | None = None,
    unsteady: int = 0,
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
        choose = _rule(config, best, count)
        reference_places = [unsteady + i for i in reference_indices(count)]
        stride, often = max(1, count // PROBES), max(1, count // SIGNATURE_FRAMES)
        by_contact = config.selection == "contact"  # at every frame, not only where the audit does
        untouched = ReferenceMean(config)
        frame = None
        for index, frame in enumerate(decoder.frames()):
            found.frames = index + 1
            found.rotation = 90 * turns(frame)
            found.sizes.add((frame.height, frame.width) if found.rotation % 180 == 0 else (frame.width, frame.height))
            if len(found.sizes) > 1:
                return found
            if index >= unsteady or config.selection == "release":
                choose(index, frame)
            if index < unsteady:
                continue
            if index in reference_places:
                untouched.add(frame)
            elif index == reference_places[-1] + 1:
                found.steady = is_steady([*untouched.thumbs, thumbnail(frame)])
                found.reference = found.reference or untouched.mean()
            if by_contact or index % stride == 0:
                thumb = thumbnail(frame)
                strength = found.note(thumb)
                if index % stride == 0:
                    found.probe(index, frame, thumb, strength)
                if by_contact and found.reference is not None:
                    best.offer(strength, index, frame)
            if index % often == 0 and found.reference is not None:
                found.brightness_thumbnails.append(brightness_thumbnail(frame))
        if frame is None:
            return found
        found.reference = found.reference or untouched.mean()
        found.first, found.last = untouched.mean().thumb, thumbnail(frame)
        found.kept = best.kept()
        if config.selection == "release" and len(found.kept) < RELEASE_FEWEST:
            found.kept = []
        elif not found.kept:
            # A single frame has no predecessor and shows no contact; it is kept because it is all there is.
            found.kept = [Kept(unsteady, 0.0, untouched.pictures[0])]
    return found


def reference_of(path: Path, places: Sequence[int], config: FramesConfig) -> Reference:
    """The mean of the frames at these places of a video."""
    untouched = ReferenceMean(config)
    with Decoder(path) as decoder:
        for index, frame in enumerate(decoder.frames()):
            if index in places:
                untouched.add(frame)
    return untouched.mean()


def _rule(config: FramesConfig, best: BestFrames, count: int) -> Callable[[int, av.VideoFrame], None]:
    """What the selection does with each frame that goes by; those that go by contact are served where that is found."""
    if config.selection == "salient":
        last: list[Image] = []

        def salient(index: int, frame: av.VideoFrame) -> None:
            now = brightness(frame)
            if last:
                best.offer(difference(now, last.pop()), index, frame)
            last.append(now)

        return salient
    if config.selection == "release":
        before: list[tuple[av.VideoFrame, Image]] = []

        def release(index: int, frame: av.VideoFrame) -> None:
            grey = cv2.cvtColor(picture(frame), cv2.COLOR_BGR2GRAY)
            if before and index < count:
                earlier, earlier_grey = before.pop()
                best.offer(changed_pixels(grey, earlier_grey), index - 1, earlier)
            before.append((frame, grey))

        return release
    return lambda index, frame: None
