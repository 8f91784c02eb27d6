"""What the hand does: rest, press, twist under force, let go, as in the public videos.

The figures below were measured on the videos of 53 of the paper's training objects, from each video's contact
strength over time (`pipeline.videos.frames.reference.contact_strength` against the first frames, over what remains
once the object is gone). A video's contact strength grows about as the force does: for a ball the sum of |slope| over
the contact goes as a^3 / R, which is F / E* by Hertz. So it stands for the force over time; the force in N is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Track = npt.NDArray[np.float64]

FORCE_N = (0.5, 4.0)
"""Range of the peak force. Not measured, but such that frames differ from the reference as much as real ones do."""
QUANTILES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
"""Levels of the quantiles below, which are over 205 videos whose contact stands out of the noise. Times are shares of
the video."""
BEGUN = (0.152, 0.163, 0.184, 0.224, 0.272, 0.320, 0.342)
"""When contact first reaches a tenth of its peak."""
RISE = (0.041, 0.044, 0.061, 0.080, 0.096, 0.144, 0.176)
"""From a tenth to nine tenths of the peak."""
RELEASED = (0.554, 0.592, 0.648, 0.712, 0.760, 0.829, 0.856)
"""When contact last stands at three tenths."""
FALL = (0.008, 0.008, 0.020, 0.032, 0.061, 0.100, 0.181)
"""From .45 of the peak to .12."""
KEPT = (0.635, 0.660, 0.724, 0.783, 0.849, 0.920, 0.953)
"""What remains of the peak in the last third before letting go: a twisting hand presses less."""
TWIST_DEGREES = (2.5, 9.5, 18.5, 53.6, 78.8, 95.2, 101.9)
"""How far the object turns, from matching high-pass differences of neighbouring frames (Evangelidis and Psarakis 2008,
ECC); over the 34 of 106 strongly textured videos in which every step matched with a correlation over .8."""
CLOCKWISE = 0.76
"""Share of these turns that go clockwise in the picture, where y points down."""
TRAVEL_MM = (0.2, 0.3, 0.6, 1.6, 2.4, 3.3, 3.5)
"""How far the object's centre moves meanwhile: the hand turns about another point."""
CENTRE_MM = ((-1.2, 1.6), (0.2, 1.1))
"""Mean and deviation over videos of the strongest contact's centroid from the picture's centre, in x and in y."""
REACH_MM = 5.0
"""No object's centre ever lies further from the picture's centre, in x or in y."""
LINGER = 0.03
"""Share of the videos that end in contact."""
REMAINING = (0.1, 0.6)
"""Share of the force that remains in these. Seen in too few videos for quantiles."""
TREMOR_MM = 0.15
"""Deviation of the random walk that the object's place has made by the end, at any frame rate. Not measured."""


@dataclass(frozen=True)
class Motion:
    """What the hand does, one value a frame."""

    force: Track
    """In N; 0 before first touch, and above 0 in at least one frame."""
    angle: Track
    """Turn of the object in the picture, in degrees counterclockwise, as `cv2.getRotationMatrix2D` takes it."""
    x: Track
    """Place of the object's centre in mm, from the image's centre."""
    y: Track


def make_motion(frames: int, rng: np.random.Generator, *, twist: bool = True) -> Motion:
    """A hand's motion over a video of two frames or more, at any frame rate: times are shares of the video.

    Without a twist the hand presses as before, but turns nothing and holds the force until it lets go.
    """
    # Even a video of two frames has one in its very middle, while the object is held.
    time = np.arange(frames) / (2 * (frames // 2))
    rise, fall = _draw(RISE, rng) / (_ramp_inverse(0.9) - _ramp_inverse(0.1)), _draw(FALL, rng)
    touch = max(0.05, _draw(BEGUN, rng) - _ramp_inverse(0.1) * rise)
    hold = min(touch + rise, 0.49)
    kept = _draw(KEPT, rng)
    if not twist:
        kept = 1.0
    # From .45 to .12 of the peak, and .3 of it, as shares of what was kept until then.
    fall /= _ramp_inverse(1 - 0.12 / kept) - _ramp_inverse(1 - 0.45 / kept)
    release = max(0.5, _draw(RELEASED, rng) - _ramp_inverse(1 - 0.3 / kept) * fall)
    remaining = rng.uniform(*REMAINING) if rng.random() < LINGER else 0.0
    twisted = np.clip((time - hold) / (release - hold), 0, 1)
    released = 1 - (1 - remaining) * _ramp(time, release, release + fall)
    profile = _ramp(time, touch, hold) * (1 - (1 - kept) * twisted) * released
    force, start = rng.uniform(*FORCE_N), rng.uniform(0, 360)
    turn = _draw(TWIST_DEGREES, rng) * (-1 if rng.random() < CLOCKWISE else 1)
    heading, travel = rng.uniform(0, 2 * np.pi), _draw(TRAVEL_MM, rng)
    places = []
    for (mean, deviation), part in zip(CENTRE_MM, (np.cos(heading), np.sin(heading)), strict=True):
        walk = TREMOR_MM / np.sqrt(frames) * np.cumsum(rng.standard_normal(frames))
        places.append(
            np.clip(rng.normal(mean, deviation) + travel * twist * part * (twisted - 0.5) + walk, -REACH_MM, REACH_MM)
        )
    return Motion(force * profile, start + turn * twisted * twist, *places)


def _draw(quantiles: Sequence[float], rng: np.random.Generator) -> float:
    """A value from a distribution known by its quantiles at `QUANTILES`; nothing beyond the outermost two."""
    return float(np.interp(rng.random(), QUANTILES, quantiles))


def _ramp(time: Track, start: float, stop: float) -> Track:
    """0 up to `start`, 1 from `stop`, smooth between (3 s^2 - 2 s^3)."""
    s = np.clip((time - start) / (stop - start), 0, 1)
    return s * s * (3 - 2 * s)


def _ramp_inverse(share: float) -> float:
    """The s from 0 to 1 at which a ramp reaches `share`: the inverse of 3 s^2 - 2 s^3."""
    return 0.5 - float(np.sin(np.arcsin(1 - 2 * share) / 3))
