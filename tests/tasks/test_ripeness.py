"""Ripeness: pairs of unequal ranks, after the paper's question; the example catalogue and its videos."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.records import Opd, Part, Question
from pipeline.scenes.motion import make_motion
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import Catalogue, load_catalogue
from tests.conftest import ROOT, refused
from tests.tasks.shared import grade

EXAMPLE, PHYSICLEAR = ROOT / "examples" / "avocado", ROOT / "pipeline" / "physiclear"
CATALOGUE = load_catalogue(EXAMPLE)
TESTED = [o for o, entry in CATALOGUE.objects.items() if entry.splits["avocado"] == Part.TEST]
TALK = (
    "You will be given tactile descriptions that consist of three physical properties: hardness, roughness, bumpiness. "
    "Hardness categories in increasing hardness: soft, moderately hard, hard. Roughness categories in increasing "
    "roughness: smooth, slightly rough, rough. Bumpiness categories in increasing bumpiness: no bumps, small bumps, "
    "big bumps. Which of these properties help to determine avocado ripeness? Rank them."
)
"""As the paper prints it, but for its misprint "slightly smooth"."""


def asked(catalogue: Catalogue, objects: list[str], count: int = 100) -> list[Question]:
    pool = Pool(Part.TEST, catalogue, {o: [f"{o}_{i}" for i in range(20)] for o in objects})
    return build_questions(pool, {"RIPE": count}, seed=0, distinct=True)


def test_pairs_have_two_ranks_and_the_softer_one_is_riper() -> None:
    questions = asked(CATALOGUE, TESTED)
    assert len(questions) == 100
    assert Counter(q.gold.choice for q in questions) == {"a": 50, "b": 50}
    for question in questions:
        riper = question.objects["ab".index(question.gold.choice)]
        (other,) = set(question.objects) - {riper}
        assert CATALOGUE.objects[riper].ripeness["avocado"] > CATALOGUE.objects[other].ripeness["avocado"]
        assert CATALOGUE.labels(riper)[0] < CATALOGUE.labels(other)[0]
        assert question.gold.properties == ("hardness",), "what differs among these avocados"
    # The paper's question stands before the pair.
    for question in questions[:10]:
        for mode, turns in ((Opd.NONE, 2), (Opd.NEEDED, 3), (Opd.ALL, 3)):
            dialogue = question.dialogue(mode)
            assert len(dialogue.turns) == turns
            assert dialogue.turns[0].user == TALK
            assert [turn.user.count("{tactile}") for turn in dialogue.turns] == [0, 2, 0][:turns]


def test_the_public_data_sets_two_avocados_are_a_pair() -> None:
    physiclear = load_catalogue(PHYSICLEAR)
    questions = asked(physiclear, ["avocado_unripe", "avocado_kinda_ripe", "rug", "lemon"], 20)
    assert {frozenset(q.objects) for q in questions} == {frozenset({"avocado_unripe", "avocado_kinda_ripe"})}
    assert all(q.objects["ab".index(q.gold.choice)] == "avocado_kinda_ripe" for q in questions)


@pytest.mark.parametrize("objects", [[], ["rug", "lemon"], ["avocado_1"], ["avocado_1", "avocado_3"]])
def test_without_two_ranks_nothing_is_asked(objects: list[str]) -> None:
    assert asked(CATALOGUE, objects) == []


def test_fruits_are_read_by_their_letters() -> None:
    avocados = [o.model_copy(update={"ripeness": {"plum (c++)": 1.0}}) for o in CATALOGUE.objects.values()]
    catalogue = CATALOGUE.model_copy(update={"objects": dict(zip(CATALOGUE.objects, avocados, strict=True))})
    (question,) = asked(CATALOGUE, TESTED, 1)
    assert grade(question, "The riper plum (c++) is a)", catalogue=catalogue)[0].predicted == "a"


@pytest.mark.parametrize("value", ["ripe", "-1", "1,5", "nan"])
def test_a_rank_that_is_no_number_is_one_line(tmp_path: Path, value: str) -> None:
    (tmp_path / "properties.yaml").write_text((EXAMPLE / "properties.yaml").read_text())
    header = "object_id,name,hardness,roughness,bumpiness,ripeness_kiwi"
    (tmp_path / "objects.csv").write_text(f'{header}\nkiwi,a kiwi,1,2,1,"{value}"\n')
    with refused(r"objects\.csv, line 2: ripeness_kiwi is .*larger for riper"):
        load_catalogue(tmp_path)


def test_a_hand_that_only_presses_turns_nothing() -> None:
    for seed in range(20):
        pressed, twisted = (make_motion(50, np.random.default_rng(seed), twist=twist) for twist in (False, True))
        assert set(pressed.angle) == {twisted.angle[0]}
        assert len(set(twisted.angle)) > 1
        # No hand lets go in the first half; until then a twisting one presses less and less.
        assert (pressed.force[:26] >= twisted.force[:26] - 1e-12).all()
        assert pressed.force[25] == pressed.force.max() > 0
