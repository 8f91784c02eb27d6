"""Classes measured from scenes: of plain shapes whose classes are known, and of every object of the catalogue."""

from collections.abc import Mapping
from statistics import fmean

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.scenes.contact import Method, press_by
from pipeline.scenes.geometry import IMAGE_MM, heights
from pipeline.scenes.grid import Heights
from pipeline.scenes.measure import BIG_SHARE, VISIBLE_MM, Measured, bump_share, texture
from pipeline.scenes.recipe import SceneRecipe, load_recipes, recipe_of
from pipeline.videos.catalogue import Catalogue
from tests.conftest import ROOT

WIDTH, HEIGHT, SIDE = 160, 120, 263
PITCH = IMAGE_MM[0] / WIDTH
FORCE_N = 8.0
"""A firm press; a light one does not bring every bump out, which scenes.csv shows."""


def look(recipe: SceneRecipe, seed: int) -> Measured:
    """The measures of one press onto the middle of a patch."""
    patch = heights(recipe.body, recipe.relief, SIDE, PITCH, np.random.default_rng(seed))
    skin = press_by(Method("layer", 128), patch, np.array([FORCE_N]), recipe.modulus, PITCH).skins[0]
    top, left = (SIDE - HEIGHT) // 2, (SIDE - WIDTH) // 2
    view = (slice(top, top + HEIGHT), slice(left, left + WIDTH))
    return Measured(recipe.modulus, texture(patch[view], PITCH), bump_share(skin[view], PITCH))


X, Y = np.meshgrid(np.arange(WIDTH) * PITCH, np.arange(HEIGHT) * PITCH)


def agreeing(recipes: Mapping[str, SceneRecipe], catalogue: Catalogue) -> float:
    """The share of objects that measure as their labels say, by three seeds in turn; no measure sees a label."""
    found = {o: look(recipe, number % 3) for number, (o, recipe) in enumerate(recipes.items())}
    return fmean((m.hardness, m.roughness, m.bumpiness) == catalogue.labels(o) for o, m in found.items())


@pytest.mark.slow
def test_scenes_show_what_the_labels_say(catalogue: Catalogue) -> None:
    assert agreeing(load_recipes(ROOT / "pipeline" / "physiclear", catalogue, 0), catalogue) == 1
    assert agreeing({o: recipe_of(o, catalogue, 0) for o in sorted(catalogue.objects)[::2]}, catalogue) >= 0.94


def waves(length: float, amplitude: float) -> Heights:
    return (amplitude * np.sin(2 * np.pi * X / length) * np.sin(2 * np.pi * Y / length)).astype(np.float32)


def test_texture_passes_short_waves_and_stops_long_ones() -> None:
    short = waves(0.5, 0.02)
    assert texture(short, PITCH) == pytest.approx(short[short > 0].std(), rel=0.1), "the upper half passes whole"
    assert texture(waves(5.0, 0.2), PITCH) < 0.002
    assert texture(waves(0.4, 0), PITCH) == 0


@given(st.floats(5, 1e3), st.floats(5, 1e3))
def test_curvature_is_no_texture(across: float, along: float) -> None:
    recipe = SceneRecipe.model_validate({"modulus": 1, "body": {"kind": "round", "radii": [across, along]}})
    assert texture(heights(recipe.body, recipe.relief, WIDTH, PITCH, np.random.default_rng(0)), PITCH) < 2e-4


@pytest.mark.parametrize("radius", [3.0, 5.0, 8.0])
def test_a_smooth_contact_has_no_bumps(radius: float) -> None:
    square = (X - WIDTH / 2 * PITCH) ** 2 + (Y - HEIGHT / 2 * PITCH) ** 2
    bowl = np.maximum(0.8 * (1 - square / radius**2), 0).astype(np.float32)
    assert bump_share(cv2.GaussianBlur(bowl, (0, 0), 3), PITCH) == 0


@pytest.mark.parametrize("width", [1.5, 2.5, 4.5, 6.0])
def test_a_lattice_of_caps_measures_as_wide_as_it_is(width: float) -> None:
    spacing = 1.3 * width
    du, dv = (x - np.round(x / spacing) * spacing for x in (X, Y))
    skin = (0.3 + 0.3 * np.maximum(1 - (du * du + dv * dv) / (width / 2) ** 2, 0)).astype(np.float32)
    share = bump_share(skin, PITCH)
    assert share * IMAGE_MM[1] == pytest.approx(width, rel=0.15)
    assert (share > BIG_SHARE) == (width > IMAGE_MM[1] / 4)


def test_what_cannot_be_seen_is_no_bump_and_the_pitch_is_no_matter() -> None:
    assert bump_share(0.3 + waves(4, VISIBLE_MM / 4), PITCH) == 0
    assert bump_share(0.3 + waves(4, 4 * VISIBLE_MM), PITCH) > 0
    assert bump_share(0 * X, PITCH) == 0
    fine = 0.3 + cv2.resize(waves(4, 0.1), (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_CUBIC)
    assert bump_share(fine, PITCH / 2) == pytest.approx(bump_share(0.3 + waves(4, 0.1), PITCH), rel=0.05)
