"""Synthetic scenes: the physics of a contact, and videos that follow from their seed."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import UserError
from pipeline.frames.scan import Scan, scan
from pipeline.physiclear.catalogue import Catalogue
from pipeline.scenes.contact import GEL_MODULUS_MPA, GEL_THICKNESS_MM, indentation, press, series
from pipeline.scenes.geometry import IMAGE_MM, Heights, Surface, bumps, grain, heights
from pipeline.scenes.light import make_sensor, shade
from pipeline.scenes.recipe import BUMP_SHARE, GRAIN_MM, MODULUS_MPA, Recipe, recipe_of
from pipeline.scenes.video import FORCE_N, make_motion, render, synthesize
from pipeline.sections import FramesConfig, ScenesConfig
from pipeline.videos import list_videos

PITCH = IMAGE_MM[0] / 160
SMALL = ScenesConfig(objects=("rug",), videos_per_object=2, frames=8, width=64, height=48)
BALL = Surface(
    radii=(20.0, 20.0),
    bump_shape="domes",
    bump_width=0.0,
    bump_height=0.0,
    bump_spacing=0.0,
    grain=0.0,
    grain_length=0.5,
)


def gap_of(surface: Surface, seed: int = 0, side: int = 121) -> Heights:
    patch = heights(surface, side, PITCH, np.random.default_rng(seed))
    return patch.max() - patch


def seen(gap: Heights, force: float, modulus: float) -> Heights:
    return indentation(press(gap, force, modulus, PITCH), modulus, PITCH)


ROUGH = dataclasses.replace(BALL, grain=0.03, bump_width=2.0, bump_height=0.3, bump_spacing=3.0)


@pytest.mark.parametrize("surface", [BALL, ROUGH, dataclasses.replace(ROUGH, bump_shape="weave")])
@pytest.mark.parametrize("force", [1e-3, 0.5, 8.0, 1e4])
@pytest.mark.parametrize("modulus", [1e-4, 0.03, 0.3, 1e4])
def test_the_contact_carries_the_force_asked_for(surface: Surface, force: float, modulus: float) -> None:
    gap = gap_of(surface)
    contact = press(gap, force, modulus, PITCH)
    pressure = series(GEL_MODULUS_MPA, modulus) / GEL_THICKNESS_MM * contact.overlap.astype(np.float64)
    assert pressure.sum() * PITCH**2 == pytest.approx(force, rel=0.01)
    assert contact.force == pytest.approx(force, rel=1e-3)
    assert (pressure >= 0).all()
    np.testing.assert_allclose(contact.overlap, np.maximum(contact.approach - gap, 0), rtol=1e-4, atol=1e-5)
    assert np.isfinite(indentation(contact, modulus, PITCH)).all()


@pytest.mark.parametrize("force", [0.0, -1.0])
def test_no_force_no_contact(force: float) -> None:
    contact = press(gap_of(ROUGH), force, 1.0, PITCH)
    assert (contact.approach, contact.force) == (0.0, 0.0)
    assert not contact.overlap.any()
    assert not indentation(contact, 1.0, PITCH).any()


def test_flat_on_flat_and_a_single_pixel() -> None:
    flat = np.zeros((20, 30), np.float32)
    contact = press(flat, 2.0, 1.0, PITCH)
    assert np.ptp(contact.overlap) == 0
    needle = np.full((21, 21), 50.0, np.float32)
    needle[10, 10] = 0
    assert np.count_nonzero(press(needle, 1e-3, 1.0, PITCH).overlap) == 1
    for gap in (flat, needle):
        assert np.isfinite(seen(gap, 2.0, 1.0)).all()


def test_a_ball_on_springs_follows_theory() -> None:
    """Winkler: F = pi E* R d^2 / t for a paraboloid (Johnson, Contact Mechanics, 4.3), as long as it fits the grid."""
    pitch, modulus, force = 0.02, 1.0, 0.2
    axis = (np.arange(501) - 250) * pitch
    x, y = np.meshgrid(axis, axis)
    gap = ((x * x + y * y) / (2 * BALL.radii[0])).astype(np.float32)
    contact = press(gap, force, modulus, pitch)
    stiffness = series(GEL_MODULUS_MPA, modulus) / GEL_THICKNESS_MM
    assert contact.approach == pytest.approx(math.sqrt(force / (math.pi * stiffness * BALL.radii[0])), rel=2e-3)
    area = np.count_nonzero(contact.overlap) * pitch**2
    assert area == pytest.approx(2 * math.pi * BALL.radii[0] * contact.approach, rel=0.01)


def test_a_harder_object_indents_the_gel_more() -> None:
    gap = gap_of(BALL)
    depths = [float(seen(gap, 4.0, modulus).max()) for modulus in (0.02, 0.05, 0.15, 0.5, 2.0, 50.0)]
    assert depths == sorted(depths)
    assert depths[-1] > 3 * depths[0]


def test_more_force_presses_deeper_and_wider() -> None:
    gap = gap_of(ROUGH)
    contacts = [press(gap, force, 1.0, PITCH) for force in (0.1, 1, 5, 20)]
    for less, more in itertools.pairwise(contacts):
        assert more.approach > less.approach
        assert (more.overlap >= less.overlap).all()


@given(st.floats(1e-4, 1e4), st.floats(1e-4, 1e4))
def test_springs_in_series(first: float, second: float) -> None:
    both = series(first, second)
    assert both == pytest.approx(1 / (1 / first + 1 / second))
    assert both <= min(first, second)


@pytest.mark.parametrize("pitch", [0.06, 0.12])
def test_grain_has_its_height_and_its_band(pitch: float) -> None:
    field = grain(256, pitch, 0.03, 1.0, np.random.default_rng(3))
    assert field.std() == pytest.approx(0.03, rel=1e-6)
    power = np.abs(np.fft.rfft2(field)) ** 2
    q = np.hypot(np.fft.rfftfreq(256, pitch)[None], np.fft.fftfreq(256, pitch)[:, None])
    assert power[q < 0.99].sum() < 1e-12 * power.sum()
    assert not grain(64, 10.0, 0.03, 1.0, np.random.default_rng(0)).any(), "no wave of it fits the grid"


@pytest.mark.parametrize("shape", ["domes", "ridges", "weave"])
def test_bumps_have_height_one(shape: str) -> None:
    surface = dataclasses.replace(ROUGH, bump_shape=shape)
    axis = np.linspace(-10, 10, 300)
    field = bumps(*np.meshgrid(axis, axis), surface, np.random.default_rng(1))
    assert field.min() >= 0
    assert 0.9 < field.max() <= 1 + 1e-9
    step = axis[1] - axis[0]
    slope = np.abs(np.diff(field, axis=0)).max() / step
    assert slope < 2 * np.pi / surface.bump_width, "no cliffs"


def test_light_without_contact_is_the_background() -> None:
    sensor = make_sensor(64, 48, 5)
    frame = shade(np.zeros((48, 64), np.float32), sensor, PITCH, 0)
    assert np.abs(frame - sensor.background).max() < 6
    assert frame.dtype == np.uint8


def test_red_light_comes_from_above() -> None:
    """A bulge's upper flank is redder than flat skin, its lower flank bluer, as in the real videos."""
    y = np.linspace(-1, 1, 48, dtype=np.float32)[:, None]
    bulge = np.broadcast_to(np.exp(-((y / 0.3) ** 2)), (48, 64)).astype(np.float32)
    sensor = make_sensor(64, 48, 5)
    change = shade(bulge, sensor, 0.2, 0).astype(int) - shade(np.zeros_like(bulge), sensor, 0.2, 0)
    upper, lower = change[14:20].mean((0, 1)), change[28:34].mean((0, 1))
    assert upper[2] > 10 > -10 > lower[2]
    assert lower[0] > 10 > -10 > upper[0]


def test_recipes_follow_the_labels(catalogue: Catalogue) -> None:
    recipes = {o: recipe_of(o, catalogue, 0) for o in catalogue.objects}
    assert len(set(recipes.values())) == len(recipes), "objects of one class differ"
    for object_id, recipe in recipes.items():
        hardness, roughness, bumpiness = catalogue.labels(object_id)
        assert MODULUS_MPA[hardness][0] <= recipe.modulus <= MODULUS_MPA[hardness][1]
        assert GRAIN_MM[roughness][0] <= recipe.surface.grain <= GRAIN_MM[roughness][1]
        share = recipe.surface.bump_width / IMAGE_MM[1]
        assert BUMP_SHARE[bumpiness][0] <= share <= BUMP_SHARE[bumpiness][1]
        assert (share > 1 / 4) == (bumpiness == 2)
    assert recipe_of("rug", catalogue, 0) == recipes["rug"]
    assert recipe_of("rug", catalogue, 1) != recipes["rug"]


@given(st.integers(2, 200), st.integers(0, 1000))
def test_a_hand_rests_presses_and_twists(frames: int, seed: int) -> None:
    motion = make_motion(frames, np.random.default_rng(seed))
    assert motion.force[0] == 0
    assert (motion.force >= 0).all()
    assert motion.force.max() <= FORCE_N[1]
    assert motion.force[-1] > 0 or frames > 2
    assert len(motion.force) == len(motion.angle) == len(motion.x) == len(motion.y) == frames


def test_a_video_follows_from_its_seed(catalogue: Catalogue) -> None:
    recipe, sensor = recipe_of("basket", catalogue, 0), make_sensor(64, 48, 1)
    first, again, other = (np.stack(list(render(recipe, SMALL, sensor, seed))) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (8, 48, 64, 3)
    assert (first != other).any()


def change(recipe: Recipe) -> np.ndarray:
    """The fullest contact of a video less its first frame, in 8-bit steps."""
    config = ScenesConfig(frames=12, width=160, height=120)
    stack = np.stack(list(render(recipe, config, make_sensor(160, 120, 1), 4))).astype(int)
    changes = stack - stack[0]
    return changes[np.abs(changes).sum((1, 2, 3)).argmax()]


def test_classes_look_different() -> None:
    plain = Recipe(modulus=100.0, surface=dataclasses.replace(BALL, radii=(30.0, 30.0)))
    soft = dataclasses.replace(plain, modulus=0.03)
    rough = dataclasses.replace(plain, surface=dataclasses.replace(plain.surface, grain=0.04))
    assert np.abs(change(plain)).mean() > 2 * np.abs(change(soft)).mean()
    assert np.abs(np.diff(change(rough), axis=1)).mean() > 2 * np.abs(np.diff(change(plain), axis=1)).mean()


def test_files_are_equal_for_equal_seeds(catalogue: Catalogue, tmp_path: Path) -> None:
    folders = [tmp_path / "a b", tmp_path / "c"]
    first, second = (synthesize(catalogue, SMALL, folder) for folder in folders)
    assert [p.name for p in first] == ["rug_0.avi", "rug_1.avi"]
    assert sorted(p.name for p in folders[0].iterdir()) == ["rug_0.avi", "rug_1.avi"], "nothing else is left there"
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    assert first[0].read_bytes() != first[1].read_bytes()
    for file in list_videos(folders[0], catalogue).files:
        found = scan(file, FramesConfig(size=16))
        assert isinstance(found, Scan)
        video = found.video
        assert (video.frames, video.width, video.height, video.fps) == (8, 64, 48, 25.0)


def test_an_unknown_object_is_named(catalogue: Catalogue, tmp_path: Path) -> None:
    config = ScenesConfig(objects=("rug", "yoyo"))
    with pytest.raises(UserError, match=r"scenes\.objects: yoyo"):
        synthesize(catalogue, config, tmp_path / "out")
    assert not (tmp_path / "out").exists()
