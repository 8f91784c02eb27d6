"""Pictures and videos at their edges: black, white, even, flashing, a single frame, sums beyond 32 bits.

All of it is arithmetic on bytes. Sums and differences are whole numbers below 2^53 and thus exact in a double, so that
nearly every bound is 0; what they are held against is written down here in float64.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from pipeline.videos.decoding import Decoder, Image, brightness
from pipeline.videos.frames.probing import run_pass
from pipeline.videos.frames.reference import strength
from pipeline.videos.frames.selection import difference
from pipeline.videos.frames.subtraction import GAIN, MIDDLE, RING, subtract
from pipeline.scenes.film import write_film
from pipeline.config import FramesConfig
from pipeline.stability.case import BYTES, Bound, Case, Dtype, Floats, exactly, summing

PART = "frames"
HEIGHT, WIDTH = 30, 40
WHOLE = exactly("roundings: none, whole numbers below 2^53")


def cases() -> list[Case]:
    """Salience, contact, subtraction, and whole videos."""
    return [*_pairs(), *_subtractions(), *_videos()]


def even(value: int, *shape: int) -> Image:
    """A picture of one value."""
    return np.full(shape or (HEIGHT, WIDTH, 3), value, np.uint8)


def noise(seed: int, *shape: int) -> Image:
    """A picture of values from 0 to 255."""
    return np.random.default_rng(seed).integers(0, 256, shape or (HEIGHT, WIDTH, 3), np.uint8)


def pairs() -> Mapping[str, tuple[Image, Image]]:
    """Two pictures each that are hard to compare: bytes that wrap around, saturate, or do not differ at all."""
    return {
        "black and black": (even(0), even(0)),
        "white and white": (even(255), even(255)),
        "white and black": (even(255), even(0)),
        "black and white": (even(0), even(255)),
        "saturated by halves": (np.repeat([even(0, WIDTH, 3), even(255, WIDTH, 3)], 15, axis=0), even(128)),
        "noise and noise": (noise(0), noise(1)),
        "one pixel": (even(255, 1, 1, 3), even(0, 1, 1, 3)),
    }


def videos() -> Mapping[str, list[Image]]:
    """Videos without contact, too short, or as restless as can be."""
    return {
        "black": [even(0)] * 12,
        "even": [even(77)] * 12,
        "white": [even(255)] * 12,
        "a single frame": [even(77)],
        "two frames": [even(77), even(90)],
        "black and white by turns": [even(255 * (i % 2)) for i in range(12)],
        "noise": [noise(i) for i in range(12)],
    }


def _pairs() -> Iterator[Case]:
    for name, (one, other) in pairs().items():
        planes = one[..., 0], other[..., 0]
        yield Case(PART, f"salience: {name}", BYTES, partial(_salience, *planes), WHOLE, partial(_total, *planes))
    large = 4320, 7680
    yield Case(
        PART,
        "salience: a sum beyond 32 bits",
        BYTES,
        lambda _: difference(even(255, *large), even(0, *large)),
        WHOLE,
        lambda: 255.0 * large[0] * large[1],
    )
    for name, (one, other) in pairs().items():
        yield Case(
            PART,
            f"strength of contact: {name}",
            BYTES,
            lambda _, a=one, b=other: strength(a, b),  # type: ignore[misc]
            Bound(
                lambda _: 255 * summing(HEIGHT * WIDTH * 3, Dtype.FLOAT64),
                "roundings: means of whole numbers in a double, differences of numbers up to 255; where these are 0, "
                "the error is absolute",
            ),
            partial(_strength, one, other),
        )


def _salience(one: Image, other: Image, _: Dtype) -> float:
    return difference(one, other)


def _total(one: Image, other: Image) -> float:
    return float(np.abs(one.astype(np.float64) - other).sum())


def _strength(one: Image, other: Image) -> float:
    change = one.astype(np.float64) - other
    return float(np.abs(change).mean() - np.abs(change.mean(axis=(0, 1))).mean())


def _subtractions() -> Iterator[Case]:
    for name, pair in pairs().items():
        yield Case(PART, f"subtraction: {name}", BYTES, partial(_subtracted, *pair), WHOLE, partial(_difference, *pair))


def _subtracted(one: Image, other: Image, _: Dtype) -> Floats:
    return np.asarray(subtract(one[None], other)[0], dtype=np.float64)


def _difference(one: Image, other: Image) -> Floats:
    """128 and twice the difference, less the outer ring's median; halves of it go up."""
    change = one.astype(np.float64) - other
    rows, columns = (np.arange(n) for n in one.shape[:2])
    top, left = (max(1, n // RING) for n in one.shape[:2])
    outer = (np.minimum(rows, rows[::-1]) < top)[:, None] | (np.minimum(columns, columns[::-1]) < left)[None, :]
    light = np.floor(np.median(change[outer], axis=0) + 0.5)
    return np.asarray(np.clip(MIDDLE + GAIN * (change - light), 0, 255))


def _videos() -> Iterator[Case]:
    for name, shown in videos().items():
        yield Case(
            PART,
            f"salient frames of a video: {name}",
            BYTES,
            partial(_with_film, shown, _kept),
            WHOLE,
            partial(_with_film, shown, _best, Dtype.UINT8),
        )


def _with_film(shown: list[Image], read: Callable[[Path], Floats], _: Dtype) -> Floats:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        write_film(path, shown, 25.0)
        return read(path)


def _kept(path: Path) -> Floats:
    """Index and score of each kept frame."""
    course = run_pass(path, FramesConfig(size=16, fraction=0.3))
    return np.array([(k.index, k.score) for k in course.kept], dtype=np.float64)


def _best(path: Path) -> Floats:
    """The same by sorting: the 30 % of frames with the largest differences, of equal ones the earlier."""
    with Decoder(path) as decoder:
        planes = np.stack([brightness(frame).astype(np.float64) for frame in decoder.frames()])
    if len(planes) == 1:
        return np.zeros((1, 2))
    scores = np.abs(np.diff(planes, axis=0)).sum(axis=(1, 2))
    best = np.sort(np.argsort(-scores, kind="stable")[: -(-3 * len(scores) // 10)])
    return np.stack([best + 1, scores[best]], axis=1)
