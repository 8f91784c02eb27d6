"""Pressures under pressed bodies: Hertz's approach, contact where there is no gap, and stopping early."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.scenes.elastic.kernels import Gel, Kernel, half_space_table, layer_table, make_kernel
from pipeline.scenes.elastic.solver import NotConverged, solve

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
