"""Hand-made features of tactile frames: how a picture differs from the same gel without contact.

A frame of any size becomes 320 x 240 pixels, the reference is subtracted and the difference blurred a little; all
features share one pyramid of it whose levels halve the size. Level l holds the difference at a scale (standard
deviation of the Gaussian) of 2^l pixels, where two more blurs complete the octave.

Sources: Burt and Adelson 1983, Lowe 2004 (difference-of-Gaussian pyramid); Förstner and Gülch 1987, Bigün and Granlund
1987 (structure tensor and its coherence); Ojala, Pietikäinen, Mäenpää 2002 (uniform local binary patterns).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.videos.decoding import Image

Plane = npt.NDArray[np.float32]
"""Float32, height x width or height x width x BGR, in 8-bit steps."""
Vector = npt.NDArray[np.float32]

WIDTH, HEIGHT = 320, 240
OCTAVES = 5
TEXTURED = slice(1, 4)
"""Levels that have local binary patterns and coherence: the finest one took a third of all time and measured no better;
coarser ones have too few pixels."""
PERCENTILES = (50, 75, 90, 95, 99)
STEP = 0.25
"""Grey steps that percentiles are exact to: they are read off a histogram, which is far faster than sorting."""
THRESHOLDS = (2, 4, 8, 16, 32)
"""Grey steps over which a place counts as touched."""
FAINTEST = 0.5
"""Grey steps below which no blob is seen, so that the noise of an untouched gel has none."""
RINGS = 12
"""Rings of the spectrum, equally wide on a logarithmic axis."""
SLOWEST, FASTEST = 2 / WIDTH, 0.5
"""Their outer limits in cycles a pixel."""
FIXED_POINT = 16
"""Patterns compare sixteenths of a grey step, so that rounding errors make no pattern on an even surface."""

FEATURE_NAMES: tuple[str, ...] = (
    *(f"colour.{kind}.{channel}" for kind in ("mean", "deviation") for channel in "bgr"),
    *(f"change.p{p}" for p in PERCENTILES),
    *(f"area.over{t}" for t in THRESHOLDS),
    *(f"band.rms.{2 ** (i / 2):.1f}px" for i in range(2 * OCTAVES)),
    *(f"peaked.kurtosis.{2 ** (i / 2):.1f}px" for i in range(2 * OCTAVES)),
    *(f"blob.count.{2**level}px" for level in range(OCTAVES)),
    *(f"coherence.{kind}.{2**level}px" for level in range(OCTAVES)[TEXTURED] for kind in ("local", "global")),
    *(f"lbp.{2**level}px.{code}" for level in range(OCTAVES)[TEXTURED] for code in range(10)),
    *(f"spectrum.ring{i}" for i in range(RINGS)),
)
"""What each number of `frame_features` is, `group.detail`; scales are in pixels of the 320 x 240 picture."""
VIDEO_FEATURE_NAMES: tuple[str, ...] = tuple(f"{name} {kind}" for kind in ("mean", "max") for name in FEATURE_NAMES)


def video_features(frames: Sequence[Image], reference: Image | Plane) -> Vector:
    """Mean and maximum of each frame feature over the frames, on a signed logarithmic scale.

    Args:
        frames: At least one, in any order.
        reference: The gel without contact, see `frame_features`.

    Returns:
        As many finite numbers as there are `VIDEO_FEATURE_NAMES`: sign(x) log(1 + |x|).
    """
    reference = _plane(reference)
    return pool_features([frame_features(frame, reference) for frame in frames])


def pool_features(rows: Sequence[Vector]) -> Vector:
    """Mean and maximum over frames of what `frame_features` gives, on a signed logarithmic scale."""
    stack = np.stack(rows)
    features = np.concatenate([stack.mean(axis=0), stack.max(axis=0)])
    compressed: Vector = np.sign(features) * np.log1p(np.abs(features))
    return compressed


def frame_features(frame: Image, reference: Image | Plane) -> Vector:
    """All features of one frame, in the order of `FEATURE_NAMES`, in 8-bit steps or as shares.

    Args:
        frame: uint8, height x width x BGR, at least 1 x 1. (RGB would only swap the names of the colours.)
        reference: The gel without contact, height x width x BGR in 8-bit steps; it need not have the frame's size.
    """
    difference = cv2.GaussianBlur(_plane(frame) - _plane(reference), (0, 0), 1)
    means, deviations = cv2.meanStdDev(difference)
    change = _channel_mean(np.abs(difference))
    octaves = _octaves(_channel_mean(difference))
    bands = [band for octave in octaves for band in (octave[0] - octave[1], octave[1] - octave[2])]
    energies = np.array([_moments(band) for band in bands])
    features = np.concatenate(
        [
            means.ravel(),
            deviations.ravel(),
            percentiles(change),
            _areas(change),
            energies[:, 0],
            energies[:, 1],
            [_blobs(band, rms) for band, rms in zip(bands[::2], energies[::2, 0], strict=True)],
            *(coherence(octave[0]) for octave in octaves[TEXTURED]),
            *(uniform_patterns(octave[0]) for octave in octaves[TEXTURED]),
            spectrum(octaves[0][0]),
        ]
    )
    return features.astype(np.float32)


def _plane(picture: Image | Plane) -> Plane:
    """A picture as float32 (so that no difference wraps around) of 240 x 320 pixels."""
    plane = picture.astype(np.float32, copy=False)
    if plane.shape[:2] == (HEIGHT, WIDTH):
        return plane
    resized: Plane = cv2.resize(plane, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return resized


def _channel_mean(picture: Plane) -> Plane:
    grey: Plane = cv2.transform(picture, np.full((1, 3), 1 / 3, np.float32))
    return grey


def _octaves(grey: Plane) -> list[tuple[Plane, Plane, Plane]]:
    """Each octave's picture at 1, sqrt(2) and 2 of its own pixels; the last, halved, begins the next octave."""
    octaves = []
    for _ in range(OCTAVES):
        middle = cv2.GaussianBlur(grey, (0, 0), 1)
        coarse = cv2.GaussianBlur(middle, (0, 0), 2**0.5)
        octaves.append((grey, middle, coarse))
        grey = np.ascontiguousarray(coarse[::2, ::2])
    return octaves


def _moments(band: Plane) -> tuple[float, float]:
    """Root mean square and kurtosis E[x^4] / E[x^2]^2 (3 for Gaussian noise, more for few sharp spots, 0 for none)."""
    square = cv2.multiply(band, band)
    power = cv2.mean(square)[0]
    kurtosis = cv2.norm(square, cv2.NORM_L2SQR) / square.size / power**2 if power > 1e-6 else 0.0
    return power**0.5, kurtosis


def percentiles(change: Plane) -> npt.NDArray[np.float64]:
    """The upper end of the histogram's cell that each percentile falls into, in grey steps."""
    cells = int(256 / STEP)
    counts = cv2.calcHist([change], [0], None, [cells], [0, 256]).ravel()
    shares = np.cumsum(counts, dtype=np.float64) / change.size
    cell = np.searchsorted(shares, np.array(PERCENTILES) / 100 - 1e-9)
    return (cell + 1).astype(np.float64) * STEP


def _areas(change: Plane) -> list[float]:
    """Share of the picture that has changed by more than each threshold, in 4 x 4 pixels on average."""
    coarse = cv2.resize(change, (WIDTH // 4, HEIGHT // 4), interpolation=cv2.INTER_AREA)
    return [float(np.count_nonzero(coarse > threshold)) / coarse.size for threshold in THRESHOLDS]


def _blobs(band: Plane, rms: float) -> int:
    """Connected places that stand out by two root mean squares of the band."""
    mask = (band > max(2 * rms, FAINTEST)).view(np.uint8)
    return int(cv2.connectedComponents(mask, connectivity=8)[0]) - 1


def coherence(grey: Plane) -> tuple[float, float]:
    """How far gradients share one direction, 0 to 1: near each pixel (weighted by their energy) and in the whole.

    With the eigenvalues a >= b of the structure tensor this is (a - b) / (a + b), the square root of Bigün's.
    """
    x, y = cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    # The tensor's trace, and twice its deviator: a vector whose length is a - b.
    energy, difference, shear = x * x + y * y, x * x - y * y, 2 * x * y
    total = cv2.sumElems(energy)[0]
    if total < 1e-3 * grey.size:
        return 0.0, 0.0
    near = cv2.magnitude(cv2.GaussianBlur(difference, (0, 0), 2), cv2.GaussianBlur(shear, (0, 0), 2))
    whole = np.hypot(cv2.sumElems(difference)[0], cv2.sumElems(shear)[0])
    return cv2.sumElems(near)[0] / total, float(whole) / total


@cache
def _pattern_table() -> Image:
    """The class of each of the 256 patterns: its ones where they are in one run (0 to 8), else 9 (Ojala, eq. 9)."""
    bits = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)
    changes = (bits != np.roll(bits, 1, axis=1)).sum(axis=1)
    return np.where(changes <= 2, bits.sum(axis=1), 9).astype(np.uint8)


def uniform_patterns(grey: Plane) -> npt.NDArray[np.float64]:
    """Shares of the ten rotation-invariant uniform patterns (riu2) of the eight neighbours in the square of 3 x 3.

    A neighbour counts as one where it is not darker than the centre. Pixels at the edge have no pattern.
    """
    fixed = np.rint(grey * FIXED_POINT).astype(np.int16)
    height, width = fixed.shape
    centre = fixed[1:-1, 1:-1]
    code = np.zeros(centre.shape, np.uint8)
    around = ((0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0))
    for bit, (top, left) in enumerate(around):
        one = fixed[top : height - 2 + top, left : width - 2 + left] >= centre
        code |= one.view(np.uint8) << np.uint8(bit)
    counts = cv2.calcHist([code], [0], None, [256], [0, 256]).ravel()
    return np.bincount(_pattern_table(), counts, 10) / code.size


@cache
def _rings(height: int, width: int) -> tuple[Plane, npt.NDArray[np.intp], npt.NDArray[np.float64]]:
    """A Hann window, each coefficient's ring (0: slower, RINGS + 1: faster than all) and how many a ring has."""
    window = np.outer(np.hanning(height), np.hanning(width)).astype(np.float32)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    ring = np.digitize(frequency, np.geomspace(SLOWEST, FASTEST, RINGS + 1)).ravel()
    return window, ring, np.maximum(np.bincount(ring, minlength=RINGS + 2), 1).astype(np.float64)


def spectrum(grey: Plane) -> npt.NDArray[np.float64]:
    """Mean amplitude in each ring of the power spectrum, scaled so that it does not depend on the picture's size."""
    from scipy.fft import rfft2

    window, ring, sizes = _rings(*grey.shape)
    waves = rfft2((grey - cv2.mean(grey)[0]) * window)
    power = np.square(waves.real) + np.square(waves.imag)
    means = np.bincount(ring, power.ravel(), RINGS + 2) / sizes
    amplitudes: npt.NDArray[np.float64] = np.sqrt(means[1:-1] / grey.size)
    return amplitudes
