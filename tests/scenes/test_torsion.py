"""A twist that sticks: when it slips, and the field around it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import j1, spherical_jn

from pipeline.scenes.elastic.torsion import FRICTION, share_of_turn, slip_turn, twist


@pytest.mark.parametrize("ratio", [0.3, 0.9, 1.2, 2.0, 5.0])
def test_the_field_is_its_hankel_transform(ratio: float) -> None:
    """u(r) / (theta r): the integral of (4 / pi) sph_j1(k) J1(kr) dk over r, the mixed problem's other form; a = 1."""
    step = 4e-3
    k = np.arange(step / 2, 4000, step)
    fade = np.exp(-((k / 1500) ** 2))
    integral = float(np.sum(4 / math.pi * spherical_jn(1, k) * j1(k * ratio) * fade) * step)
    assert float(share_of_turn(ratio, 1.0)) == pytest.approx(integral / ratio, abs=2e-3)


@given(st.floats(0, 1e6), st.floats(0, 1e3))
def test_the_share_is_one_inside_and_falls_outside(distance: float, radius: float) -> None:
    """Far away it is that of a point torque: u = T / (4 pi G r^2), so that the share is 4 a^3 / (3 pi r^3)."""
    share = float(share_of_turn(distance, radius))
    assert 0 <= share <= 1 + 1e-12
    if radius > 0 and distance <= radius:
        assert share == pytest.approx(1)
    assert share >= float(share_of_turn(distance * 1.5 + 1e-9, radius)) - 1e-12
    for far in (30.0, 300.0, 3e5):
        assert float(share_of_turn(far, 1.0)) == pytest.approx(4 / (3 * math.pi * far**3), rel=1e-3)


def test_the_surface_turns_with_the_object_inside_and_stays_far_away() -> None:
    shape, centre, pitch = (121, 161), (70.0, 55.0), 0.1
    dx, dy = twist(shape, centre, 2.0, math.radians(30), pitch)
    assert dx.shape == dy.shape == shape
    x, y = (np.arange(161)[None, :] - centre[0]) * pitch, (np.arange(121)[:, None] - centre[1]) * pitch
    distance = np.hypot(x, y)
    # The point that is at (x, y) now was at (x - dx, y - dy): as far from the axis, and turned back by 30 degrees.
    was = np.hypot(x - dx, y - dy)
    np.testing.assert_allclose(was, distance, atol=1e-5)
    inside = (distance < 1.9) & (distance > 0.2)
    angle = np.degrees(np.arctan2(y, x) - np.arctan2(y - dy, x - dx))
    np.testing.assert_allclose((angle[inside] + 180) % 360 - 180, 30, atol=0.05)
    assert np.hypot(dx, dy)[distance > 8].max() < 0.1
    for radius, turn in ((2.0, 0.0), (0.0, 0.5)):
        assert np.abs(twist(shape, centre, radius, turn, pitch)).max() < 1e-6, "no turn or no contact moves nothing"


def test_a_contact_slips_where_friction_ends() -> None:
    """Where the torque of the stresses under a stuck disc (Johnson, 3.9) is that of mu p r over Hertz's pressure."""
    force, a, shear = 3.0, 4.0, 0.065
    peak = 3 * force / (2 * math.pi * a * a)
    carried, _ = quad(lambda r: FRICTION * peak * math.sqrt(1 - (r / a) ** 2) * 2 * math.pi * r * r, 0, a)
    # tau = (4 G theta / pi) r / sqrt(a^2 - r^2); r = a sin(s) takes the singular edge out of the integral.
    turn = slip_turn(force, a, shear)
    stuck, _ = quad(lambda s: 2 * math.pi * (4 * shear * turn / math.pi) * (a * math.sin(s)) ** 3, 0, math.pi / 2)
    assert stuck == pytest.approx(carried, rel=1e-8)
    assert slip_turn(force, 0.0, shear) == 0
