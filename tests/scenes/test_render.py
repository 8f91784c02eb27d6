"""From recipes to videos: what follows from a seed, what a press and a twist show, light on the gel, and the files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.config import ScenesConfig
from pipeline.scenes import video
from pipeline.scenes.contact import GEL
from pipeline.scenes.geometry import IMAGE_MM, Round
from pipeline.scenes.light import NOISE, Sensor, make_sensor, shade
from pipeline.scenes.recipe import SceneRecipe, load_recipes
from pipeline.scenes.render import make_scene, render
from pipeline.scenes.video import share_as_labelled, synthesize
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import list_videos
from tests.conftest import ROOT, refused
from tests.frame_rules import decode, scanned

SMALL = ScenesConfig(objects=("rug",), videos_per_object=2, frames=8, width=64, height=48)
PLAIN = SceneRecipe(modulus=100.0, body=Round(radii=(30.0, 30.0)))
PHYSICLEAR = ROOT / "pipeline" / "physiclear"


@pytest.fixture(scope="module")
def recipes(catalogue: Catalogue) -> dict[str, SceneRecipe]:
    return load_recipes(PHYSICLEAR, catalogue, 0)


@pytest.mark.parametrize(
    ("tier", "width", "height"),
    [("auto", 64, 48), ("auto", 48, 64), ("winkler", 64, 48), ("layer", 48, 64), ("half_space", 64, 48)],
)
def test_every_tier_shows_a_contact_on_pictures_of_either_shape(tier: str, width: int, height: int) -> None:
    config = SMALL.model_copy(update={"tier": tier, "cells": 64, "frames": 20, "width": width, "height": height})
    scene = make_scene(PLAIN, config, 20, 3)
    assert tier == "auto" or scene.imprint.method.tier == tier
    assert (scene.imprint.error is not None) == (tier == "auto")
    frames = np.stack(list(render(scene, config, make_sensor(width, height, 1), 3)))
    assert frames.shape == (20, height, width, 3)
    change = np.abs(frames.astype(int) - frames[0]).mean((1, 2, 3))
    force = scene.motion.force
    assert change[force.argmax()] > 1.5 * np.median(change[force == 0])


def test_a_scene_is_the_same_at_other_resolutions() -> None:
    """Lengths are in mm: the depth of a plain body's imprint does not depend on the pixels."""
    depths = []
    for width in (64, 128):
        config = ScenesConfig(frames=10, width=width, height=width * 3 // 4, tier="layer", cells=64)
        scene = make_scene(PLAIN, config, 10, 5)
        assert scene.pitch == pytest.approx(IMAGE_MM[0] / width)
        depths.append(scene.imprint.skins[-1].max())
    assert depths[0] == pytest.approx(depths[1], rel=0.02)


@pytest.mark.parametrize(("tier", "width", "height"), [("auto", 32, 960), ("layer", 32, 960), ("layer", 120, 160)])
def test_pictures_that_no_grid_is_fine_enough_for(tier: str, width: int, height: int) -> None:
    config = SMALL.model_copy(update={"width": width, "height": height, "tier": tier, "cells": 32})
    with refused(rf"tier={tier} has .* {width} x {height} need \d+ or more; take .*scenes.cells=\d+") as said:
        make_scene(PLAIN, config, 8, 1)
    needed = int(str(said.value).partition("scenes.cells=")[2].split(",")[0])
    assert 2 * np.hypot(width, height) * IMAGE_MM[0] / width / GEL.thickness < needed <= 1024


@pytest.fixture
def in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Videos are made one after the other, in this process."""
    monkeypatch.setattr(video, "run_parallel", lambda work, jobs, *_: map(work, jobs))


@pytest.mark.usefixtures("in_turn")
def test_files_follow_from_their_seeds(recipes: dict[str, SceneRecipe], catalogue: Catalogue, tmp_path: Path) -> None:
    folders = [tmp_path / "a b", tmp_path / "c"]
    rows, again = (synthesize(recipes, SMALL.model_copy(update={"fps": 10.0}), folder) for folder in folders)
    assert rows == again
    first, second = ({f.name: f.read_bytes() for f in folder.iterdir()} for folder in folders)
    assert first == second
    assert [row.video for row in rows] == sorted(first) == ["rug_0.mp4", "rug_1.mp4"]
    assert first["rug_0.mp4"] != first["rug_1.mp4"], "each video has its own patch, motion and noise"
    for row, file in zip(rows, list_videos(folders[0], catalogue).files, strict=True):
        probe = scanned(file.path).probe
        assert (probe.frames, probe.width, probe.height, probe.fps) == (SMALL.frames, 64, 48, 10.0)
        assert (row.frames, row.fps) == (SMALL.frames, 10.0)


@pytest.mark.usefixtures("in_turn")
def test_rows_say_what_scenes_measure_as(recipes: dict[str, SceneRecipe], catalogue: Catalogue, tmp_path: Path) -> None:
    config = SMALL.model_copy(update={"objects": ("egg", "basket"), "videos_per_object": 1, "frames": 2})
    rows = synthesize(recipes, config, tmp_path)
    for row in rows:
        first, last = (frame.astype(int) for frame in decode(tmp_path / row.video))  # Two frames are enough.
        assert np.abs(last - first).mean() > 1, "the press is seen"
        assert row.force > 0
        assert row.hardness == catalogue.labels(row.object_id)[catalogue.property_index("hardness")]
    agreeing = [(r.hardness, r.roughness, r.bumpiness) == catalogue.labels(r.object_id) for r in rows]
    assert share_as_labelled(rows, catalogue) == pytest.approx(np.mean(agreeing), abs=1e-4)


WIDTH, HEIGHT, PITCH = 96, 72, 0.2
FLAT = np.zeros((HEIGHT, WIDTH), np.float32)


def quiet(sensor: Sensor) -> Sensor:
    """The same without noise and dust."""
    return dataclasses.replace(sensor, noise=np.zeros_like(sensor.noise), dust=np.ones_like(sensor.dust))


def bump(height: float, wide: float) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    square = ((x - (WIDTH - 1) / 2) ** 2 + (y - (HEIGHT - 1) / 2) ** 2) * PITCH**2
    return (height * np.exp(-square / (2 * wide**2))).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_flat_skin_is_the_background_within_the_noise(seed: int) -> None:
    sensor = make_sensor(WIDTH, HEIGHT, seed)
    frame = shade(FLAT, sensor, PITCH, 7)
    assert frame.dtype == np.uint8
    error = frame - sensor.background
    assert np.abs(error).max() < 6 * NOISE
    assert error.std() == pytest.approx(NOISE, rel=0.1)
    np.testing.assert_array_equal(shade(FLAT, quiet(sensor), PITCH, 7), cv2.convertScaleAbs(sensor.glow))


def test_red_comes_from_above_green_from_the_right_blue_from_below() -> None:
    """As in the real videos: a bulge's upper flank is redder than flat skin, its lower flank bluer."""
    sensor = quiet(make_sensor(WIDTH, HEIGHT, 0))
    change = shade(bump(1.0, 1.5), sensor, PITCH, 0).astype(int) - shade(FLAT, sensor, PITCH, 0)
    row, column = HEIGHT // 2, WIDTH // 2
    upper, lower, left, right = change[[row - 7, row + 7, row, row], [column, column, column - 7, column + 7]]
    assert upper[2] > 10 > -10 > lower[2]
    assert lower[0] > 10 > -10 > upper[0]
    assert right[1] > 10 > -10 > left[1]


def test_drift_carries_the_marks_and_nothing_else() -> None:
    sensor = make_sensor(WIDTH, HEIGHT, 1)
    bare, marked = quiet(sensor), dataclasses.replace(quiet(sensor), dust=sensor.dust)
    assert (sensor.dust < 0.9).any()

    def shown(sensor: Sensor, x: float, y: float) -> np.ndarray:
        return shade(bump(0.5, 2.0), sensor, PITCH, 0, (np.full_like(FLAT, x), np.full_like(FLAT, y)))

    still, plain = (shade(bump(0.5, 2.0), each, PITCH, 0) for each in (marked, bare))
    np.testing.assert_array_equal(shown(marked, 0, 0), still)
    moved = shown(marked, 4 * PITCH, -3 * PITCH)
    assert (moved != still).any()
    shifted = np.ones_like(sensor.dust)
    shifted[:-3, 4:] = sensor.dust[3:, :-4]
    assert np.abs(moved - plain * shifted).max() <= 1.01, "right and up"
    np.testing.assert_array_equal(shown(bare, 1, 1), plain)
