"""Choosing how to compute a contact, and what each way gives: against the finest grid, physics' order, hard cases."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.scenes import contact
from pipeline.scenes.contact import FORCES, Body, Method, choose, press, slope_error
from pipeline.scenes.elastic.kernels import Gel
from pipeline.scenes.elastic.winkler import hang_skin, press_springs, series

SIDE, PITCH = 121, 30.0 / 121
WAYS = [Method("winkler"), Method("layer", 32), Method("layer"), Method("half_space", 64)]
FINEST = Method("layer")


def grid() -> tuple[np.ndarray, np.ndarray]:
    axis = (np.arange(SIDE) - SIDE // 2) * PITCH
    return axis[None, :], axis[:, None]


def ball(radius: float = 25.0) -> np.ndarray:
    x, y = grid()
    return (-(x * x + y * y) / (2 * radius)).astype(np.float32)


def rough(rms: float, seed: int = 0) -> np.ndarray:
    """A ball with Gaussian noise of two pixels."""
    noise = np.random.default_rng(seed).standard_normal((SIDE, SIDE))
    spectrum = np.exp(-(np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None]) ** 2) * 60)
    noise = np.fft.irfft2(np.fft.rfft2(noise) * spectrum, s=(SIDE, SIDE))
    return (ball() + rms * noise / noise.std()).astype(np.float32)


def bumpy() -> np.ndarray:
    x, y = grid()
    return (ball() + 0.15 * (np.cos(2 * np.pi * x / 3) * np.cos(2 * np.pi * y / 3) - 1)).astype(np.float32)


BODIES = {"ball": ball(), "rough": rough(0.02), "bumpy": bumpy(), "flat": np.zeros((SIDE, SIDE), np.float32)}


@pytest.mark.parametrize("body", BODIES)
def test_finer_grids_come_nearer_to_every_pixel(body: str) -> None:
    pressed = Body(BODIES[body], 5.0, PITCH)
    truth = pressed.press(FINEST, np.array([8.0])).skins[0]
    errors = [
        slope_error(pressed.press(Method("layer", cells), np.array([8.0])).skins[0], truth, PITCH)
        for cells in (32, 64, 96)
    ]
    assert errors[-1] < 0.06, errors
    assert errors[-1] <= errors[0]


def test_fine_relief_is_pressed_in_where_it_is_flattened() -> None:
    """In full contact, gel and object share short waves by their moduli, as the solver finds at all pixels."""
    x, y = grid()
    wave = 0.004 * np.cos(2 * np.pi * x / 0.9) * np.cos(2 * np.pi * y / 0.9)
    flat_ball = (ball(200.0) + wave).astype(np.float32)
    body = Body(flat_ball, 0.25, PITCH)
    middle = slice(SIDE // 2 - 20, SIDE // 2 + 20)

    def amplitude(method: Method) -> float:
        skin = body.press(method, np.array([60.0])).skins[0][middle, middle]
        pattern = wave[middle, middle]
        return float((skin * pattern).sum() / (pattern * pattern).sum())

    assert amplitude(Method("layer", 30)) == pytest.approx(0.5, rel=0.05)
    assert amplitude(FINEST) == pytest.approx(0.5, rel=0.05)


def test_auto_keeps_what_it_promises() -> None:
    for heights, modulus, tolerance in itertools.product(BODIES.values(), (0.05, 5.0), (0.1, 0.3)):
        body = Body(heights, modulus, PITCH)
        method, error, pressed = choose(body, 8.0, tolerance)
        truth = body.press(FINEST, np.array([8.0])).skins[0]
        assert slope_error(pressed.skins[0], truth, PITCH) <= 1.3 * tolerance
        assert error <= tolerance or method == FINEST


def test_auto_spends_more_on_a_tighter_tolerance_and_less_on_a_plain_body() -> None:
    def cells(heights: np.ndarray, tolerance: float) -> int:
        method, _, _ = choose(Body(heights, 5.0, PITCH), 8.0, tolerance)
        return 0 if method.tier == "winkler" else method.cells or SIDE

    for heights in BODIES.values():
        assert cells(heights, 0.02) >= cells(heights, 0.2) >= cells(heights, 1.0)
    assert cells(bumpy(), 0.1) > cells(np.zeros_like(ball()), 0.1)
    method, error, _ = choose(Body(np.zeros((SIDE, SIDE), np.float32), 0.05, PITCH), 0.5, 0.2)
    assert method == Method("winkler")
    assert error < 0.2


def test_where_one_grid_alone_is_fine_enough_it_is_held_against_all_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact, "LADDER", (Method("layer", 32),))
    method, error, _ = choose(Body(bumpy(), 5.0, PITCH), 8.0, 1e-6)
    assert method == FINEST
    assert error > 0, "an estimate, and not the nothing that it was held against"


@pytest.mark.parametrize("method", [WAYS[0], WAYS[1], WAYS[3]], ids=str)
def test_harder_objects_and_larger_forces_press_deeper(method: Method) -> None:
    depths = [float(press(bumpy(), 8.0, modulus, PITCH, method).skins[-1].max()) for modulus in (0.03, 0.1, 0.5, 50)]
    assert all(less < more for less, more in itertools.pairwise(depths))
    assert not press(bumpy(), 0.0, 1.0, PITCH, method).skins.any()
    imprint = press(bumpy(), 8.0, 1.0, PITCH, method)
    assert imprint.skins.shape == (FORCES + 1, SIDE, SIDE)
    assert imprint.skins.dtype == np.float32
    assert all(a < b for a, b in itertools.pairwise(s.max() for s in imprint.skins))
    assert all(a <= b for a, b in itertools.pairwise(imprint.radii))


def test_frames_between_two_forces_are_near_what_pressing_gives() -> None:
    imprint = press(bumpy(), 8.0, 1.0, PITCH, FINEST)
    body = Body(bumpy(), 1.0, PITCH)
    for force, bound in ((0.8, 0.3), (2.0, 0.12), (5.5, 0.1)):
        direct = body.press(FINEST, np.array([force])).skins[0]
        assert slope_error(imprint.at(force), direct, PITCH) < bound
    np.testing.assert_array_equal(imprint.at(8.0), imprint.skins[-1])
    np.testing.assert_array_equal(imprint.at(800.0), imprint.skins[-1])
    assert not imprint.at(0.0).any()
    assert imprint.radius(0.0) == 0
    assert imprint.radius(8.0) == pytest.approx(imprint.radii[-1])


# --- Hard cases


def test_a_contact_over_the_whole_patch() -> None:
    imprint = press(ball(3000.0), 50.0, 0.03, PITCH)
    assert imprint.radii[-1] == pytest.approx(30 / np.sqrt(np.pi), rel=0.01)


# --- Springs


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(sorted(BODIES)), st.floats(1e-3, 1e4), st.floats(1e-4, 1e4))
def test_springs_carry_the_force(body: str, force: float, modulus: float) -> None:
    gel, heights = Gel(), BODIES[body]
    springs = press_springs(heights.max() - heights, force, modulus, PITCH, gel)
    together = 1 / (1 / gel.modulus + 1 / modulus)
    assert series(gel.modulus, modulus) == pytest.approx(together)
    pressure = together / gel.thickness * springs.overlap.astype(np.float64)
    assert pressure.sum() * PITCH**2 == pytest.approx(force, rel=0.01)
    assert np.isfinite(hang_skin(springs, modulus, PITCH, gel)).all()


def test_a_ball_on_springs_follows_theory() -> None:
    """F = pi E* R d^2 / t for a paraboloid (Johnson, Contact Mechanics, 4.3), as long as it fits the grid."""
    pitch, force, radius, gel = 0.02, 0.2, 20.0, Gel()
    axis = (np.arange(501) - 250) * pitch
    gap = ((axis[None] ** 2 + axis[:, None] ** 2) / (2 * radius)).astype(np.float32)
    springs = press_springs(gap, force, 1.0, pitch, gel)
    stiffness = series(gel.modulus, 1.0) / gel.thickness
    assert springs.approach == pytest.approx(np.sqrt(force / (np.pi * stiffness * radius)), rel=2e-3)
    assert np.count_nonzero(springs.overlap) * pitch**2 == pytest.approx(
        2 * np.pi * radius * springs.approach, rel=0.01
    )
