"""Pressures under pressed bodies: Hertz, energies, symmetry, and the cases in which solvers break."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.scenes.elastic.kernels import Gel, Kernel, half_space_table, layer_table, make_kernel
from pipeline.scenes.elastic.solver import NotConverged, solve

RADIUS, MODULUS = 10.0, 1.0


def grid(side: int, pitch: float) -> list[np.ndarray]:
    return np.meshgrid(*[(np.arange(side) - (side - 1) / 2) * pitch] * 2)


def ball(side: int, pitch: float, radius: float = RADIUS) -> np.ndarray:
    x, y = grid(side, pitch)
    return (x * x + y * y) / (2 * radius)


def half_space(side: int, pitch: float, dtype: type = np.float64) -> Kernel:
    return make_kernel(half_space_table((side, side), pitch, MODULUS), dtype)


def hertz(force: float) -> tuple[float, float, float]:
    """Contact radius a, approach a^2/R and peak pressure 3F / 2 pi a^2 of a ball (Johnson, 4.2)."""
    a = (3 * force * RADIUS / (4 * MODULUS)) ** (1 / 3)
    return a, a * a / RADIUS, 3 * force / (2 * np.pi * a * a)


@pytest.mark.filterwarnings("error")
def test_a_ball_as_hertz_has_it() -> None:
    force = 1.0
    a, approach, peak = hertz(force)
    pitch = 2.6 * a / 128
    solution = solve(ball(128, pitch), force, half_space(128, pitch), pitch, tolerance=1e-8)
    pressure = solution.pressure[0]
    assert pressure.sum() * pitch**2 == pytest.approx(force, rel=1e-12)
    # F grows as approach^(3/2): at the approach found, Hertz's force is off by 3/2 of the approach's error.
    assert (solution.approach[0] / approach) ** 1.5 == pytest.approx(1, abs=1e-3)
    assert pressure.max() == pytest.approx(peak, rel=1e-3)
    assert np.sqrt((pressure > 0).sum() * pitch**2 / np.pi) == pytest.approx(a, rel=5e-3)
    x, y = grid(128, pitch)
    exact = peak * np.sqrt(np.maximum(1 - (x * x + y * y) / a**2, 0))
    inside = np.hypot(x, y) < 0.9 * a
    np.testing.assert_allclose(pressure[inside], exact[inside], rtol=5e-3)


def test_the_pipelines_default_grid_is_within_a_thousandth_in_force() -> None:
    """256 cells over 30 mm, a ball of 10 mm and forces as in a video, at the residual that scenes are solved to."""
    pitch, forces = 30.5 / 256, np.array([4.0, 12.0])
    gap, kernel = ball(256, pitch).astype(np.float32), half_space(256, pitch, np.float32)
    found = solve(gap, forces, kernel, pitch, tolerance=0.03 / 256).approach
    expected = [hertz(force)[1] for force in forces]
    np.testing.assert_allclose((found / expected) ** 1.5, 1, atol=1e-3)


def test_energies_agree() -> None:
    """Half of pressure times sink, plus nothing else, is the work of the force: the integral of F d(approach)."""
    side, pitch = 48, 0.13
    x, y = grid(side, pitch)
    gap = ball(side, pitch) + 0.02 * (1 - np.cos(2 * np.pi * x / 1.3) * np.cos(2 * np.pi * y / 1.3))
    gap -= gap.min()
    kernel = make_kernel(layer_table((side, side), pitch, Gel(modulus=MODULUS, thickness=1.5)))
    forces = 2.0 * np.linspace(0, 1, 31)[1:] ** 2
    found = solve(gap, forces, kernel, pitch, tolerance=1e-9)
    stored = 0.5 * float((found.pressure[-1] * kernel.sink(found.pressure)[-1]).sum()) * pitch**2
    work = np.trapezoid(np.concatenate([[0], forces]), np.concatenate([[0], found.approach]))
    assert stored == pytest.approx(work, rel=2e-3)


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
    assert (opening > -1e-5 * size).all()
    assert (np.abs(opening[found.pressure > 0]) < 1e-4 * size.max()).all()


def test_moving_and_turning_the_body_moves_and_turns_the_pressure() -> None:
    x, y = grid(64, 0.1)
    gap = (x - 0.4) ** 2 / 10 + (y + 0.3) ** 2 / 30 + 0.01 * (1 + np.cos(7 * x + 2 * y))

    def pressure(gap: np.ndarray) -> np.ndarray:
        return solve(gap.copy(), 0.2, half_space(64, 0.1), 0.1, tolerance=1e-10).pressure[0]

    first = pressure(gap)
    for change in (np.rot90, lambda picture: np.roll(picture, 3, axis=1)):
        np.testing.assert_allclose(change(first), pressure(change(gap)), atol=1e-3 * first.max())


def test_contacts_solved_together_are_those_solved_alone() -> None:
    side, pitch = 48, 0.12
    kernel, gaps = half_space(side, pitch), np.stack([ball(side, pitch, r) for r in (5.0, 10.0, 40.0)])
    forces = [0.5, 0.0, 2.0]
    together = solve(gaps, forces, kernel, pitch).pressure
    for gap, force, found in zip(gaps, forces, together, strict=True):
        np.testing.assert_allclose(found, solve(gap, force, kernel, pitch).pressure[0], atol=1e-12)


def test_stopping_early_is_said_with_the_residual() -> None:
    side, pitch = 32, 0.2
    with pytest.warns(NotConverged, match=r"under 3 N has not converged within 2 iterations: residual \d"):
        found = solve(ball(side, pitch), [0.0, 3.0], half_space(side, pitch), pitch, tolerance=1e-9, iterations=2)
    assert found.converged.tolist() == [True, False]
    assert found.residual[1] > 1e-9
    assert found.pressure[1].sum() * pitch**2 == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("force", "gap", "words"),
    [*((force, 0.0, "forces must be") for force in (-1.0, np.nan, np.inf)), (1.0, np.nan, "gap")],
)
def test_impossible_forces_and_gaps_are_refused(force: float, gap: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        solve(ball(8, 1.0) + gap, force, half_space(8, 1.0), 1.0)
