"""Selection of a video's frames: those that are kept, and the no-contact reference."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import av

from pipeline.config import FramesConfig
from pipeline.videos.decoding import Decoder, Header, Image, fit, turns
from pipeline.videos.files import VideoFile
from pipeline.videos.frames.reference import (
    contact_strength,
    detail,
    is_steady,
    mean,
    reference_indices,
    starts_touching,
    thumbnail,
    unsteady_frames,
)
from pipeline.videos.frames.selection import RELEASE_FEWEST, BestFrames, Kept
from pipeline.videos.records import Finding, Severity, finding

PROBES = 8
"""Frames of a video that contact is measured in, besides the reference's and the last."""


@dataclass
class Look:
    """What one decode of a video shows."""

    header: Header
    thumbs: list[Image] = field(default_factory=list)
    """Of every frame."""
    times: list[float | None] = field(default_factory=list)
    """Time stamps (s) of every frame."""
    sizes: set[tuple[int, int]] = field(default_factory=set)
    """Height and width of the pictures; more than one where the video changes, where the look ends."""
    rotation: int = 0
    """Degrees against the clock."""

    def along(self, frames: Iterable[av.VideoFrame]) -> Iterator[av.VideoFrame]:
        """The frames, each of which is looked at as it passes."""
        for frame in frames:
            self.rotation = 90 * turns(frame)
            self.sizes.add((frame.height, frame.width) if self.rotation % 180 == 0 else (frame.width, frame.height))
            if len(self.sizes) > 1:
                return
            self.thumbs.append(thumbnail(frame))
            self.times.append(frame.time)
            yield frame


@dataclass(frozen=True)
class Plan:
    """What a video's frames are chosen by."""

    count: int
    """How many there are, in the header or decoded, as the rule has it."""
    untouched: tuple[int, ...]
    """Those that the reference is the mean of."""
    start: int
    """The first whose contact is measured."""
    begin: int = 0
    """Number of first frames to skip. Only the published rule, which does not look at the light, may keep some."""


@dataclass(frozen=True)
class Scan:
    """What was found. `kept` is empty only where the published rule leaves the video out."""

    look: Look
    plan: Plan
    kept: tuple[Kept, ...]
    reference: Image
    """size x size x RGB."""
    ground: Image
    """The reference's thumbnail, which contact is measured on."""
    touching: bool
    """Whether the video starts in contact."""
    unsteady: int
    """First frames in which the light still changes; all where it never is steady."""
    probed: list[int]
    """A few frames, evenly spaced, that are measured whatever the rule is."""
    strengths: dict[int, float]
    """Contact strength by frame, of those that are measured: all with `contact`, else the probed ones."""

    @property
    def frames(self) -> int:
        """How many frames decode."""
        return len(self.look.thumbs)

    @property
    def contact(self) -> float:
        """Largest contact strength."""
        return max(self.strengths.values(), default=0.0)

    @property
    def quiet(self) -> float:
        """Least contact strength of the probed frames."""
        return min((self.strengths[i] for i in self.probed if i in self.strengths), default=0.0)


def scan(file: VideoFile, config: FramesConfig) -> Scan | Finding:
    """Select one video's frames. A problem is returned as a finding, so that one bad file does not hide the others.

    The video is decoded once, and once more where the header gives a wrong number of frames, the light is unsteady at
    the beginning, or the video starts in contact. Memory holds thumbnails of all frames beside those that are kept.
    """
    try:
        with file.path.open("rb") as stream:
            empty = not stream.read(1)
    except OSError as problem:
        return _wrong(file, f"unreadable ({problem.strerror}); mend its access, or copy it again")
    if empty:
        return _wrong(file, "empty (0 bytes); copy it again, or remove it")
    with Decoder(file.path) as decoder:
        look, promised = Look(decoder.header), decoder.header.frames
        plan = supposed = Plan(promised, reference_indices(promised), reference_indices(promised)[-1] + 1)
        selected = _select(look.along(decoder.frames()), look, config, plan)
    thumbs, frames = look.thumbs, len(look.thumbs)
    if len(look.sizes) > 1:
        return _wrong(file, f"frames of {len(look.sizes)} sizes; convert it to one size, or remove it")
    if selected is None:
        return _wrong(file, "no frame decodes; copy it again, convert it, or remove it")
    # The published rule takes the number of frames from the header; the others count the frames that decode.
    count = promised if config.selection == "release" else frames
    places, begin, unsteady = reference_indices(count), 0, 0
    start = places[-1] + 1
    if start < frames and not is_steady([thumbs[i] for i in (*places, start)]):
        unsteady = unsteady_frames(thumbs, frames)
        # Where the light is never steady, no later frames are better, so the reference is taken from the first ones.
        begin = unsteady if unsteady < frames else 0
    plan = Plan(count, tuple(begin + i for i in places), begin + start, begin)
    first = ground = mean([thumbs[i] for i in plan.untouched if i < frames])
    touching = starts_touching(first, thumbs[-1])
    # After skipped frames the object may touch the sensor already. Then the reference comes from whichever end has
    # less detail, since contact adds detail.
    if touching or (begin and detail(first) > detail(thumbs[-1])):
        plan = Plan(count, tuple(frames - 1 - i for i in reference_indices(frames)), begin, begin)
        ground = mean([thumbs[i] for i in plan.untouched])
    if plan != supposed:
        with Decoder(file.path) as decoder:
            selected = _select(decoder.frames(), look, config, plan)
        assert selected is not None, "the same frames decode again"
    kept, reference = selected
    probed = [i for i in range(begin, frames) if i % max(1, count // PROBES) == 0]
    measured = range(begin, frames) if config.selection == "contact" else probed
    strengths = {i: contact_strength(thumbs[i], ground) for i in measured if i >= plan.start}
    return Scan(look, plan, kept, reference, ground, touching, unsteady, probed, strengths)


def _select(
    frames: Iterable[av.VideoFrame], look: Look, config: FramesConfig, plan: Plan
) -> tuple[tuple[Kept, ...], Image] | None:
    """What is kept of the frames, and their reference; None where there are none.

    The look has the thumbnails of all frames that have passed.
    """
    best, untouched = BestFrames(plan.count, config), list[Image]()
    first, ground = None, None
    for index, frame in enumerate(frames):
        if index in plan.untouched:
            untouched.append(fit(frame, config))
        if index == plan.begin:
            first = frame
        if config.selection == "contact":
            if index >= plan.start:
                if ground is None:
                    ground = mean([look.thumbs[i] for i in plan.untouched])
                best.offer(contact_strength(look.thumbs[index], ground), index, frame)
        elif config.selection == "release" or index >= plan.begin:
            best.consider(index, frame)
    if first is None:
        return None
    kept = best.kept()
    if config.selection == "release" and len(kept) < RELEASE_FEWEST:
        kept = []
    elif not kept:
        # A single frame has no predecessor and shows no contact; it is kept because it is all there is.
        kept = [Kept(plan.begin, 0.0, fit(first, config))]
    return tuple(kept), mean(untouched)


def _wrong(file: VideoFile, message: str) -> Finding:
    return finding("decodes", file.relative, message, severity=Severity.ERROR)
