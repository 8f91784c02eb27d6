"""One pass over a video: frames go by once, and what later stages need of them is noted or kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline.config import FramesConfig
from pipeline.videos.decoding import Decoder, Header, Image, brightness, picture, turns
from pipeline.videos.frames.fit import fit
from pipeline.videos.frames.reference import glance, reference_indices, strength, thumbnail
from pipeline.videos.frames.selection import (
    RELEASE_FEWEST,
    Kept,
    Pool,
    changed_pixels,
    difference,
    kept_count,
    thin,
    uniform_indices,
)

PROBES = 8
"""Frames of a video that are measured for the audit, besides the reference's and the last."""
GLANCES = 32
"""Frames of a video from which copies are told, by their brightness alone."""


@dataclass(frozen=True)
class Reference:
    """The no-contact picture: size x size x RGB as encoders see it, and the thumbnail that contact is measured on."""

    picture: Image
    thumb: Image


@dataclass
class Course:
    """What is known of a video after a pass; as it stands, of one without frames."""

    header: Header
    frames: int = 0
    sizes: set[tuple[int, int]] = field(default_factory=set)
    """Height and width of the pictures; more than one where the video changes."""
    rotation: int = 0
    """Degrees against the clock."""
    reference: Reference | None = None
    first: Image | None = None
    last: Image | None = None
    """Thumbnails: the mean of the first frames, and the last frame."""
    contact: float = 0.0
    strongest: Image | None = None
    """Strongest contact so far, and the thumbnail that shows it."""
    strengths: list[float] = field(default_factory=list)
    """In probed frames after the reference's."""
    brightness: list[float] = field(default_factory=list)
    times: list[tuple[int, float]] = field(default_factory=list)
    """Index and time stamp (s) of probed frames that have one."""
    glances: list[Image] = field(default_factory=list)
    """Small pictures of brightness, after the reference's frames."""
    kept: list[Kept] = field(default_factory=list)

    def note(self, thumb: Image) -> float:
        """Look for contact; return its strength, 0 before there is a reference."""
        if self.reference is None:
            return 0.0
        found = strength(thumb, self.reference.thumb)
        if self.strongest is None or found > self.contact:
            self.contact, self.strongest = found, thumb
        return found

    def probe(self, index: int, frame: av.VideoFrame, thumb: Image, touched: float) -> None:
        """Note what the audit wants of every few frames."""
        if self.reference is not None:
            self.strengths.append(touched)
        self.brightness.append(cv2.mean(thumb)[0])
        if frame.time is not None:
            self.times.append((index, frame.time))


class Still:
    """The mean of a video's untouched frames."""

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


def run_pass(path: Path, config: FramesConfig, promised: int | None = None, given: Reference | None = None) -> Course:
    """Decode a video once.

    Args:
        promised: how many frames it has, where that is known better than from its header.
        given: its reference, where that is known already; otherwise it comes from the first frames.
    """
    with Decoder(path) as decoder:
        course = Course(decoder.header, reference=given)
        count = decoder.header.frames if promised is None else promised
        pool = Pool(kept_count(count, config), config)
        choose = _rule(config, pool, count)
        first = reference_indices(count)
        stride, often = max(1, count // PROBES), max(1, count // GLANCES)
        looks = config.selection in ("contact", "adaptive")  # at every frame, not only where the audit does
        still = Still(config)
        frame = None
        for index, frame in enumerate(decoder.frames()):
            course.frames = index + 1
            course.rotation = 90 * turns(frame)
            course.sizes.add((frame.height, frame.width) if course.rotation % 180 == 0 else (frame.width, frame.height))
            if len(course.sizes) > 1:
                return course
            if index in first:
                still.add(frame)
            elif course.reference is None and index > first[-1]:
                course.reference = still.mean()
            if looks or index % stride == 0:
                thumb = thumbnail(frame)
                touched = course.note(thumb)
                if index % stride == 0:
                    course.probe(index, frame, thumb, touched)
                if looks and course.reference is not None:
                    pool.offer(touched, index, frame, thumb)
            if index % often == 0 and course.reference is not None:
                course.glances.append(glance(frame))
            choose(index, frame)
        if frame is None:
            return course
        course.reference = course.reference or still.mean()
        course.first, course.last = still.mean().thumb, thumbnail(frame)
        course.kept = _kept(pool, config, min(course.strengths, default=0.0))
        if not course.kept and config.selection != "release":
            # A single frame has no predecessor and shows no contact; it is kept because it is all there is.
            course.kept = [Kept(0, 0.0, still.pictures[0], None)]
    return course


def reference_from_end(path: Path, frames: int, config: FramesConfig) -> Reference:
    """The reference of a video that ends untouched: the mean of its last frames."""
    wanted = {frames - 1 - i for i in reference_indices(frames)}
    still = Still(config)
    with Decoder(path) as decoder:
        for index, frame in enumerate(decoder.frames()):
            if index in wanted:
                still.add(frame)
    return still.mean()


def _kept(pool: Pool, config: FramesConfig, noise: float) -> list[Kept]:
    kept = pool.kept()
    if config.selection == "release" and len(kept) < RELEASE_FEWEST:
        return []
    return thin(kept, config.tolerance, noise) if config.selection == "adaptive" and kept else kept


def _rule(config: FramesConfig, pool: Pool, count: int) -> Callable[[int, av.VideoFrame], None]:
    """What the selection does with each frame that goes by; those that go by contact are served where that is found."""
    if config.selection == "salient":
        last: list[Image] = []

        def salient(index: int, frame: av.VideoFrame) -> None:
            now = brightness(frame)
            if last:
                pool.offer(difference(now, last.pop()), index, frame)
            last.append(now)

        return salient
    if config.selection == "release":
        before: list[tuple[av.VideoFrame, Image]] = []

        def release(index: int, frame: av.VideoFrame) -> None:
            grey = cv2.cvtColor(picture(frame), cv2.COLOR_BGR2GRAY)
            if before and index < count:
                earlier, earlier_grey = before.pop()
                pool.offer(changed_pixels(grey, earlier_grey), index - 1, earlier)
            before.append((frame, grey))

        return release
    places = set(uniform_indices(count, pool.capacity)) if config.selection == "uniform" else set()

    def uniform(index: int, frame: av.VideoFrame) -> None:
        if index in places:
            pool.offer(0.0, index, frame)

    return uniform
