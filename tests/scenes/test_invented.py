"""Recipes, listed, drawn or refused; classes measured from scenes, of plain shapes and of every catalogued object."""

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import InventConfig, ScenesConfig
from pipeline.core.io import code_of, fingerprint
from pipeline.core.layout import CHECKPOINTS
from pipeline.scales import check_inputs, compose
from pipeline.scenes import invented
from pipeline.scenes.contact import Method, press_by
from pipeline.scenes.elastic import solver
from pipeline.scenes.geometry import IMAGE_MM, Flat, heights
from pipeline.scenes.grid import Heights
from pipeline.scenes.invented import classes_of, draw, invented_catalogue, write_catalogue
from pipeline.scenes.measure import BIG_SHARE, VISIBLE_MM, Measured, bump_share, texture
from pipeline.scenes.recipe import SceneRecipe, load_recipes, recipe_of
from pipeline.scenes.render import make_scene, measure_scene
from pipeline.videos.catalogue import Catalogue, load_catalogue
from tests.conftest import CATALOGUE, PHYSICLEAR, ROOT, refused


def test_each_combination_comes_as_often() -> None:
    catalogue = invented_catalogue(InventConfig(objects=270))
    labels = [catalogue.labels(o) for o in catalogue.objects]
    assert labels == [classes_of(number) for number in range(270)]
    assert set(Counter(labels).values()) == {10}


@pytest.mark.slow
def test_an_object_measures_as_its_classes_in_videos_of_it() -> None:
    """By the scene that a video is made of: a patch, a force and a resolution that the drawing has not seen."""
    config, right = ScenesConfig(tier="layer", cells=96, width=240, height=180), 0
    for number in (0, 5, 13, 21, 26):
        recipe = draw(classes_of(number), np.random.default_rng(number))
        for seed in range(3):
            measured = measure_scene(make_scene(recipe, config, 2, 100 + seed), recipe, config)
            right += (measured.hardness, measured.roughness, measured.bumpiness) == classes_of(number)
    assert right >= 12, "of 15; by chance one in 27"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which objects are drawn one after the other, in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(invented, "run_parallel", lambda work, jobs, *_: map(work, jobs))
    return tmp_path


def drawn(classes: tuple[int, int, int], rng: np.random.Generator) -> SceneRecipe:
    return SceneRecipe(modulus=1 + classes[0] + rng.random(), body=Flat())


def test_it_is_written_as_a_catalogue_of_seed_and_number(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(invented, "draw", drawn)
    recipes = []
    for objects, seed in ((27, 0), (54, 0), (27, 1)):
        config = InventConfig(objects=objects, seed=seed)
        write_catalogue(config, here / f"{objects} {seed}")
        catalogue = load_catalogue(here / f"{objects} {seed}")
        assert catalogue == invented_catalogue(config), "known before it is written"
        recipes.append(load_recipes(here / f"{objects} {seed}", catalogue, seed=0))
    few, more, other = recipes
    assert few.items() <= more.items()
    assert not few.keys() & other.keys()
    assert not {*few.values()} & {*other.values()}
    assert catalogue.language.dataset != "PhysiCLeAR", "its published figures are not about these"
    assert not CATALOGUE.objects.keys() & catalogue.objects.keys()


def test_a_killed_drawing_goes_on_from_what_is_finished(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, int, int]] = []

    def dies(classes: tuple[int, int, int], rng: np.random.Generator) -> SceneRecipe:
        calls.append(classes)
        if len(calls) == 20:
            raise KeyboardInterrupt
        return drawn(classes, rng)

    monkeypatch.setattr(invented, "draw", dies)
    config = InventConfig(objects=27)
    with pytest.raises(KeyboardInterrupt):
        write_catalogue(config, here / "resumed")
    assert not (here / "resumed").exists()
    write_catalogue(config, here / "resumed")
    assert len(calls) == 20 + 8, "19 were finished"
    (work,) = (CHECKPOINTS / "invent").iterdir()
    assert work.name == fingerprint(0, *code_of("invent")), "another version of the code draws all anew"
    assert Path(solver.__file__) in code_of("invent")
    monkeypatch.setattr(invented, "CHECKPOINTS", here / "fresh")
    write_catalogue(config, here / "whole")
    resumed, whole = ({f.name: f.read_bytes() for f in (here / name).iterdir()} for name in ("resumed", "whole"))
    assert resumed == whole


def test_its_scale_is_checked_before_the_catalogue_is_written(here: Path) -> None:
    check_inputs(compose("invented", ["invent.objects=54"], conf=ROOT / "conf"))
    assert not (here / "data").exists()


def test_every_object_has_a_recipe_of_its_own(catalogue: Catalogue) -> None:
    recipes = load_recipes(PHYSICLEAR, catalogue, 0)
    assert list(recipes) == list(catalogue.objects)
    assert len(set(recipes.values())) == len(recipes) == 74
    assert recipes == load_recipes(PHYSICLEAR, catalogue, 1), "listed, not drawn"


def test_what_is_not_listed_is_drawn(catalogue: Catalogue, tmp_path: Path) -> None:
    (tmp_path / "scenes.yaml").write_text("rug: {modulus: 0.3, relief: [{kind: rough, rms: 0.02, longest: 0.9}]}\n")
    recipes = load_recipes(tmp_path, catalogue, 3)
    assert recipes["rug"].modulus == 0.3
    assert recipes["rice"] == recipe_of("rice", catalogue, 3) != load_recipes(PHYSICLEAR, catalogue, 3)["rice"]
    (tmp_path / "scenes.yaml").write_text("# nothing yet\n")
    assert load_recipes(tmp_path, catalogue, 3)["rug"] == recipe_of("rug", catalogue, 3)


def test_scenes_need_their_properties(catalogue: Catalogue, tmp_path: Path) -> None:
    language = catalogue.language.model_copy(update={"properties": catalogue.properties[1:]})
    objects = {"rug": catalogue.objects["rug"].model_copy(update={"ratings": catalogue.objects["rug"].ratings[1:]})}
    fewer = Catalogue.model_construct(language=language, objects=objects)
    with refused(r"hardness.*three classes each.*data\.source=videos"):
        load_recipes(tmp_path, fewer, 0)
    (tmp_path / "scenes.yaml").write_text("rug: {modulus: 0.3}")
    assert load_recipes(tmp_path, fewer, 0)["rug"].modulus == 0.3, "a listed object needs no labels"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("yoyo: {modulus: 1}", r"yoyo is not in objects\.csv; correct or remove the entry"),
        ("rug: {modulus: 1, body: {kind: cube}}", r"rug: body: .*cube.*'flat'"),
    ],
)
def test_bad_entries_are_refused_in_one_line(text: str, message: str, catalogue: Catalogue, tmp_path: Path) -> None:
    file = tmp_path / "scenes.yaml"
    file.write_text(text)
    with refused(f"^{re.escape(str(file))}: .*{message}"):
        load_recipes(tmp_path, catalogue, 0)


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
