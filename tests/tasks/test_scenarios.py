"""Scenario questions: the published pairs, this project's own, and those of another catalogue."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import pytest

from pipeline.core.records import Part
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import Catalogue, load_catalogue
from tests.conftest import ROOT

WHOLE = load_catalogue(ROOT / "pipeline" / "physiclear")
TESTED = {
    split: [o for o, entry in WHOLE.objects.items() if entry.splits[split] == Part.TEST]
    for split in ("paper", "release")
}
BRISTLES, HANDLE, BRUSH = "hairbrush_bristles", "hairbrush_handle", "toilet_brush_bristles"
CLOTH, TOWEL, ORANGE = "microfiber_cloth", "bath_towel", "orange"
ERASER, ICE, PEG = "eraser", "ice_block", "clothes_peg"
PAIRS = {
    ("release", "published"): {
        "stains": ({CLOTH}, {BRISTLES}),
        "grip": ({BRUSH, TOWEL}, {CLOTH, ORANGE, ERASER}),
        "ice": ({HANDLE, BRISTLES}, {CLOTH, TOWEL, ORANGE, ERASER, BRUSH}),
    },
    ("paper", "published"): {
        "stains": ({CLOTH}, {BRISTLES}),
        "grip": ({BRUSH, TOWEL}, {CLOTH}),
        "ice": ({HANDLE, BRISTLES, ICE, PEG}, {CLOTH, TOWEL, BRUSH}),
    },
    ("paper", "ours"): {
        "stains": ({CLOTH}, {HANDLE, BRISTLES, ICE, PEG}),
        "grip": ({BRUSH, TOWEL, BRISTLES}, {HANDLE, ICE}),
        "ice": ({HANDLE, BRISTLES, ICE, PEG}, {CLOTH, TOWEL, BRUSH}),
    },
}
"""Split and source to the right and the wrong objects of each scenario, by hand from the constants and the labels."""


def asked(catalogue: Catalogue, objects: list[str]) -> Mapping[str, tuple[set[str], set[str]]]:
    """Right and wrong objects of each scenario over many questions."""
    pool = Pool(Part.TEST, catalogue, {o: [f"{o}_{i}" for i in range(9)] for o in objects})
    found: dict[str, tuple[set[str], set[str]]] = defaultdict(lambda: (set(), set()))
    names = {s.question: s.name for s in catalogue.language.scenarios}
    for question in build_questions(pool, {"PSR": 400}, seed=0, distinct=False):
        text = question.dialogues[0].turns[0].user
        (name,) = {n for q, n in names.items() if q in text}
        right = "ab".index(question.gold.choice)
        found[name][0].add(question.objects[right])
        found[name][1].add(question.objects[1 - right])
    return found


@pytest.mark.parametrize(("split", "source"), list(PAIRS))
def test_pairs_are_those_of_their_source(split: str, source: str) -> None:
    assert asked(WHOLE.asking(source), TESTED[split]) == PAIRS[split, source]


def test_a_part_without_the_object_asks_about_its_classes() -> None:
    objects = [o for o in WHOLE.objects if o != CLOTH]
    right, wrong = asked(WHOLE.asking("published"), objects)["stains"]
    assert {WHOLE.labels(o)[:2] for o in right} == {(1, 1)} == {WHOLE.labels(CLOTH)[:2]}
    assert {WHOLE.labels(o)[:2] for o in wrong} == {(2, 2)}


def test_a_catalogues_own_scenarios_are_always_asked() -> None:
    own = tuple(s.model_copy(update={"source": ""}) for s in WHOLE.asking("ours").language.scenarios)
    catalogue = WHOLE.model_copy(update={"language": WHOLE.language.model_copy(update={"scenarios": own})})
    assert catalogue.asking("published").language.scenarios == own == catalogue.asking("ours").language.scenarios
    assert [s.name for s in WHOLE.asking("ours").language.scenarios] == ["stains", "grip", "ice"]
