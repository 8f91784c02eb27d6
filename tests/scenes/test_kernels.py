"""How surfaces sink: against closed solutions, direct integration and each other's limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import dblquad

from pipeline.scenes.elastic.kernels import Gel, half_space_table, layer_response, layer_table, make_kernel


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
