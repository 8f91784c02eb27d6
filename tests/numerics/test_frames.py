"""Pictures at their edges: black, white, saturated, a single pixel, sums beyond 32 bits.

All of it is arithmetic on bytes. Sums and differences are whole numbers below 2^53 and thus exact in a double, so that
nearly every bound is 0; what they are held against is written down here in float64.
"""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.videos.frames.reference import contact_strength
from pipeline.videos.frames.selection import difference
from pipeline.videos.frames.subtraction import subtract
from tests.numerics.bounds import summing
from tests.numerics.harness import FLOAT64, UINT8, Check, Floats

PART = "frames"
HEIGHT, WIDTH = 30, 40


def even(value: int, *shape: int) -> np.ndarray:
    """A picture of one value."""
    return np.full(shape or (HEIGHT, WIDTH, 3), value, np.uint8)


PAIRS = {
    "black and black": (even(0), even(0)),
    "white and white": (even(255), even(255)),
    "white and black": (even(255), even(0)),
    "black and white": (even(0), even(255)),
    "saturated by halves": (np.repeat([even(0, WIDTH, 3), even(255, WIDTH, 3)], 15, axis=0), even(128)),
    "noise and noise": tuple(np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3), np.uint8)),
    "one pixel": (even(255, 1, 1, 3), even(0, 1, 1, 3)),
}
"""Two pictures each that are hard to compare: bytes that wrap around, saturate, or do not differ at all."""


@pytest.mark.parametrize("name", PAIRS)
def test_pictures_are_compared_without_wrapping_around(check: Check, name: str) -> None:
    """Salience and subtraction are exact.

    The contact strength: roundings of means of whole numbers in a double, differences of numbers up to 255; where
    these are 0, the error is absolute.
    """
    one, other = PAIRS[name]
    change = one.astype(np.float64) - other
    check(f"salience: {name}", UINT8, lambda _: difference(one[..., 0], other[..., 0]), 0, abs(change[..., 0]).sum())
    strength = abs(change).mean() - abs(change.mean(axis=(0, 1))).mean()
    bound = 255 * summing(HEIGHT * WIDTH * 3, FLOAT64)
    check(f"contact strength: {name}", UINT8, lambda _: contact_strength(one, other), bound, strength)
    check(f"subtraction: {name}", UINT8, lambda _: subtract(one[None], other)[0], 0, subtracted(change))


def subtracted(change: Floats) -> Floats:
    """128 and twice the difference, less its median over the outer eighth; halves of it go up."""
    rows, columns = (np.arange(n) for n in change.shape[:2])
    top, left = (max(1, n // 8) for n in change.shape[:2])
    outer = (np.minimum(rows, rows[::-1]) < top)[:, None] | (np.minimum(columns, columns[::-1]) < left)[None, :]
    light = np.floor(np.median(change[outer], axis=0) + 0.5)
    return np.clip(128 + 2 * (change - light), 0, 255)


def test_a_difference_beyond_32_bits_is_exact(check: Check) -> None:
    white, black = (even(value, 4320, 7680) for value in (255, 0))
    check("salience: a sum beyond 32 bits", UINT8, lambda _: difference(white, black), 0, 255.0 * white.size)
