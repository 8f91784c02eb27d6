"""What the camera sees of the gel's skin: three coloured lights from three sides over the sensor's own background.

Lambert's law relative to flat skin: a light at azimuth a and inclination i from the vertical gives
(1 - tan i (h_x cos a + h_y sin a)) / sqrt(1 + |grad h|^2), no less than 0. Background and colours are modelled on
real frames: red from above, blue and green from below, brightest in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.scenes.geometry import Heights

Image = npt.NDArray[np.uint8]

AZIMUTHS = np.radians((50.0, 140.0, 270.0))
"""Where blue, green and red light come from; y points down, so 270 degrees is the image's top."""
TAN_INCLINATION = 1.15
DIRECT = 0.75
"""Share of the light that comes straight from the lights; the rest is scattered."""
GLOW = ((60.0, 98.0, 0.0, -0.1, 1.1, 0.9), (65.0, 62.0, 0.0, 0.05, 1.0, 1.1), (15.0, 118.0, 0.0, 0.2, 0.8, 0.75))
"""Background of blue, green, red: floor, height, centre (x, y) and widths of a Gaussian over -1..1, in 8-bit steps."""
NOISE = 0.7
"""Standard deviation of the noise from frame to frame, in 8-bit steps."""
SPECKS = 12
"""Dust grains that a sensor always shows."""


@dataclass(frozen=True)
class Sensor:
    """One sensor: its background (height x width x BGR, 8-bit steps) and a larger field of noise to cut frames from."""

    background: npt.NDArray[np.float32]
    noise: npt.NDArray[np.float32]


@lru_cache(maxsize=4)
def make_sensor(width: int, height: int, seed: int) -> Sensor:
    """A sensor with its own tints, centre of light, dust and noise."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    channels = []
    for floor, peak, cx, cy, sx, sy in GLOW:
        dx, dy, tint = rng.normal(0, 0.04), rng.normal(0, 0.04), rng.normal(1, 0.04)
        bell = np.exp(-(((x - cx - dx) / sx) ** 2) - ((y - cy - dy) / sy) ** 2)
        channels.append((floor + peak * bell) * tint)
    background = np.stack(channels, axis=-1)
    for column, row, darkness in rng.uniform((-1, -1, 0.05), (1, 1, 0.3), (SPECKS, 3)):
        background *= 1 - darkness * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 0.008**2)[..., None]
    noise = NOISE * rng.standard_normal((height + height // 2, width + width // 2, 3), dtype=np.float32)
    return Sensor(background.astype(np.float32), noise)


def shade(skin: Heights, sensor: Sensor, pitch: float, seed: int) -> Image:
    """One frame: height x width x BGR, uint8.

    Args:
        skin: Indentation in mm.
        sensor: Of the same size.
        pitch: In mm a pixel.
        seed: Which noise this frame has.
    """
    height, width = skin.shape
    slope_x = cv2.Sobel(skin, cv2.CV_32F, 1, 0, scale=1 / (8 * pitch), borderType=cv2.BORDER_REPLICATE)
    slope_y = cv2.Sobel(skin, cv2.CV_32F, 0, 1, scale=1 / (8 * pitch), borderType=cv2.BORDER_REPLICATE)
    flatness = 1 / np.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
    lit = []
    for azimuth in AZIMUTHS:
        cosine = slope_x * np.float32(-TAN_INCLINATION * np.cos(azimuth))
        cosine += slope_y * np.float32(-TAN_INCLINATION * np.sin(azimuth))
        cosine += 1
        cosine *= flatness
        lit.append(np.maximum(cosine, 0, out=cosine))
    light = cv2.merge(lit)
    light *= DIRECT
    light += 1 - DIRECT
    light *= sensor.background
    top, left = seed % (height // 2 + 1), (seed >> 20) % (width // 2 + 1)
    light += sensor.noise[top : top + height, left : left + width]
    image: Image = cv2.convertScaleAbs(np.maximum(light, 0))
    return image
