"""Choosing how to compute a contact, and what each way gives: against the finest grid, physics' order, hard cases."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from pipeline.scenes import contact
from pipeline.scenes.contact import FORCES, Method, choose, press, press_by, slope_error
from pipeline.scenes.elastic.kernels import Gel
from pipeline.scenes.elastic.winkler import hang_skin, press_springs, series

SIDE, PITCH = 121, 30.0 / 121
FINEST = Method("layer")


X, Y = np.meshgrid(*[(np.arange(SIDE) - SIDE // 2) * PITCH] * 2)


def ball(radius: float = 25.0) -> np.ndarray:
    return (-(X * X + Y * Y) / (2 * radius)).astype(np.float32)


def rough() -> np.ndarray:
    """A ball with Gaussian noise of two pixels."""
    noise = gaussian_filter(np.random.default_rng(0).standard_normal((SIDE, SIDE)), 2, mode="wrap")
    return (ball() + 0.02 * noise / noise.std()).astype(np.float32)


BUMPY = (ball() + 0.15 * (np.cos(2 * np.pi * X / 3) * np.cos(2 * np.pi * Y / 3) - 1)).astype(np.float32)
BODIES = {"ball": ball(), "rough": rough(), "bumpy": BUMPY, "flat": np.zeros((SIDE, SIDE), np.float32)}


def skin_of(heights: np.ndarray, method: Method, force: float = 8.0, modulus: float = 5.0) -> np.ndarray:
    return press_by(method, heights, np.array([force]), modulus, PITCH).skins[0]


@pytest.mark.parametrize("body", BODIES)
def test_finer_grids_come_nearer_to_every_pixel(body: str) -> None:
    truth = skin_of(BODIES[body], FINEST)
    coarse, fine = (slope_error(skin_of(BODIES[body], Method("layer", c)), truth, PITCH) for c in (32, 96))
    assert fine < 0.06
    assert fine <= coarse


@pytest.mark.parametrize("method", [Method("layer", 30), FINEST], ids=str)
def test_fine_relief_is_pressed_in_where_it_is_flattened(method: Method) -> None:
    """In full contact, gel and object share short waves by their moduli, as the solver finds at all pixels."""
    wave = 0.004 * np.cos(2 * np.pi * X / 0.9) * np.cos(2 * np.pi * Y / 0.9)
    middle = (slice(SIDE // 2 - 20, SIDE // 2 + 20),) * 2
    skin, pattern = skin_of((ball(200.0) + wave).astype(np.float32), method, 60.0, 0.25)[middle], wave[middle]
    assert (skin * pattern).sum() / (pattern * pattern).sum() == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize("modulus", [0.05, 5.0])
@pytest.mark.parametrize("body", BODIES)
def test_auto_keeps_what_it_promises(body: str, modulus: float) -> None:
    truth = skin_of(BODIES[body], FINEST, modulus=modulus)
    for tolerance in (0.1, 0.3):
        method, error, pressed = choose(BODIES[body], 8.0, modulus, PITCH, tolerance)
        assert slope_error(pressed.skins[0], truth, PITCH) <= 1.3 * tolerance
        assert error <= tolerance or method == FINEST


def test_auto_spends_more_on_a_tighter_tolerance_and_less_on_a_plain_body() -> None:
    tight, loose = (choose(BUMPY, 8.0, 5.0, PITCH, tolerance)[0].cells or SIDE for tolerance in (0.02, 0.2))
    assert tight > loose
    method, error, _ = choose(BODIES["flat"], 0.5, 0.05, PITCH, 0.2)
    assert method == Method("winkler")
    assert error < 0.2


def test_where_one_grid_alone_is_fine_enough_it_is_held_against_all_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact, "LADDER", (Method("layer", 32),))
    method, error, _ = choose(BUMPY, 8.0, 5.0, PITCH, 1e-6)
    assert method == FINEST
    assert error > 0, "an estimate, and not the nothing that it was held against"


@pytest.mark.parametrize("method", [Method("winkler"), Method("layer", 32), Method("half_space", 64)], ids=str)
def test_harder_objects_and_larger_forces_press_deeper(method: Method) -> None:
    depths = [press(BUMPY, 8.0, modulus, PITCH, method).skins[-1].max() for modulus in (0.03, 0.1, 0.5, 50)]
    imprint = press(BUMPY, 8.0, 1.0, PITCH, method)
    for rising in (depths, [skin.max() for skin in imprint.skins]):
        assert all(less < more for less, more in itertools.pairwise(rising))
    assert all(less <= more for less, more in itertools.pairwise(imprint.radii))
    assert (imprint.skins.shape, imprint.skins.dtype) == ((FORCES + 1, SIDE, SIDE), np.float32)
    assert not press(BUMPY, 0.0, 1.0, PITCH, method).skins.any()
    # A contact over the whole patch.
    assert press(ball(3000.0), 50.0, 0.03, PITCH).radii[-1] == pytest.approx(30 / np.sqrt(np.pi), rel=0.01)


def test_frames_between_two_forces_are_near_what_pressing_gives() -> None:
    imprint = press(BUMPY, 8.0, 1.0, PITCH, FINEST)
    for force, bound in ((0.8, 0.3), (2.0, 0.12), (5.5, 0.1)):
        assert slope_error(imprint.at(force), skin_of(BUMPY, FINEST, force, 1.0), PITCH) < bound
    for force in (8.0, 800.0):
        np.testing.assert_array_equal(imprint.at(force), imprint.skins[-1])
    assert not imprint.at(0.0).any()
    assert (imprint.radius(0.0), imprint.radius(8.0)) == (0, pytest.approx(imprint.radii[-1]))


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(sorted(BODIES)), st.floats(1e-3, 1e4), st.floats(1e-4, 1e4))
def test_springs_carry_the_force(body: str, force: float, modulus: float) -> None:
    gel, heights = Gel(), BODIES[body]
    overlap = press_springs(heights.max() - heights, force, modulus, PITCH, gel)
    together = 1 / (1 / gel.modulus + 1 / modulus)
    assert series(gel.modulus, modulus) == pytest.approx(together)
    pressure = together / gel.thickness * overlap.astype(np.float64)
    assert pressure.sum() * PITCH**2 == pytest.approx(force, rel=0.01)
    assert np.isfinite(hang_skin(overlap, modulus, PITCH, gel)).all()
