"""What the audit finds in labels, ratings, descriptions and names of objects."""

from __future__ import annotations

import re

from pipeline.records import Part
from pipeline.videos.audit.labels import check_labels, similar_names
from pipeline.videos.catalogue import Catalogue
from tests.audit_records import ERROR, INFO, OTHER, WARNING, of, relabelled


def test_the_papers_counts_and_agreement_beside_the_recomputed(catalogue: Catalogue) -> None:
    findings = list(check_labels(catalogue))
    counts = [(f.item, f.measured, f.expected, f.severity) for f in of(findings, "objects of a class")]
    assert counts == [
        ("hardness: soft", "11", "26", WARNING),
        ("hardness: moderately hard", "31", "14", WARNING),
        ("hardness: hard", "32", "34", WARNING),
        ("roughness: smooth", "28", "36", WARNING),
        ("roughness: slightly rough", "23", "16", WARNING),
        ("roughness: rough", "23", "22", WARNING),
        ("bumpiness: no bumps", "25", "26", WARNING),
        ("bumpiness: small bumps", "38", "34", WARNING),
        ("bumpiness: big bumps", "11", "14", WARNING),
    ]
    agreement = of(findings, "agreement, ICC(3,k)")
    assert [(f.item, f.measured.split()[0], f.expected, f.severity) for f in agreement] == [
        ("hardness", "0.893", "0.894", WARNING),
        ("roughness", "0.979", "0.979", INFO),
        ("bumpiness", "0.773", "0.792", WARNING),
    ]
    for f in agreement:
        value, low, high = map(float, re.findall(r"0\.\d{3}", f.measured))
        assert low < value < high


def test_the_catalogues_stated_labels_and_splits(catalogue: Catalogue) -> None:
    findings = list(check_labels(catalogue))
    stated = of(findings, "stated label")
    assert [(f.item, f.measured, f.expected, f.severity) for f in stated] == [
        ("gauze_pad: hardness", "hard (mean rating 1.67)", "moderately hard", WARNING)
    ]
    differing = {f.item for f in of(findings, "splits differ")}
    assert differing == {"bubble_wrap", "clothes_peg", "eraser", "ice_block", "lemon", "orange"}
    assert not any(f.severity is ERROR for f in findings)


def test_descriptions_that_contradict_the_roughness(catalogue: Catalogue) -> None:
    found = [f for f in of(list(check_labels(catalogue)), "description") if f.item.endswith(": roughness")]
    assert {f.item.removesuffix(": roughness") for f in found} == {
        *("rubber_bands", "clothes_peg", "aluminium_foil", "controller_keypad"),
        *("controller_buttons", "nylon_shirt", "cotton_ball", "pen_pad"),
    }
    for f in found:
        assert f.measured.startswith("rated slightly rough (")
        assert (f.expected, f.severity) == ("described as smooth", WARNING)


def test_labels_of_other_data_are_not_held_against_the_paper() -> None:
    for check in ("objects of a class", "agreement, ICC(3,k)"):
        assert {f.expected for f in of(list(check_labels(OTHER)), check)} == {""}


def test_agreement_is_undefined_without_variance_or_with_one_rating() -> None:
    for ratings in (((1,), (0,), (2,)), ((1, 1, 1),) * 3):
        same = relabelled(OTHER, ratings=ratings)
        found = of(list(check_labels(same)), "agreement, ICC(3,k)")
        assert [f.measured for f in found] == ["undefined: one rating, or no variance"] * 3
        assert {f.severity for f in found} == {INFO}


def test_agreement_is_undefined_where_numbers_of_ratings_differ() -> None:
    objects = dict(OTHER.objects)
    rug = objects["rug"]
    objects["rug"] = rug.model_copy(update={"ratings": (rug.ratings[0][:2], *rug.ratings[1:])})
    found = of(list(check_labels(Catalogue(language=OTHER.language, objects=objects))), "agreement, ICC(3,k)")
    assert found[0].measured == "undefined: objects have different numbers of ratings"
    assert all(re.match(r"-?\d\.\d{3} \(", f.measured) for f in found[1:])


def test_a_class_that_nobody_chose_is_a_warning() -> None:
    same = relabelled(OTHER, ratings=((0, 0),) * 3)
    found = of(list(check_labels(same)), "objects of a class")
    assert [f.severity for f in found] == [INFO, WARNING, WARNING] * 3


def test_stated_labels_are_compared_where_there_are_any() -> None:
    assert of(list(check_labels(relabelled(OTHER, stated=(None, None, None)))), "stated label") == []
    right = {o: e.model_copy(update={"stated": e.labels}) for o, e in OTHER.objects.items()}
    assert of(list(check_labels(Catalogue(language=OTHER.language, objects=right))), "stated label") == []


def test_a_part_that_lacks_a_class() -> None:
    same = relabelled(OTHER, ratings=((0, 0),) * 3, splits={"mine": Part.TEST})
    found = of(list(check_labels(same)), "classes of a part")
    assert [f.item for f in found] == [f"mine, test: {p}" for p in ("hardness", "roughness", "bumpiness")]
    assert found[0].measured == "no moderately hard or hard"


def test_a_name_that_is_nearly_in_the_catalogue(catalogue: Catalogue) -> None:
    found = list(similar_names(["cotton_bal", "yoyo", "hairbrush_handles"], catalogue))
    assert [(f.item, f.expected, f.severity) for f in found] == [
        ("cotton_bal", "cotton_ball?", WARNING),
        ("hairbrush_handles", "hairbrush_handle?", WARNING),
    ]
