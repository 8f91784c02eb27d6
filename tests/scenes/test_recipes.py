"""Recipes: PhysiCLeAR's list, drawn ones, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipeline.scenes.recipe import load_recipes, recipe_of
from pipeline.videos.catalogue import Catalogue
from tests.conftest import ROOT, refused

PHYSICLEAR = ROOT / "pipeline" / "physiclear"


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
