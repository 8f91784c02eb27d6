"""Scenarios, pairs of unequal ripeness after the paper's question, and the paper's rice and toothbrush."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.records import Opd, Part, Question
from pipeline.report.samples import choose_examples
from pipeline.scenes.motion import make_motion
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool
from pipeline.tasks.examples import build_examples, grade_example
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.records import Assignment
from tests.conftest import CATALOGUE as PHYSICLEAR
from tests.conftest import ROOT, refused
from tests.tasks.shared import CATALOGUE, grade, predicted

TESTED = {
    split: [o for o, entry in PHYSICLEAR.objects.items() if entry.splits[split] == Part.TEST]
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
    assert asked(PHYSICLEAR.asking(source), TESTED[split]) == PAIRS[split, source]


def test_a_part_without_the_object_asks_about_its_classes() -> None:
    objects = [o for o in PHYSICLEAR.objects if o != CLOTH]
    right, wrong = asked(PHYSICLEAR.asking("published"), objects)["stains"]
    assert {PHYSICLEAR.labels(o)[:2] for o in right} == {(1, 1)} == {PHYSICLEAR.labels(CLOTH)[:2]}
    assert {PHYSICLEAR.labels(o)[:2] for o in wrong} == {(2, 2)}


def test_a_catalogues_own_scenarios_are_always_asked() -> None:
    own = tuple(s.model_copy(update={"source": ""}) for s in PHYSICLEAR.asking("ours").language.scenarios)
    catalogue = PHYSICLEAR.model_copy(update={"language": PHYSICLEAR.language.model_copy(update={"scenarios": own})})
    assert catalogue.asking("published").language.scenarios == own == catalogue.asking("ours").language.scenarios
    assert [s.name for s in PHYSICLEAR.asking("ours").language.scenarios] == ["stains", "grip", "ice"]


EXAMPLE = ROOT / "examples" / "avocado"
AVOCADOS = load_catalogue(EXAMPLE)
FRUIT = [o for o, entry in AVOCADOS.objects.items() if entry.splits["avocado"] == Part.TEST]
TALK = (
    "You will be given tactile descriptions that consist of three physical properties: hardness, roughness, bumpiness. "
    "Hardness categories in increasing hardness: soft, moderately hard, hard. Roughness categories in increasing "
    "roughness: smooth, slightly rough, rough. Bumpiness categories in increasing bumpiness: no bumps, small bumps, "
    "big bumps. Which of these properties help to determine avocado ripeness? Rank them."
)
"""As the paper prints it, but for its misprint "slightly smooth"."""


def pairs(catalogue: Catalogue, objects: list[str], count: int = 100) -> list[Question]:
    pool = Pool(Part.TEST, catalogue, {o: [f"{o}_{i}" for i in range(20)] for o in objects})
    return build_questions(pool, {"RIPE": count}, seed=0, distinct=True)


def test_pairs_have_two_ranks_and_the_softer_one_is_riper() -> None:
    questions = pairs(AVOCADOS, FRUIT)
    assert len(questions) == 100
    assert Counter(q.gold.choice for q in questions) == {"a": 50, "b": 50}
    for question in questions:
        riper = question.objects["ab".index(question.gold.choice)]
        (other,) = set(question.objects) - {riper}
        assert AVOCADOS.objects[riper].ripeness["avocado"] > AVOCADOS.objects[other].ripeness["avocado"]
        assert AVOCADOS.labels(riper)[0] < AVOCADOS.labels(other)[0]
        assert question.gold.properties == ("hardness",), "what differs among these avocados"
    # The paper's question stands before the pair.
    for question in questions[:10]:
        for mode, turns in ((Opd.NONE, 2), (Opd.NEEDED, 3), (Opd.ALL, 3)):
            dialogue = question.dialogue(mode)
            assert len(dialogue.turns) == turns
            assert dialogue.turns[0].user == TALK
            assert [turn.user.count("{tactile}") for turn in dialogue.turns] == [0, 2, 0][:turns]
    questions = pairs(PHYSICLEAR, ["avocado_unripe", "avocado_kinda_ripe", "rug", "lemon"], 20)
    assert {frozenset(q.objects) for q in questions} == {frozenset({"avocado_unripe", "avocado_kinda_ripe"})}
    assert all(q.objects["ab".index(q.gold.choice)] == "avocado_kinda_ripe" for q in questions)


@pytest.mark.parametrize("objects", [[], ["rug", "lemon"], ["avocado_1"], ["avocado_1", "avocado_3"]])
def test_without_two_ranks_nothing_is_asked(objects: list[str]) -> None:
    assert pairs(AVOCADOS, objects) == []


def test_fruits_are_read_by_their_letters() -> None:
    avocados = [o.model_copy(update={"ripeness": {"plum (c++)": 1.0}}) for o in AVOCADOS.objects.values()]
    catalogue = AVOCADOS.model_copy(update={"objects": dict(zip(AVOCADOS.objects, avocados, strict=True))})
    (question,) = pairs(AVOCADOS, FRUIT, 1)
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
        assert pressed.force[25] == pressed.force.max() > 0, "no hand lets go in the first half"


def about(**parts: Part) -> dict[str, Question]:
    split = [Assignment(video_id=f"{o}_{i}", object_id=o, part=part) for o, part in parts.items() for i in range(2)]
    return {q.question_id: q for q in build_examples(split, CATALOGUE, seed=0)}


def test_an_example_is_asked_in_both_orders_where_its_objects_have_videos() -> None:
    found = about(rice=Part.VALIDATION, toothbrush_handle=Part.TEST, toothbrush_bristles=Part.TRAIN, baseball=Part.TEST)
    assert list(found) == ["rice-a", "rice-b", "toothbrush-a", "toothbrush-b"]
    assert found["rice-a"].part == Part.VALIDATION
    assert found["toothbrush-a"].part == Part.TRAIN, "one object that was trained on is enough"
    for letter, options in (("a", "a) uncooked or b) cooked"), ("b", "a) cooked or b) uncooked")):
        rice, brush = found[f"rice-{letter}"], found[f"toothbrush-{letter}"]
        assert options in rice.dialogues[0].turns[1].user
        assert (rice.objects, rice.gold.choice, brush.gold.choice) == (("rice",), letter, letter)
        assert brush.videos["ab".index(letter)].startswith("toothbrush_handle_")
        for question in (rice, brush):
            turns = question.dialogues[0].turns
            assert sum(turn.user.count("{tactile}") for turn in turns) == len(question.videos)
            assert grade_example(question, predicted(question, "It is rough.", turns[1].assistant)).correct
        place = brush.dialogues[0].turns[0].assistant.split("b) ")["ab".index(letter)]
        assert "presents a hard and smooth surface with small bumps" in place, "the handle's rating in the paper"
    assert not {q.task for q in found.values()} & TASKS.keys(), "no figure counts them"
    assert about(toothbrush_handle=Part.TEST, rice=Part.UNUSED) == {}
    assert list(about(toothbrush_handle=Part.TEST, rice=Part.TEST)) == ["rice-a", "rice-b"]


READ = {"The rice is a), because it is rough.": "a", "the rice is  (b).": "b"}
UNREAD = ("The rice is a) or b).", "The rice is a). No, the rice is b).", "The rice is uncooked.", "The handle is a).")


@pytest.mark.parametrize(("text", "letter"), [*READ.items(), *dict.fromkeys(UNREAD, "").items()])
def test_answers_are_read_by_their_letter(text: str, letter: str) -> None:
    for question in about(rice=Part.TEST).values():
        score = grade_example(question, predicted(question, "It is rough.", text))
        assert (score.predicted, score.correct) == (letter, letter == question.gold.choice)
        assert score.parsed == bool(letter)


def test_the_answer_about_the_least_known_objects_is_shown() -> None:
    """Folds test an object under one seed and train on it under the others."""
    pairs = []
    for seed, part in enumerate((Part.TRAIN, Part.TEST, Part.TEST)):
        said = ("It is rough.", f"The rice is a), seed {seed}.")
        pairs += [(q, predicted(q, *said)) for q in about(rice=part).values()]
    found = choose_examples(pairs, CATALOGUE)
    shown = [(s["question_id"], s["part"], s["right"]) for s in found["examples"]]
    assert shown == [("rice-a", "test", True), ("rice-b", "test", False)]
    assert all(s["answered"][1].endswith("seed 1.") for s in found["examples"])
    assert found["not_asked"] == {"toothbrush": ["toothbrush_handle", "toothbrush_bristles"]}
    without = CATALOGUE.model_copy(update={"objects": {"rice": CATALOGUE.objects["rice"]}})
    assert choose_examples([], without) == {"examples": [], "not_asked": {"rice": ["rice"]}}, "it has no toothbrush"
    assert "[video A]" in found["examples"][0]["asked"][0]
