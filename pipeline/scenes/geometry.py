"""The surface that is pressed: a curved body with bumps and grain, as heights in mm on a square grid.

Heights point towards the sensor. Everything is given in mm and sampled at a pitch (mm a pixel), so that a scene is
the same at every resolution, down to what the grid can carry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

Heights = npt.NDArray[np.float32]
Plane = npt.NDArray[np.float64]
BumpShape = Literal["domes", "ridges", "weave"]

IMAGE_MM = (18.6, 14.3)
"""Width and height of what the camera sees (data sheet of the GelSight Mini)."""
HURST = 0.8
"""Hurst exponent of the grain; usual for worn and broken surfaces (Persson et al., J. Phys.: Condens. Matter 2005)."""
JITTER = 0.3
"""How far domes stray from their lattice, as a share of the gap between them."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Statistics of a surface; lengths in mm."""

    radii: tuple[float, float]
    """Radii of curvature of the body, across and along."""
    bump_shape: BumpShape
    bump_width: float
    """0 for none."""
    bump_height: float
    bump_spacing: float
    """Between the centres of neighbours."""
    grain: float
    """Root mean square height of the roughness."""
    grain_length: float
    """Its longest wavelength."""


def heights(surface: Surface, side: int, pitch: float, rng: np.random.Generator) -> Heights:
    """A random patch of the surface, side x side: body + bumps + grain."""
    axis = (np.arange(side) - (side - 1) / 2) * pitch
    x, y = np.meshgrid(axis, axis)
    total = body(x, y, surface.radii) + grain(side, pitch, surface.grain, surface.grain_length, rng)
    if surface.bump_width > 0:
        total += surface.bump_height * bumps(x, y, surface, rng)
    return total.astype(np.float32)


def body(x: Plane, y: Plane, radii: tuple[float, float]) -> Plane:
    """The paraboloid -x^2 / 2 Rx - y^2 / 2 Ry that touches a body of these radii (Johnson, Contact Mechanics, 4.1)."""
    return -x * x / (2 * radii[0]) - y * y / (2 * radii[1])


def bumps(x: Plane, y: Plane, surface: Surface, rng: np.random.Generator) -> Plane:
    """Bumps of height 1 in a random place and direction.

    `domes`: caps of the bumps' width on a jittered hexagonal lattice. `ridges`: the same profile along lines.
    `weave`: two crossing families of threads, each on top where the other is below.
    """
    turn, phase = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
    spacing, half = surface.bump_spacing, surface.bump_width / 2
    u = x * np.cos(turn) + y * np.sin(turn) + rng.uniform(0, spacing)
    v = y * np.cos(turn) - x * np.sin(turn) + rng.uniform(0, spacing)
    if surface.bump_shape == "ridges":
        return _cap(u - np.round(u / spacing) * spacing, half)
    if surface.bump_shape == "weave":
        # Threads of width `bump_width`, side by side; a thread dives under every second one that it crosses.
        a, b = np.pi * u / surface.bump_width, np.pi * v / surface.bump_width
        over = np.sin(a) * np.sin(b)
        woven: Plane = np.maximum(np.abs(np.sin(a)) * (1 + over), np.abs(np.sin(b)) * (1 - over)) / 2
        return woven
    rise = spacing * np.sqrt(3) / 2
    result = np.zeros_like(x)
    for step in (-1, 0, 1):  # A point may lie under a cap of its own row of the lattice or of a row beside it.
        row = np.round(v / rise) + step
        shifted = u - np.mod(row, 2) * spacing / 2
        column = np.round(shifted / spacing)
        chance = np.mod(np.sin(row * 12.9898 + column * 78.233 + phase) * 43758.5453, 1.0)  # A hash of the place.
        across = shifted - column * spacing - (chance - 0.5) * JITTER * (spacing - surface.bump_width)
        result = np.maximum(result, (0.8 + 0.2 * chance) * _cap(np.hypot(across, v - row * rise), half))
    return result


def grain(side: int, pitch: float, rms: float, longest: float, rng: np.random.Generator) -> Plane:
    """A self-affine random field: amplitude ~ q^-(1 + H) for wavelengths up to `longest`, none beyond, H = `HURST`.

    White noise filtered by FFT and scaled to a root mean square of `rms`; zeros where the grid carries no such wave.
    """
    qx, qy = np.fft.rfftfreq(side, pitch)[None, :], np.fft.fftfreq(side, pitch)[:, None]
    q = np.hypot(qx, qy)
    amplitude = np.where(q * longest >= 1, np.maximum(q, 1 / longest) ** -(1 + HURST), 0.0)
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) * amplitude, s=(side, side))
    spread = float(field.std())
    return field * (rms / spread) if spread > 0 else field


def _cap(distance: Plane, half: float) -> Plane:
    """A smooth bump of half-width `half`: cos^2(pi r / 2 half), 0 outside."""
    return np.cos(np.minimum(np.abs(distance) / half, 1.0) * (np.pi / 2)) ** 2
