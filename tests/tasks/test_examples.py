"""The paper's rice and toothbrush: asked about these objects in both orders, read by the letter, shown, not counted."""

from __future__ import annotations

import pytest

from pipeline.core.records import Part, Question
from pipeline.report.samples import choose_examples
from pipeline.tasks import TASKS
from pipeline.tasks.examples import build_examples, grade_example
from pipeline.videos.records import Assignment
from tests.tasks.shared import CATALOGUE, predicted


def asked(**parts: Part) -> dict[str, Question]:
    split = [Assignment(video_id=f"{o}_{i}", object_id=o, part=part) for o, part in parts.items() for i in range(2)]
    return {q.question_id: q for q in build_examples(split, CATALOGUE, seed=0)}


def test_each_is_asked_in_both_orders_about_its_own_objects() -> None:
    found = asked(rice=Part.VALIDATION, toothbrush_handle=Part.TEST, toothbrush_bristles=Part.TRAIN, baseball=Part.TEST)
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


def test_without_videos_of_all_its_objects_an_example_is_not_asked() -> None:
    assert asked(toothbrush_handle=Part.TEST, rice=Part.UNUSED) == {}
    assert list(asked(toothbrush_handle=Part.TEST, rice=Part.TEST)) == ["rice-a", "rice-b"]


READ = {"The rice is a), because it is rough.": "a", "the rice is  (b).": "b"}
UNREAD = (
    "The rice is a) or b).",
    "The rice is a). No, the rice is b).",
    "The rice is uncooked.",
    "The handle is a).",
    "",
)


@pytest.mark.parametrize(("text", "letter"), [*READ.items(), *dict.fromkeys(UNREAD, "").items()])
def test_answers_are_read_by_their_letter(text: str, letter: str) -> None:
    for question in asked(rice=Part.TEST).values():
        score = grade_example(question, predicted(question, "It is rough.", text))
        assert (score.predicted, score.correct) == (letter, letter == question.gold.choice)
        assert score.parsed == bool(letter)


def test_the_answer_about_the_least_known_objects_is_shown() -> None:
    """Folds test an object under one seed and train on it under the others."""
    pairs = []
    for seed, part in enumerate((Part.TRAIN, Part.TEST, Part.TEST)):
        said = ("It is rough.", f"The rice is a), seed {seed}.")
        pairs += [(q, predicted(q, *said)) for q in asked(rice=part).values()]
    found = choose_examples(pairs, CATALOGUE)
    shown = [(s["question_id"], s["part"], s["right"]) for s in found["examples"]]
    assert shown == [("rice-a", "test", True), ("rice-b", "test", False)]
    assert all(s["answered"][1].endswith("seed 1.") for s in found["examples"])
    assert found["not_asked"] == {"toothbrush": ["toothbrush_handle", "toothbrush_bristles"]}
    without = CATALOGUE.model_copy(update={"objects": {"rice": CATALOGUE.objects["rice"]}})
    assert choose_examples([], without) == {"examples": [], "not_asked": {"rice": ["rice"]}}, "it has no toothbrush"
    assert "[video A]" in found["examples"][0]["asked"][0]
