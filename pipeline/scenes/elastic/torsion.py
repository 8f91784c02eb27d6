"""What a twist does to the gel around a contact that sticks.

A rigid disc of radius a that is glued to a half-space and turned by an angle carries its surface along; outside, the
angle fades as (2/pi) [asin(a/r) - (a/r) sqrt(1 - a^2/r^2)] (Reissner & Sagoci 1944; Johnson, Contact Mechanics, 3.9).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pipeline.scenes.grid import Heights

FRICTION = 1.0
"""Coefficient of friction of the gel; soft rubber on dry solids has about that."""


def share_of_turn(distance: npt.ArrayLike, radius: float) -> npt.NDArray[np.float64]:
    """How much of the disc's turn the surface makes at a distance from its axis: 1 under the disc, 0 far away."""
    if radius <= 0:
        return np.zeros(np.shape(distance))
    ratio = radius / np.maximum(np.asarray(distance, dtype=np.float64), radius)
    # asin(x) - x sqrt(1 - x^2) loses its digits for small x, where it is 2 x^3 / 3 + x^5 / 5 to within x^7.
    near = np.arcsin(ratio) - ratio * np.sqrt(1 - ratio * ratio)
    return np.where(ratio > 1e-2, near, 2 * ratio**3 / 3 + ratio**5 / 5) * (2 / np.pi)


def slip_turn(force: float, radius: float, shear_modulus: float) -> float:
    """The turn in radians at which a ball's contact slips as a whole: the torque of friction over the stiffness.

    Friction under Hertz's pressure carries 3 pi / 16 mu F a (Lubkin 1951; Johnson, 7.4); a radian takes 16/3 G a^3
    (Johnson, 3.112). In N, mm and MPa.
    """
    return 3 * math.pi / 16 * FRICTION * force * radius / (16 / 3 * shear_modulus * radius**3) if radius > 0 else 0.0


def twist(
    shape: tuple[int, int], centre: tuple[float, float], radius: float, radians: float, pitch: float
) -> tuple[Heights, Heights]:
    """How far the gel's surface has moved, in mm: across and down, each of this shape (rows x columns).

    The object has turned by so many radians while it sticks, positive from the x axis to the y axis; the turn may be
    large, as every point stays at its distance from the axis. The contact's centre (column, row) is in pixels, its
    radius in mm, the pitch in mm a pixel.
    """
    x = (np.arange(shape[1], dtype=np.float64)[None, :] - centre[0]) * pitch
    y = (np.arange(shape[0], dtype=np.float64)[:, None] - centre[1]) * pitch
    distance = np.hypot(x, y)
    # The share is a function of the distance alone: a table of it is exact to 1e-6 and a tenth of the work.
    table = np.linspace(0, float(distance.max()) + pitch, 2048)
    turn = radians * np.interp(distance, table, share_of_turn(table, radius))
    # What is at (x, y) now came from there turned back.
    cosine, sine = np.cos(turn), np.sin(turn)
    return (x - (cosine * x + sine * y)).astype(np.float32), (y - (cosine * y - sine * x)).astype(np.float32)
