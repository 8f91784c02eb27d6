"""One pass over a video: hash, number of decoded frames, frames to keep, no-contact reference, audit measurements."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline.config import FramesConfig
from pipeline.core.io import sha256
from pipeline.core.records import Finding, Probe, Severity, finding
from pipeline.videos.decoding import Decoder, Header, Image, fit, turns
from pipeline.videos.files import VideoFile
from pipeline.videos.frames.reference import (
    contact_strength,
    detail,
    is_steady,
    reference_indices,
    starts_touching,
    thumbnail,
    unsteady_frames,
)
from pipeline.videos.frames.selection import RELEASE_FEWEST, BestFrames, Kept

PROBES = 8
"""Frames of a video that are measured for the audit, besides the reference's and the last."""
SIGNATURE_FRAMES = 64
"""Number of frames that a video's signature is computed from; signatures are compared to find copies."""
THUMBNAIL_SIZE = (8, 6)
SIGNATURE_SIZE = (24, 18)


@dataclass(frozen=True)
class Scan:
    """What was found. `kept` is empty only where the published rule leaves the video out."""

    probe: Probe
    kept: tuple[Kept, ...]
    reference: Image
    """size x size x RGB."""


@dataclass(frozen=True)
class Reference:
    """The no-contact picture: size x size x RGB as encoders see it, and the thumbnail that contact is measured on."""

    picture: Image
    thumb: Image


@dataclass
class VideoPass:
    """What one decode of a video found; `first` and `last` are set where there are frames."""

    header: Header
    frames: int = 0
    sizes: set[tuple[int, int]] = field(default_factory=set)
    """Height and width of the pictures; more than one where the video changes."""
    rotation: int = 0
    """Degrees against the clock."""
    reference: Reference | None = None
    steady: bool = True
    """Whether the light stays the same in the frames whose mean is the reference."""
    first: Image = field(init=False)
    last: Image = field(init=False)
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


def scan(file: VideoFile, config: FramesConfig) -> Scan | Finding:
    """Scan one video. A problem is returned as a finding and not raised, so that one bad file does not hide the others.

    The video is decoded once, and again only where the header gives a wrong number of frames, the light is unsteady at
    the beginning, or the video starts in contact.
    """
    try:
        size = file.path.stat().st_size
        content = sha256(file.path)
    except OSError as problem:
        return _wrong(file, f"unreadable ({problem.strerror}); mend its access, or copy it again")
    if size == 0:
        return _wrong(file, "empty (0 bytes); copy it again, or remove it")
    found = run_pass(file.path, config)
    if found.frames == 0:
        return _wrong(file, "no frame decodes; copy it again, convert it, or remove it")
    if len(found.sizes) > 1:
        return _wrong(file, f"frames of {len(found.sizes)} sizes; convert it to one size, or remove it")
    # The published rule takes the number of frames from the header; the others count the frames that decode.
    count = found.header.frames if config.selection == "release" else found.frames
    if count != found.header.frames:
        found = run_pass(file.path, config, count)
    unsteady, begin = 0, 0
    if not found.steady:
        with Decoder(file.path) as decoder:
            unsteady = unsteady_frames(map(thumbnail, decoder.frames()), found.frames)
        # Where the light is never steady, no later frames are better, so the reference is taken from the first ones.
        begin = unsteady if unsteady < found.frames else 0
        found = run_pass(file.path, config, count, unsteady=begin)
    untouched = tuple(begin + i for i in reference_indices(count) if begin + i < found.frames)
    touching = starts_touching(found.first, found.last)
    # After skipped frames the object may touch the sensor already. Then the reference comes from whichever end has
    # less detail, since contact adds detail.
    if touching or (begin and detail(found.first) > detail(found.last)):
        untouched = tuple(found.frames - 1 - i for i in reference_indices(found.frames))
        with Decoder(file.path) as decoder:
            ends = [frame for index, frame in enumerate(decoder.frames()) if index in untouched]
        found = run_pass(file.path, config, count, reference_of(ends, config), begin)
    assert found.reference is not None, "set where there are frames"
    reference = found.reference.thumb
    shown = found.last if found.strongest is None else found.strongest
    ((height, width),) = found.sizes
    # Seconds per frame between probed frames; `irregular` is 0 (unknown) where time stamps do not rise.
    steps = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.pairwise(found.times)]
    rising = bool(steps) and min(steps) > 0
    probe = Probe(
        video_id=file.video_id,
        object_id=file.object_id,
        path=file.relative,
        sha256=content,
        frames=found.frames,
        fps=found.header.fps,
        width=width,
        height=height,
        session=file.session,
        header_frames=found.header.frames,
        hdr=found.header.hdr,
        rotation=found.rotation,
        irregular=max(steps) / min(steps) if rising else 0.0,
        kept=len(found.kept),
        brightness=float(reference[:, :, 0].mean()),
        brightness_step=max((abs(b - a) for a, b in itertools.pairwise(found.brightness)), default=0.0),
        saturated=float(np.mean((shown[:, :, 0] == 0) | (shown[:, :, 0] == 255))),
        contact=found.contact,
        quiet=min(found.strengths, default=0.0),
        contact_end=contact_strength(found.last, reference),
        starts_touching=touching,
        unsteady=unsteady,
        untouched=untouched,
        thumbnail=_flat(cv2.resize(reference, THUMBNAIL_SIZE, interpolation=cv2.INTER_AREA)),
        signature=_signature(found.brightness_thumbnails, reference),
    )
    return Scan(probe, tuple(found.kept), found.reference.picture)


def run_pass(
    path: Path, config: FramesConfig, promised: int | None = None, given: Reference | None = None, unsteady: int = 0
) -> VideoPass:
    """Decode a video once.

    Args:
        promised: how many frames it has, where the header is not to be trusted.
        given: its no-contact reference; None takes it from the first frames.
        unsteady: first frames to skip; only the published rule, which has no check of the light, may keep them.
    """
    with Decoder(path) as decoder:
        found = VideoPass(decoder.header, reference=given)
        count = decoder.header.frames if promised is None else promised
        best = BestFrames(count, config)
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
                best.consider(index, frame)
            if index < unsteady:
                continue
            if index in places:
                untouched.append(frame)
            elif index == places[-1] + 1:
                found.steady = is_steady([thumbnail(each) for each in (*untouched, frame)])
                own = reference_of(untouched, config)
                found.reference = given or own
            probed = index % stride == 0
            if probed or by_contact:
                thumb = thumbnail(frame)
                if found.reference:
                    strength = contact_strength(thumb, found.reference.thumb)
                    if found.strongest is None or strength > found.contact:
                        found.contact, found.strongest = strength, thumb
                    if probed:
                        found.strengths.append(strength)
                    if by_contact:
                        best.offer(strength, index, frame)
                if probed:
                    found.brightness.append(cv2.mean(thumb)[0])
                    if frame.time is not None:
                        found.times.append((index, frame.time))
            if found.reference and index % often == 0:
                found.brightness_thumbnails.append(thumbnail(frame, channels=1))
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


def reference_of(frames: Sequence[av.VideoFrame], config: FramesConfig) -> Reference:
    """The mean of frames."""
    pictures, thumbs = [fit(frame, config) for frame in frames], [thumbnail(frame) for frame in frames]
    return Reference(*(np.rint(np.mean(p, axis=0)).astype(np.uint8) for p in (pictures, thumbs)))


def _signature(pictures: list[Image], reference: Image) -> tuple[float, ...]:
    """A signature of the contact, for finding copies: the mean of the third with most contact, less that of the rest.

    Such means change little when a copy is shortened or encoded again, though each picture and the reference do.
    """
    untouched = np.ascontiguousarray(reference[:, :, 0])
    ranked = [*sorted(pictures, key=lambda p: contact_strength(p, untouched), reverse=True), untouched]
    # Rounded up, so that one picture is enough for the part with most contact.
    third = -(-len(ranked) // 3)
    most, rest = (np.mean(part or [untouched], axis=0, dtype=np.float32) for part in (ranked[:third], ranked[third:]))
    change = most - rest
    small = cv2.resize(change, SIGNATURE_SIZE, interpolation=cv2.INTER_AREA)
    small -= small.mean()
    norm = float(np.linalg.norm(small))
    return _flat(small / norm if norm > 0 else small)


def _flat(array: np.ndarray) -> tuple[float, ...]:
    return tuple(array.astype(np.float64).round(4).ravel().tolist())


def _wrong(file: VideoFile, message: str) -> Finding:
    return finding("decodes", file.relative, message, severity=Severity.ERROR)
