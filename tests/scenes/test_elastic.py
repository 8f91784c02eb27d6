"""How surfaces sink, are pressed and turn: against closed solutions, direct integration and each other's limits."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import dblquad, quad
from scipy.special import j1, spherical_jn

from pipeline.scenes.elastic.kernels import Gel, Kernel, half_space_table, layer_response, layer_table, make_kernel
from pipeline.scenes.elastic.solver import NotConverged, solve
from pipeline.scenes.elastic.torsion import FRICTION, share_of_turn, slip_turn, twist


def test_a_pixel_sinks_by_the_integral_of_boussinesq() -> None:
    """u = 1 / (pi E*) times the integral of dA / r (Johnson, 3.2); far away u = F / (pi E* r)."""
    table = half_space_table((6, 6), pitch=1.0, modulus=1.0)
    assert table[0, 0] == pytest.approx(4 * math.log(1 + math.sqrt(2)) / math.pi, rel=1e-12)
    for row, column in ((0, 1), (2, 0), (3, 4)):
        sides = column - 0.5, column + 0.5, row - 0.5, row + 0.5
        direct, _ = dblquad(lambda y, x: 1 / (math.pi * math.hypot(x, y)), *sides)
        assert table[row, column] == pytest.approx(direct, rel=1e-9)
    far = half_space_table((901, 4), pitch=0.1, modulus=2.0)
    for offset, bound in ((10, 1e-3), (100, 1e-5), (900, 1e-6)):
        assert far[offset, 0] == pytest.approx(0.1**2 / (math.pi * 2.0 * 0.1 * offset), rel=bound)


@given(st.floats(0, 1e4), st.floats(0, 0.5))
def test_a_layers_response_is_between_springs_and_half_space(wave: float, poisson: float) -> None:
    """It may overshoot a half-space by little where its sides bulge."""
    response = float(layer_response(wave, poisson))
    assert 0 <= response <= 1.1
    if wave > 25:
        assert response == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.48])
def test_to_long_waves_a_layer_is_springs(poisson: float) -> None:
    """p = M c / t with the modulus M = E (1 - nu) / ((1 + nu)(1 - 2 nu)) of a layer that cannot widen; E* = 1."""
    k, young = 1e-4, 1 - poisson**2
    oedometric = young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    assert 2 * float(layer_response(k, poisson)) / k == pytest.approx(1 / oedometric, rel=1e-6)


def test_the_series_meets_the_formula() -> None:
    for poisson in (0.0, 0.3, 0.48, 0.5):
        below, above = layer_response(np.array([0.1 - 1e-9, 0.1 + 1e-9]), poisson)
        assert below == pytest.approx(above, rel=1e-6)
    # Without change of volume the response begins with the cube: S -> 2 k^3 / 3 (Johnson, 5.8: thin, nu = .5).
    assert float(layer_response(1e-5, 0.5)) == pytest.approx(2 / 3 * 1e-15, rel=1e-6)


def test_a_wave_of_pressure_sinks_as_the_transform_says() -> None:
    """In the middle of a wide field, away from its ends: u = 2 S(qt) / (E* q) p."""
    side, pitch = 192, 0.2
    gel = Gel(modulus=0.5, poisson=0.45, thickness=2.0)
    x = (np.arange(side) - side // 2) * pitch
    for length in (3.0, 6.0):
        wave = np.cos(2 * np.pi * x / length)[None, :] * np.ones((side, 1))
        sink = make_kernel(layer_table((side, side), pitch, gel)).sink(wave)[side // 2]
        q = 2 * np.pi / length
        expected = 2 * float(layer_response(q * gel.thickness, gel.poisson)) / (gel.modulus * q)
        inside = np.abs(x) < 6
        np.testing.assert_allclose(sink[inside], expected * wave[0][inside], atol=0.01 * expected)


def test_convolution_is_the_direct_sum() -> None:
    rng = np.random.default_rng(0)
    table, pressure = half_space_table((7, 9), 0.3, 1.5), rng.random((2, 7, 9))
    rows, columns = (np.abs(np.subtract.outer(np.arange(n), np.arange(n))) for n in table.shape)
    # Of pixels (i, j) and (k, m) the offsets are |i - k| and |j - m|.
    direct = np.einsum("ikjm,nkm->nij", table[rows[:, :, None, None], columns], pressure)
    for dtype, bound in ((np.float64, 1e-12), (np.float32, 2e-6)):
        found = make_kernel(table, dtype).sink(pressure.astype(dtype))
        assert found.dtype == dtype
        np.testing.assert_allclose(found, direct, rtol=bound)


RADIUS, MODULUS = 10.0, 1.0


def ball(side: int, pitch: float) -> np.ndarray:
    x, y = np.meshgrid(*[(np.arange(side) - (side - 1) / 2) * pitch] * 2)
    return (x * x + y * y) / (2 * RADIUS)


def half_space(side: int, pitch: float, dtype: type = np.float64) -> Kernel:
    return make_kernel(half_space_table((side, side), pitch, MODULUS), dtype)


def hertz(force: float) -> float:
    """Approach a^2/R of a ball, a being the contact's radius (Johnson, 4.2)."""
    a: float = (3 * force * RADIUS / (4 * MODULUS)) ** (1 / 3)
    return a * a / RADIUS


def test_the_pipelines_default_grid_is_within_a_thousandth_in_force() -> None:
    """256 cells over 30 mm, a ball of 10 mm and forces as in a video, at the residual that scenes are solved to."""
    pitch, forces = 30.5 / 256, np.array([4.0, 12.0])
    gap, kernel = ball(256, pitch).astype(np.float32), half_space(256, pitch, np.float32)
    found = solve(gap, forces, kernel, pitch, tolerance=0.03 / 256).approach
    expected = [hertz(force) for force in forces]
    # F grows as approach^(3/2): at the approach found, Hertz's force is off by 3/2 of the approach's error.
    np.testing.assert_allclose((found / expected) ** 1.5, 1, atol=1e-3)


@pytest.mark.parametrize("thickness", [0.5, 3.0, None])
def test_pressure_and_gap_exclude_each_other(thickness: float | None) -> None:
    side, pitch = 48, 0.2
    gap = ball(side, pitch) + 0.02 * np.random.default_rng(2).random((side, side))
    kernel = half_space(side, pitch)
    if thickness:
        kernel = make_kernel(layer_table((side, side), pitch, Gel(modulus=1.0, thickness=thickness)))
    found = solve(gap, [0.3, 3.0, 30.0], kernel, pitch, tolerance=1e-10)
    size = found.approach[:, None, None]
    opening = gap + kernel.sink(found.pressure) - size
    assert found.converged.all()
    assert (found.pressure >= 0).all()
    assert found.pressure.sum(axis=(1, 2)) * pitch**2 == pytest.approx([0.3, 3.0, 30.0])
    assert (opening > -1e-5 * size).all()
    assert (np.abs(opening[found.pressure > 0]) < 1e-4 * size.max()).all()


def test_stopping_early_is_said_with_the_residual() -> None:
    side, pitch = 32, 0.2
    with pytest.warns(NotConverged, match=r"under 3 N has not converged within 2 iterations: residual \d"):
        found = solve(ball(side, pitch), [0.0, 3.0], half_space(side, pitch), pitch, tolerance=1e-9, iterations=2)
    assert found.converged.tolist() == [True, False]
    assert found.residual[1] > 1e-9
    assert found.pressure[1].sum() * pitch**2 == pytest.approx(3.0)


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
