"""From recipes to videos: the hand's motion, what a press and a twist show, light on the gel, and the files."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import ScenesConfig
from pipeline.scenes import motion, video
from pipeline.scenes.contact import GEL
from pipeline.scenes.geometry import IMAGE_MM, Round
from pipeline.scenes.light import NOISE, Sensor, make_sensor, shade
from pipeline.scenes.motion import FORCE_N, TWIST_DEGREES, make_motion
from pipeline.scenes.recipe import SceneRecipe, load_recipes
from pipeline.scenes.render import make_scene, render
from pipeline.scenes.video import share_as_labelled, synthesize
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import list_videos
from tests.conftest import PHYSICLEAR, refused
from tests.frame_rules import decode, scanned

SMALL = ScenesConfig(objects=("rug",), videos_per_object=2, frames=8, width=64, height=48)
PLAIN = SceneRecipe(modulus=100.0, body=Round(radii=(30.0, 30.0)))


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
    rows, again = (synthesize(recipes, SMALL, folder) for folder in folders)
    assert rows == again
    first, second = ({f.name: f.read_bytes() for f in folder.iterdir()} for folder in folders)
    assert first == second
    assert [row.video for row in rows] == sorted(first) == ["rug_0.mp4", "rug_1.mp4"]
    assert first["rug_0.mp4"] != first["rug_1.mp4"], "each video has its own patch, motion and noise"
    for row, file in zip(rows, list_videos(folders[0], catalogue).files, strict=True):
        probe = scanned(file.path).probe
        assert (probe.frames, probe.width, probe.height, probe.fps) == (SMALL.frames, 64, 48, SMALL.fps)
        assert (row.frames, row.fps) == (SMALL.frames, SMALL.fps)


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


MEDIAN = 3


@given(st.integers(2, 300), st.integers(0, 2**32))
def test_a_hand_rests_presses_and_twists(frames: int, seed: int) -> None:
    hand = make_motion(frames, np.random.default_rng(seed))
    tracks = np.array([hand.force, hand.angle, hand.x, hand.y])
    assert tracks.shape == (4, frames)
    assert np.isfinite(tracks).all()
    assert hand.force[0] == 0, "the first frame shows the gel untouched"
    assert (hand.force >= 0).all()
    assert 0 < hand.force.max() <= FORCE_N[1], "even the shortest video shows contact"
    assert np.abs([hand.x, hand.y]).max() <= motion.REACH_MM
    turned = np.flatnonzero(np.diff(hand.angle))
    # Between two frames of a short video the hand may turn and then let go.
    assert (np.maximum(hand.force[turned], hand.force[turned + 1]) > 0).all(), "what turns is held"
    assert np.ptp(hand.angle) <= max(TWIST_DEGREES) + 1e-9


@given(st.integers(1, 60), st.integers(0, 1000))
def test_the_rate_changes_nothing_but_the_sampling(half: int, seed: int) -> None:
    slow, fast = (make_motion(n, np.random.default_rng(seed)) for n in (2 * half, 4 * half))
    np.testing.assert_allclose(slow.force, fast.force[::2], atol=1e-12)
    np.testing.assert_allclose(slow.angle, fast.angle[::2], atol=1e-9)


def test_times_and_places_are_those_that_were_measured() -> None:
    hands = [make_motion(500, np.random.default_rng(seed)) for seed in range(400)]
    force = np.stack([h.force / h.force.max() for h in hands])
    let_go = force[:, -1] < 0.05
    first = (force >= 0.1).argmax(axis=1) / 500
    last = 1 - (force[let_go, ::-1] >= 0.3).argmax(axis=1) / 500
    assert np.median(first) == pytest.approx(motion.BEGUN[MEDIAN], abs=0.01)
    assert np.median(last) == pytest.approx(motion.RELEASED[MEDIAN], abs=0.02)
    assert 1 - let_go.mean() == pytest.approx(motion.LINGER, abs=0.03)
    assert np.median([np.ptp(h.angle) for h in hands]) == pytest.approx(TWIST_DEGREES[MEDIAN], rel=0.15)
    for axis, (mean, _) in zip("xy", motion.CENTRE_MM, strict=True):
        assert np.mean([getattr(h, axis).mean() for h in hands]) == pytest.approx(mean, abs=0.25)
    travel = [np.hypot(h.x[-1] - h.x[0], h.y[-1] - h.y[0]) for h in hands]
    assert np.median(travel) == pytest.approx(motion.TRAVEL_MM[MEDIAN], abs=0.25)


def test_the_force_falls_while_the_hand_twists() -> None:
    hand = make_motion(1000, np.random.default_rng(3))
    turning = np.flatnonzero(np.diff(hand.angle))
    assert (np.diff(hand.force)[turning] <= 1e-12).all()
