"""From recipes to videos: what follows from a seed, what a press and a twist show, and the files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.config import FramesConfig, ScenesConfig
from pipeline.core.errors import UserError
from pipeline.scenes.contact import GEL
from pipeline.scenes.geometry import IMAGE_MM, Round
from pipeline.scenes.light import make_sensor
from pipeline.scenes.recipe import Recipe, load_recipes
from pipeline.scenes.render import Scene, make_scene, measure_scene, render
from pipeline.scenes.video import share_as_labelled, synthesize
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.decoding import decode
from pipeline.videos.files import list_videos
from pipeline.videos.frames.scan import Scan, scan
from tests.conftest import ROOT, refused

SMALL = ScenesConfig(objects=("rug",), videos_per_object=2, frames=8, width=64, height=48)
PLAIN = Recipe(modulus=100.0, body=Round(kind="round", radii=(30.0, 30.0)))
PHYSICLEAR = ROOT / "pipeline" / "physiclear"


@pytest.fixture(scope="module")
def recipes(catalogue: Catalogue) -> dict[str, Recipe]:
    return load_recipes(PHYSICLEAR, catalogue, 0)


def film(recipe: Recipe, config: ScenesConfig, seed: int) -> tuple[Scene, np.ndarray]:
    scene = make_scene(recipe, config, int(config.frames), seed)
    sensor = make_sensor(config.width, config.height, 1)
    return scene, np.stack(list(render(scene, config, sensor, seed)))


@pytest.mark.parametrize("tier", ["auto", "winkler", "layer", "half_space"])
def test_every_tier_shows_a_contact(recipes: dict[str, Recipe], tier: str) -> None:
    config = SMALL.model_copy(update={"tier": tier, "cells": 48, "frames": 20, "width": 96, "height": 72})
    scene, frames = film(recipes["egg"], config, 3)
    assert tier == "auto" or scene.imprint.method.tier == tier
    assert (scene.imprint.error is not None) == (tier == "auto")
    strongest = int(scene.motion.force.argmax())
    change = np.abs(frames.astype(int) - frames[0]).mean((1, 2, 3))
    assert change[strongest] > 2 * np.median(change[scene.motion.force == 0])


def test_a_scene_is_the_same_at_other_resolutions(recipes: dict[str, Recipe]) -> None:
    """Lengths are in mm: the depth of a plain body's imprint does not depend on the pixels."""
    depths = []
    for width in (64, 128):
        config = ScenesConfig(frames=10, width=width, height=width * 3 // 4, tolerance=0.02)
        scene = make_scene(PLAIN, config, 10, 5)
        assert scene.pitch == pytest.approx(IMAGE_MM[0] / width)
        depths.append(float(scene.imprint.skins[-1].max()))
    np.testing.assert_allclose(depths, depths[-1], rtol=0.02)


@pytest.mark.parametrize("tier", ["auto", "layer"])
def test_pictures_may_be_upright(tier: str) -> None:
    config = SMALL.model_copy(update={"width": 48, "height": 64, "tier": tier, "cells": 64})
    assert film(PLAIN, config, 1)[1][0].shape == (64, 48, 3)


@pytest.mark.parametrize(("tier", "width", "height"), [("auto", 32, 960), ("layer", 32, 960), ("layer", 120, 160)])
def test_pictures_that_no_grid_is_fine_enough_for(tier: str, width: int, height: int) -> None:
    config = SMALL.model_copy(update={"width": width, "height": height, "tier": tier, "cells": 32})
    with refused(rf"tier={tier} has .* {width} x {height} need \d+ or more; take .*scenes.cells=\d+") as said:
        make_scene(PLAIN, config, 8, 1)
    needed = int(str(said.value).partition("scenes.cells=")[2].split(",")[0])
    assert 2 * np.hypot(width, height) * IMAGE_MM[0] / width / GEL.thickness < needed <= 1024


def test_files_are_equal_for_equal_seeds(recipes: dict[str, Recipe], catalogue: Catalogue, tmp_path: Path) -> None:
    folders = [tmp_path / "a b", tmp_path / "c"]
    first, second = (synthesize(recipes, SMALL, folder) for folder in folders)
    assert first == second
    names = [row.video for row in first]
    assert names == sorted(p.name for p in folders[0].iterdir()), "nothing else is left there"
    assert [(folders[0] / n).read_bytes() for n in names] == [(folders[1] / n).read_bytes() for n in names]
    assert (folders[0] / names[0]).read_bytes() != (folders[0] / names[1]).read_bytes()
    for file in list_videos(folders[0], catalogue).files:
        found = scan(file, FramesConfig(pixels=16))
        assert isinstance(found, Scan)
        video = found.probe
        assert (video.frames, video.width, video.height, video.fps) == (8, 64, 48, 25.0)


def test_recorded_lengths_are_those_of_the_public_videos(recipes: dict[str, Recipe], tmp_path: Path) -> None:
    config = SMALL.model_copy(update={"frames": "recorded", "videos_per_object": 9, "width": 32, "height": 24})
    rows = synthesize(recipes, config, tmp_path)
    assert {(row.frames, row.fps) for row in rows} <= {(126, 25.0), (50, 10.0)}
    assert len({row.frames for row in rows}) == 2


def test_rows_say_what_scenes_measure_as(recipes: dict[str, Recipe], catalogue: Catalogue, tmp_path: Path) -> None:
    config = ScenesConfig(objects=("egg", "potato", "basket"), videos_per_object=1, frames=2, width=96, height=72)
    rows = synthesize(recipes, config, tmp_path)
    for row in rows:
        first, last = (frame.astype(int) for frame in decode(tmp_path / row.video))  # Two frames are enough.
        assert first.shape == (72, 96, 3)
        assert np.abs(last - first).mean() > 1, "the press is seen"
        assert (row.frames, row.error is None) == (2, False)
        assert row.force > 0
        assert row.hardness == catalogue.labels(row.object_id)[catalogue.property_index("hardness")]
    share = share_as_labelled(rows, catalogue)
    agreeing = [(r.hardness, r.roughness, r.bumpiness) == catalogue.labels(r.object_id) for r in rows]
    assert share == pytest.approx(np.mean(agreeing), abs=1e-4)
    scene = make_scene(recipes["egg"], config, 2, 1)
    assert measure_scene(scene, recipes["egg"], config).modulus == recipes["egg"].modulus


def test_an_unknown_object_is_named(recipes: dict[str, Recipe], tmp_path: Path) -> None:
    config = ScenesConfig(objects=("rug", "yoyo"))
    with pytest.raises(UserError, match=r"scenes\.objects: yoyo"):
        synthesize(recipes, config, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_named(recipes: dict[str, Recipe], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises((UserError, OSError), match="file"):
        synthesize(recipes, SMALL, tmp_path / "file")
