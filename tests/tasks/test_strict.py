"""Strict scores: the published code's comparison of texts, beside the reading by rules."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.records import Opd, Question
from pipeline.tasks import TASKS
from pipeline.tasks.opd import as_published
from pipeline.tasks.questions import build_questions
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue
from tests.tasks import shared
from tests.tasks.shared import CATALOGUE, POOL

ASKED = {task: build_questions(POOL, {task: 12}, seed=0, distinct=True) for task in TASKS}
LABELS = st.tuples(*(st.integers(0, len(p.levels) - 1) for p in CATALOGUE.properties))
TAILS = ("", " Conclusion: yes", " The object is hard.", "\n", " USER: and more")


def grade(question: Question, *outputs: str) -> dict[str, Score]:
    return {s.measure: s for s in shared.grade(question, *outputs)}


def cut_at_words(said: str, right: str) -> list[bool]:
    """The published rule once more, by the words "presents", "and" and "with" themselves."""

    def parts(text: str) -> list[str]:
        hard, rough = text.split("presents")[-1].strip().split("and")[:2]
        smooth, bumps = rough.strip().split("with")[:2]
        return [hard.strip(), smooth.strip(), bumps.strip()]

    try:
        told, wanted = parts(said), parts(right)
    except ValueError:
        return [False] * 4
    whole = said.split("presents")[-1].startswith(right.split("presents")[-1])
    return [told[0] == wanted[0], told[1] == wanted[1], told[2].startswith(wanted[2]), whole]


@given(LABELS, LABELS, st.integers(0, 400), st.sampled_from(TAILS))
def test_descriptions_are_cut_as_published(right: tuple[int, ...], said: tuple[int, ...], stop: int, tail: str) -> None:
    text = ("The surface feels firm. " + CATALOGUE.structured(said))[:stop] + tail
    assert list(as_published(text, right, CATALOGUE).values()) == cut_at_words(text, CATALOGUE.structured(right))


def test_gold_answers_are_strictly_right_and_so_is_what_follows_them() -> None:
    assert {task for task, asked in ASKED.items() if asked} == TASKS.keys()
    for question in (q for task in ("OPD", "PC", "PSS", "POM") for q in ASKED[task]):
        for dialogue in question.dialogues:
            text = dialogue.turns[-1].assistant
            assert all(s.strict for s in grade(question, text).values())
            assert all(s.strict for s in grade(question, f"{text} And so on.").values())
            assert not any(s.strict for s in grade(question, text.upper()).values())
            assert all(s.correct for s in grade(question, text.upper()).values()), "reading is tolerant"

    # What was graded by hand has no strict score.
    for question in ASKED["PSR"] + ASKED["RIPE"]:
        outputs = [turn.assistant for turn in question.dialogue(Opd.ALL).turns]
        assert grade(question, *outputs)["choice"].strict is None


VERDICT = "Yes, the first object is harder."
COMPARED = {
    f"Conclusion: {VERDICT}": (True, True),
    "Conclusion: Yes.": (True, False),
    f"Conclusion: {VERDICT.lower()}": (True, False),
    VERDICT: (True, True),
    f"conclusion: {VERDICT}": (True, False),
    f"Conclusion: No. Conclusion: {VERDICT} No.": (True, True),
    "Conclusion: No, the second object is harder.": (False, False),
}
"""An answer, and whether it is right by rules and by the published comparison."""


def test_a_comparison_is_read_and_compared() -> None:
    questions = build_questions(POOL, {"PC": 60}, seed=1, distinct=True)
    question = next(q for q in questions if q.dialogues[0].turns[-1].assistant == VERDICT)
    scores = {said: grade(question, said)["choice"] for said in COMPARED}
    assert {said: (score.correct, score.strict) for said, score in scores.items()} == COMPARED


def test_a_matching_in_another_order_is_read_but_not_compared() -> None:
    question = random.Random(0).choice(ASKED["POM"])
    a, b, c = (CATALOGUE.objects[o].name for o in question.objects)
    score = grade(question, f"Conclusion: b) is {b}, a) is {a} and c) is {c}.")["choice"]
    assert (score.correct, score.strict) == (True, False)


def test_what_cannot_be_cut_is_not_compared() -> None:
    """No word stands between two classes, at which the published code would cut."""
    bare = CATALOGUE.language.model_copy(update={"structured": "Overall, {hardness} {roughness} thing, {bumpiness}."})
    found = as_published("It is a hard rough thing.", (0, 0, 0), Catalogue(language=bare, objects=CATALOGUE.objects))
    assert found == dict.fromkeys((*CATALOGUE.property_names, "combined"))
