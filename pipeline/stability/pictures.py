"""What the camera sees, at its edges: threads' rims, relief from nothing to mountains, slopes beyond all light, films.

Relief and light are float32 whatever they are given; what they are held against is written down here in float64. Films
are bytes.
"""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np

from pipeline.videos.decoding import decode
from pipeline.scenes.film import write_film
from pipeline.scenes.grid import Grid, thread
from pipeline.scenes.light import Sensor, make_sensor, shade
from pipeline.scenes.relief import Rough
from pipeline.stability.case import BYTES, Bound, Case, Dtype, Floats, summing, within
from pipeline.stability.scenes import FLOAT32, PART, PITCH, SIDE

STEEP = (1e-30, 1e-3, 1.0, 1e6)
"""Deviation of white noise in mm, as heights of skin."""
CODED = 255 / 219 * (46 / 16 + 0.5) + 2.017 * (25 / 16 + 0.5) + 0.5
"""In 8-bit steps, how far an even picture may be off: brightness is rounded to whole steps of 255/219, then its mean
over a block by MPEG-4's coarsest scaler (46, colours 25, of eight times the mean; ISO/IEC 14496-2, table 7-1); blue
holds 2.017 of a colour difference; and the way back ends at whole steps."""


def cases() -> list[Case]:
    """Relief, light and film."""
    return [*_relief(), *_light(), *_films()]


# Relief


def _relief() -> Iterator[Case]:
    offset = np.linspace(0, 1, 257) ** 0.125 * 0.75
    yield Case(
        PART,
        "thread: heights up to its rim",
        FLOAT32,
        lambda d: thread(offset.astype(d.numpy), 0.75),
        Bound(
            lambda d: math.sqrt(6 * d.roundoff),
            "roundings: r^2 - x^2 cancels at the rim and is off by 6 u r^2 at most, its root by the root of that",
        ),
        lambda: np.sqrt(0.75**2 - np.minimum(offset, 0.75) ** 2) - 0.75,
    )
    for rms, pitch in itertools.product((1e-6, 100.0), (1e-3, 0.1, 10.0)):
        layer, grid = Rough(kind="rough", rms=rms, longest=25.0), Grid(SIDE, pitch)
        yield Case(
            PART,
            f"roughness of {rms:g} mm, pixels of {pitch:g} mm: deviation",
            FLOAT32,
            partial(_deviation, layer, grid),
            Bound(lambda d: 2 * summing(SIDE * SIDE, d), "roundings: mean and deviation are sums over all pixels"),
            partial(_share, layer, grid),
        )


def _deviation(layer: Rough, grid: Grid, _: Dtype) -> Floats:
    return np.atleast_1d(layer.sample(grid, np.random.default_rng(0)).astype(np.float64).std())


def _share(layer: Rough, grid: Grid) -> Floats:
    """What of a self-affine surface the grid carries: rms sqrt(1 - (2 pitch / longest)^2H)."""
    return np.atleast_1d(layer.rms * math.sqrt(max(0.0, 1 - (2 * grid.pitch / layer.longest) ** (2 * layer.hurst))))


# Light


def _light() -> Iterator[Case]:
    for size in STEEP:
        yield Case(
            PART,
            f"light on noise of {size:g} mm",
            FLOAT32,
            partial(_picture, size),
            Bound(
                _half_a_step,
                "use: half a step of 8 bits; and roundings of some 20 operations on twice the lights' sum",
            ),
            partial(_lambert, size),
        )


def _half_a_step(dtype: Dtype) -> float:
    size = max(float(np.abs(_lambert(s)).max()) for s in STEEP)
    smallest = min(float(np.abs(_lambert(s)).max()) for s in STEEP)
    return (0.5 + 20 * 2 * size * dtype.roundoff) / smallest


@cache
def _sensor() -> Sensor:
    return make_sensor(48, 36, 1)


def _skin(size: float) -> np.ndarray:
    return np.float32(size) * np.random.default_rng(0).standard_normal((36, 48), dtype=np.float32)


def _picture(size: float, _: Dtype) -> Floats:
    return shade(_skin(size), _sensor(), PITCH, 0).astype(np.float64)


@cache
def _lambert(size: float) -> Floats:
    """Lambert's law of `light` in float64, before it is rounded to 8 bits."""
    sensor, skin = _sensor(), _skin(size).astype(np.float64)
    x, y = (
        cv2.Sobel(skin, cv2.CV_64F, i, 1 - i, scale=1 / (8 * PITCH), borderType=cv2.BORDER_REPLICATE) for i in (1, 0)
    )
    steep = np.sqrt(1 + x * x + y * y)
    lit = [
        np.maximum((across * x + along * y + direct) / steep, 0) - direct
        for direct, (across, along) in zip(sensor.direct, sensor.gains, strict=True)
    ]
    picture = (np.stack(lit, axis=-1) + sensor.glow) * sensor.marks + sensor.noise[: len(skin), : skin.shape[1]]
    return np.asarray(np.clip(picture, 0, 255))


# Film


def _films() -> Iterator[Case]:
    for name, value in (("black", 0), ("grey", 77), ("white", 255)):
        yield Case(
            PART,
            f"film, {name}",
            BYTES,
            partial(_filmed, value),
            within(
                CODED / max(value, 1),
                "roundings: those of the codec's mean brightness and colours, which are all that an even block has",
            ),
            partial(np.full, (3, 36, 48, 3), float(value)),
        )


def _filmed(value: int, _: Dtype) -> Floats:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        write_film(path, [np.full((36, 48, 3), value, np.uint8)] * 3, 25.0)
        return np.stack(list(decode(path))).astype(np.float64)
