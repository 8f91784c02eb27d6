"""The catalogue against the paper's tables, and bad catalogues."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import pytest

from pipeline.errors import UserError
from pipeline.physiclear.catalogue import Catalogue, load_catalogue
from pipeline.records import Part
from tests.conftest import ROOT

PHYSICLEAR = ROOT / "pipeline" / "physiclear"
PAPER_TEST = {
    "bath_towel",
    "ice_block",
    "clothes_peg",
    "hairbrush_handle",
    "microfiber_cloth",
    "toilet_brush_bristles",
    "hairbrush_bristles",
}


def members(catalogue: Catalogue, split: str, part: Part) -> set[str]:
    return {o.object_id for o in catalogue.objects.values() if o.splits[split] == part}


def test_objects_and_parts(catalogue: Catalogue) -> None:
    assert len(catalogue.objects) == 74
    counts = Counter(o.splits["paper"] for o in catalogue.objects.values())
    assert counts == {Part.TRAIN: 60, Part.VALIDATION: 7, Part.TEST: 7}
    assert members(catalogue, "paper", Part.TEST) == PAPER_TEST


def test_release_split_differs_as_published(catalogue: Catalogue) -> None:
    assert members(catalogue, "release", Part.TEST) == PAPER_TEST - {"ice_block", "clothes_peg"} | {"orange", "eraser"}
    paper, release = (members(catalogue, s, Part.VALIDATION) for s in ("paper", "release"))
    assert (paper - release, release - paper) == ({"bubble_wrap"}, {"lemon"})


@pytest.mark.parametrize(
    ("name", "counts"), [("hardness", (11, 31, 32)), ("roughness", (28, 23, 23)), ("bumpiness", (25, 38, 11))]
)
def test_class_counts_follow_from_the_ratings(catalogue: Catalogue, name: str, counts: tuple[int, ...]) -> None:
    index = catalogue.property_index(name)
    found = Counter(catalogue.labels(o)[index] for o in catalogue.objects)
    assert tuple(found[level] for level in range(3)) == counts


def test_a_mean_is_rounded_to_the_nearest_class(catalogue: Catalogue) -> None:
    assert catalogue.objects["gauze_pad"].ratings[0] == (1, 2, 2)
    assert catalogue.labels("gauze_pad")[0] == 2


def test_every_object_has_three_raters_and_a_name_of_its_own(catalogue: Catalogue) -> None:
    names = [o.name.lower() for o in catalogue.objects.values()]
    assert len(set(names)) == len(names), "options of a matching question are told apart by name"
    assert all(len(r) == 3 for o in catalogue.objects.values() for r in o.ratings)
    assert all(o.material for o in catalogue.objects.values())


def test_descriptions_name_every_class(catalogue: Catalogue) -> None:
    assert catalogue.structured((2, 0, 0)) == "Overall, it presents a hard and smooth surface with no bumps."
    assert catalogue.describe_one("gauze_pad", "hardness") == "Overall, it presents a hard surface."
    for object_id in catalogue.objects:
        assert catalogue.describe(object_id).endswith(catalogue.structured(catalogue.labels(object_id)))


def test_phrases_are_told_apart(catalogue: Catalogue) -> None:
    for p in catalogue.properties:
        phrases = [phrase for level in p.phrases for phrase in level]
        assert len(set(phrases)) == len(phrases)


HEADER = "object_id,name,material,part_of,part,split_paper,split_release,hardness,roughness,bumpiness"
GOOD = "ball,a ball,rubber,,,train,train,1 1 2,0 0 0,0 0 1"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([HEADER], ["objects.csv", "no object"]),
        ([HEADER.replace(",hardness", ""), GOOD], ["objects.csv", "hardness", "missing"]),
        ([HEADER, GOOD, GOOD], ["line 3", "ball", "twice"]),
        ([HEADER, GOOD.replace("1 1 2", "1 1 3")], ["line 2", "hardness", "0 to 2"]),
        ([HEADER, GOOD.replace("1 1 2", "1 one 2")], ["line 2", "hardness"]),
        ([HEADER, GOOD.replace("1 1 2", "")], ["line 2", "hardness"]),
        ([HEADER, "ball,a ball"], ["line 2", "hardness"]),
        ([HEADER, GOOD.replace("train,train", "train,trian")], ["line 2", "split_release", "trian", "validation"]),
        ([HEADER, GOOD.replace("a ball", "")], ["line 2", "name"]),
        ([HEADER, "," + GOOD.partition(",")[2]], ["line 2", "object_id"]),
    ],
)
def test_a_bad_table_is_one_clear_line(tmp_path: Path, lines: list[str], words: list[str]) -> None:
    shutil.copy(PHYSICLEAR / "properties.yaml", tmp_path)
    (tmp_path / "objects.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(UserError) as caught:
        load_catalogue(tmp_path)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"properties\.yaml.*data\.catalogue"):
        load_catalogue(tmp_path)


def test_broken_language_is_one_line(tmp_path: Path) -> None:
    shutil.copy(PHYSICLEAR / "objects.csv", tmp_path)
    for text in ("properties: [", "properties: []\nunstructured: x\nstructured: y\n", ""):
        (tmp_path / "properties.yaml").write_text(text)
        with pytest.raises(UserError, match=r"properties\.yaml") as caught:
            load_catalogue(tmp_path)
        assert "\n" not in str(caught.value)
