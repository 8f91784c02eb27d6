"""What the camera sees of the gel's skin: three coloured lights, the sensor's own background, its dust and its noise.

Lambert's law against flat skin. A light that adds D to a pixel of flat skin, from the direction (t, 1) (t: its
horizontal over its vertical part), adds D (1 - t . grad h) / sqrt(1 + |grad h|^2) where the skin has the slope grad h,
never less than 0. With the gain g = -D t, in 8-bit steps a unit of slope, a channel of the picture is

    background + max(0, (D + g . grad h) / sqrt(1 + |grad h|^2)) - D

and g . grad h to first order, as in a calibrated GelSight (Johnson and Adelson 2009; Yuan, Dong and Adelson 2017). The
lights stand beside the gel, so that directions and gains change over the picture (Wang et al. 2021, GelSight Wedge: the
place in the picture is part of their calibration; Gomes, Paoletti and Luo 2021 simulate such sensors likewise).

Everything below was measured on no-contact frames and on frames in full contact of 53 of the paper's training objects,
nothing on other objects.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.scenes.grid import Heights

Image = npt.NDArray[np.uint8]
Plane = npt.NDArray[np.float32]
"""Float32, height x width."""
Drift = tuple[Plane, Plane]
"""How far the gel's paint has moved at each pixel, in mm: to the right, and down."""
Curve = tuple[float, ...]
"""Coefficients over x, y from -1 to 1, by rising degree: 1, x, y, x^2, xy, y^2, ..."""

WIDE: tuple[Curve, ...] = (
    (5.09, -0.02, -0.34, -1.01, -0.01, -1.45, 0.03, 0.07, 0.0, 0.2, 0.47, 0.01, 0.28, 0.02, 1.13),
    (4.88, 0.02, 0.0, -1.1, 0.06, -0.7, -0.1, 0.0, -0.11, -0.01, 0.9, -0.02, 0.15, -0.04, 0.37),
    (4.91, -0.01, 0.64, -2.07, -0.03, -2.93, 0.15, 0.07, 0.0, -0.14, 0.43, -0.03, 0.81, 0.12, 2.22),
)
"""Logarithm of the background's blue, green and red in the videos at 25 a second: fitted to their mean no-contact frame
to 1.9, 1.6 and 2.3 steps rms."""
NARROW: tuple[Curve, ...] = (
    (5.09, -0.01, -0.24, -0.48, 0.02, -0.8, 0.0, 0.03, 0.0, 0.09, 0.05, -0.02, 0.08, 0.0, 0.37),
    (4.87, 0.05, 0.01, -0.53, 0.04, -0.35, -0.11, -0.02, -0.04, 0.0, 0.17, -0.02, 0.07, 0.0, 0.07),
    (4.89, -0.01, 0.5, -1.02, -0.04, -1.72, 0.06, -0.03, 0.0, 0.08, 0.03, 0.0, 0.23, 0.06, 0.7),
)
"""The same at 10 a second, to 1.5, 1.3 and 2.4 steps: a closer crop, without the gel's rim."""
NARROW_SHARE = 0.18
GAINS: tuple[tuple[Curve, Curve], ...] = (
    ((-60, 1, -11, -17, -10, 25), (-165, -1, 144, 39, 28, 95)),
    ((-163, 40, -4, 25, 15, 22), (-6, -3, 63, 1, 10, 13)),
    ((17, -1, 0, -45, 27, -14), (239, 16, 89, -109, 14, -144)),
)
"""Gains of blue, green and red for slopes in x and in y, in 8-bit steps a unit of slope: blue comes from below, green
from the right, red from above (y points down). Directions by self-calibration: in each of 8 x 6 parts of the picture
the three differences to the reference are, but for noise, linear in two slopes, and of all such pairs of slopes only
the true one is the gradient of something, that is, without curl. That leaves their size, by assumption equal over the
picture; the absolute one is that of the egg, whose radius is known (22 mm), to about 20 %."""
DIRECT = 0.9
"""D as a share of the background: without it a tenth remains. The darkest 1e-5 of red pixels measured .14."""
TINT, SHIFT, STRENGTH = 0.015, 0.02, 0.05
"""Deviations between sensors: of each channel's brightness, of the light's centre (in half pictures), and of the gains;
the first two from four sensors told apart by their dust, the last a guess."""
SPECKS = 10
"""Dust grains on a sensor; the four show 3 to 12. Finer marks of the paint, if there are any, drown in the coding: mean
references of 41 to 136 videos show its blocks of 8 x 8 pixels and, finer than those, less than .4 %."""
SPECK_MM = (0.03, 0.07)
"""Their size, as the deviation of a Gaussian."""
RIM, RIM_RADIUS = 0.45, 0.1
"""Light beyond the gel's rounded corners, as a share, and their radius in picture heights; wide views only."""
NOISE = 1.5
"""Standard deviation of the noise from frame to frame, in 8-bit steps, before coding: with it, the real videos' own
codec needs as many bytes for the first pictures of a scene as for those of a real video."""


@dataclass(frozen=True)
class Sensor:
    """One sensor; planes are height x width in float32 and one a channel: blue, green, red."""

    glow: npt.NDArray[np.float32]
    """Height x width x BGR: the background without dust, in 8-bit steps."""
    direct: tuple[Plane, ...]
    """What the lights add to flat skin, in 8-bit steps."""
    gains: tuple[tuple[Plane, Plane], ...]
    """For slopes in x and y, in 8-bit steps."""
    dust: npt.NDArray[np.float32]
    """Height x width x 3 equal channels: the light that dust on the gel lets through, 0 to 1."""
    noise: npt.NDArray[np.float32]
    """A larger field of noise that frames are cut from, in 8-bit steps."""

    @property
    def background(self) -> npt.NDArray[np.float32]:
        """Flat skin without noise: height x width x BGR, in 8-bit steps."""
        return self.glow * self.dust


@lru_cache(maxsize=4)
def make_sensor(width: int, height: int, seed: int) -> Sensor:
    """A sensor with its own view, tints, gains, dust and noise."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    narrow = bool(rng.random() < NARROW_SHARE)
    moved = x - rng.normal(0, SHIFT), y - rng.normal(0, SHIFT)
    tints, strengths = rng.normal(1, TINT, 3), rng.normal(1, STRENGTH, 3)
    glow = np.stack(
        [np.exp(surface(c, *moved)) * t for c, t in zip(NARROW if narrow else WIDE, tints, strict=True)], -1
    )
    if not narrow:
        # How far a pixel lies beyond the rounded rectangle of the gel, in half picture heights; 1 on it, RIM beyond.
        aspect, radius = width / height, 2 * RIM_RADIUS
        over_x, over_y = np.abs(x * width / height) - aspect + radius, np.abs(y) - 1 + radius
        beyond = np.hypot(np.maximum(over_x, 0), np.maximum(over_y, 0)) - radius
        glow *= (1 - (1 - RIM) / (1 + np.exp(-np.clip((beyond - 0.023) / 0.015, -50, 50))))[..., None]
    glow = glow.astype(np.float32)
    gains = tuple(
        ((surface(across, x, y) * s).astype(np.float32), (surface(along, x, y) * s).astype(np.float32))
        for (across, along), s in zip(GAINS, strengths, strict=True)
    )
    direct = tuple(np.ascontiguousarray(plane) for plane in np.moveaxis(np.float32(DIRECT) * glow, -1, 0))
    noise = NOISE * rng.standard_normal((height + height // 2, width + width // 2, 3), dtype=np.float32)
    return Sensor(glow, direct, gains, _dust(x, y, width, rng), noise)


def shade(skin: Heights, sensor: Sensor, pitch: float, seed: int, drift: Drift | None = None) -> Image:
    """One frame, with the noise of its seed: height x width x BGR, uint8.

    The skin is the indentation in mm, of the sensor's size; only its slopes count, so a constant changes nothing. The
    pitch is in mm a pixel. Drift moves the dust on the gel; lights, camera and slopes stay where they are.
    """
    height, width = skin.shape
    slope_x = cv2.Sobel(skin, cv2.CV_32F, 1, 0, scale=1 / (8 * pitch), borderType=cv2.BORDER_REPLICATE)
    slope_y = cv2.Sobel(skin, cv2.CV_32F, 0, 1, scale=1 / (8 * pitch), borderType=cv2.BORDER_REPLICATE)
    steepness = cv2.magnitude(slope_x, slope_y)
    flatness = 1 / np.sqrt(1 + steepness * steepness)
    changes = []
    for direct, (across, along) in zip(sensor.direct, sensor.gains, strict=True):
        light = across * slope_x
        light += along * slope_y
        light += direct
        light *= flatness
        np.maximum(light, 0, out=light)
        light -= direct
        changes.append(light)
    picture = cv2.merge(changes)
    picture += sensor.glow
    dust = sensor.dust
    if drift is not None:
        # A grain seen here came from here minus its drift. The drift is smooth, so it is read here and not there.
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        from_x, from_y = x - drift[0] / np.float32(pitch), y - drift[1] / np.float32(pitch)
        # Beyond the picture there is no dust: all light passes.
        dust = cv2.remap(dust, from_x, from_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1, 1, 1))
    picture *= dust
    top, left = seed % (height // 2 + 1), (seed >> 20) % (width // 2 + 1)
    picture += sensor.noise[top : top + height, left : left + width]
    image: Image = cv2.convertScaleAbs(np.maximum(picture, 0, out=picture))
    return image


def surface(curve: Curve, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The polynomial of a `Curve` at x, y."""
    powers = [(total - down, down) for total in range(len(curve)) for down in range(total + 1)][: len(curve)]
    terms = (factor * x**across * y**down for factor, (across, down) in zip(curve, powers, strict=True))
    return sum(terms, np.zeros_like(x))


def _dust(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], width: int, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Small dark grains, round or longish, each with its own place, size, direction and darkness."""
    dust = np.ones_like(x)
    half = 9.3  # Half the width of the wide view in mm; for grains, the narrow one's is near enough.
    for _ in range(SPECKS):
        u, v = (x - rng.uniform(-1, 1)) * half, (y - rng.uniform(-1, 1)) * half * 0.75
        turn, size, longer = rng.uniform(0, np.pi), rng.uniform(*SPECK_MM), rng.choice((1.0, 1.0, 3.0))
        along, across = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
        size = max(size, 0.5 * 2 * half / width)  # No smaller than what the grid can carry.
        dust *= 1 - rng.uniform(0.1, 0.35) * np.exp(-((along / longer) ** 2 + across**2) / (2 * size**2))
    return np.repeat(dust[..., None].astype(np.float32), 3, axis=-1)
