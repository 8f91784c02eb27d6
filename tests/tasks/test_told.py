"""Touch in words: what is told is true, and everything that is asked follows from it."""

from __future__ import annotations

import re
from collections import Counter
from itertools import product

import pytest

from pipeline.config import QuestionsConfig
from pipeline.evaluation.grading import described
from pipeline.records import Opd, Part, Prediction, Question
from pipeline.tasks import TASKS
from pipeline.tasks.questions import build_questions
from pipeline.tasks.told import in_words, made_up, told_questions
from tests.tasks.shared import CATALOGUE, POOL

COUNTS = {"OPD": 20, "PC": 60, "PSS": 60, "POM": 60}
CONFIG = QuestionsConfig(train={}, evaluation={}, facts=True, restate=True, two_turns=0.5)
LEVELS = [p.levels for p in CATALOGUE.properties]
THINGS = made_up(CATALOGUE, 4)


@pytest.fixture(scope="module")
def told() -> list[Question]:
    return told_questions(CATALOGUE, COUNTS, list(Opd), CONFIG, 4, Part.TRAIN)


def read(text: str) -> list[tuple[int, ...]]:
    """The classes in brackets, by a reader that knows the words of the properties alone."""
    found = re.findall(rf"\(({'|'.join(LEVELS[0])}), ({'|'.join(LEVELS[1])}), ({'|'.join(LEVELS[2])})\)", text)
    return [tuple(own.index(word) for own, word in zip(LEVELS, words, strict=True)) for words in found]


def test_what_is_told_are_the_classes_in_their_order(told: list[Question]) -> None:
    assert Counter(q.task for q in told) == COUNTS
    for question in told:
        (dialogue,) = question.dialogues
        assert question.videos == ()
        assert "{tactile}" not in str(dialogue)
        assert tuple(read(dialogue.turns[0].user)) == question.gold.labels
        assert not [t for t in dialogue.turns[1:] if read(t.user)]


def test_answers_follow_from_what_is_told(told: list[Question]) -> None:
    """By each task's own rule, which knows nothing of the answer."""
    for question in told:
        if question.task != "OPD":
            classes = [
                [(level, float(level)) for level in labels] for labels in read(question.dialogues[0].turns[0].user)
            ]
            last = question.dialogues[0].turns[min(1, len(question.dialogues[0].turns) - 1)]
            answer = TASKS[question.task].conclude(
                question.model_copy(
                    update={"dialogues": (question.dialogues[0].model_copy(update={"turns": (last,)}),)}
                ),
                classes,
                THINGS,
            )
            assert answer is not None
            assert last.assistant.endswith(answer)


def test_made_up_objects_have_all_combinations_and_names_of_their_own() -> None:
    every = Counter(o.labels for o in THINGS.objects.values())
    assert set(every) == set(product(*(range(len(own)) for own in LEVELS)))
    assert len(set(every.values())) == 1
    assert len({o.name for o in THINGS.objects.values()}) == len(THINGS.objects)
    assert not {o.name for o in THINGS.objects.values()} & {o.name for o in CATALOGUE.objects.values()}
    assert made_up(CATALOGUE, 4) == THINGS != made_up(CATALOGUE, 5)


def test_only_the_touch_of_a_question_is_put_in_words() -> None:
    for question in build_questions(POOL, {"OPD": 4, "PC": 8, "PSS": 8, "POM": 8, "PSR": 6}, seed=0, distinct=False):
        words = in_words(question, question.gold.labels, CATALOGUE)
        assert words.model_copy(update={"videos": question.videos, "dialogues": question.dialogues}) == question
        for before, after in zip(question.dialogues, words.dialogues, strict=True):
            assert [t.assistant for t in after.turns] == [t.assistant for t in before.turns]
            users = [re.sub(r"\([a-z ]+, [a-z ]+, [a-z ]+\)", "{tactile}", t.user) for t in after.turns]
            assert users == [t.user for t in before.turns]


def test_what_a_model_concludes_is_counted_by_task(told: list[Question]) -> None:
    """A model that is always right, one that says nothing, and one that is right where it names the first letter."""
    asked = [q for q in told if q.task in ("PC", "PSS") and len(q.dialogues[0].turns) == 1]

    def says(text: str | None) -> list[Prediction]:
        right = [q.dialogues[0].turns[-1].assistant for q in asked]
        outputs = right if text is None else [text] * len(asked)
        return [
            Prediction(question_id=q.question_id, task=q.task, outputs=(said,), truncated=False, tokens=1)
            for q, said in zip(asked, outputs, strict=True)
        ]

    counts = Counter(q.task for q in asked)
    for text, right, unread in (
        (None, dict(counts), dict.fromkeys(counts, 0)),
        ("", dict.fromkeys(counts, 0), dict(counts)),
        ("a) is the one.", {"PC": 0, "PSS": sum(q.gold.choice == "a" for q in asked)}, {"PC": counts["PC"], "PSS": 0}),
    ):
        rows = described("some model", asked, says(text), THINGS)
        assert [(r.model, r.task, r.n, r.right, r.unread) for r in rows] == [
            ("some model", task, counts[task], right[task], unread[task]) for task in ("PC", "PSS")
        ]
