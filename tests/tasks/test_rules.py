"""What follows from classes alone, held against the questions' own right answers and against brute force."""

from __future__ import annotations

import itertools
import random
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.encoder.records import Classification
from pipeline.evaluation.grading import conclude
from pipeline.evaluation.scores import RULES, effect_rows, score_rows
from pipeline.tasks import TASKS
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import Catalogue
from tests.conftest import classified
from tests.tasks.shared import CATALOGUE, POOL

ASKED = {"OPD": 60, "PC": 120, "PSS": 120, "POM": 60, "PSR": 40}
QUESTIONS = build_questions(POOL, ASKED, seed=0, distinct=False)


def heads(
    levels: dict[str, tuple[int, ...]], means: dict[str, tuple[float, ...]] | None = None
) -> list[Classification]:
    """Heads that are sure, or whose probabilities have these means (0 to 2) over the first and the last class."""
    said = []
    for object_id, classes in levels.items():
        for place, prop in enumerate(CATALOGUE.properties):
            mean = means[object_id][place] if means else classes[place]
            sure = tuple(float(k == classes[place]) for k in range(3))
            probabilities = (1 - mean / 2, 0.0, mean / 2) if means else sure
            said.append(classified(f"{object_id}_0", prop.name, 0, classes[place], probabilities))
    return said


TRUE = {o: CATALOGUE.labels(o) for o in CATALOGUE.objects}


def shuffled(seed: int) -> dict[str, tuple[int, ...]]:
    labels = list(TRUE.values())
    random.Random(seed).shuffle(labels)
    return dict(zip(TRUE, labels, strict=True))


def test_objects_called_by_number_are_matched_like_others() -> None:
    numbered = CATALOGUE.called("number")
    questions = build_questions(replace(POOL, catalogue=numbered), {"POM": 40}, seed=1, distinct=True, facts=True)
    for question in questions:
        said = question.dialogues[0].turns[0].user
        assert set(re.findall(r"object \d+", said)) == {numbered.objects[o].name for o in question.objects}
        assert not any(CATALOGUE.objects[o].name in said for o in question.objects)
    assert all(s.correct for s in conclude(questions, heads(TRUE), numbered))
    # Options are listed by name, so a grader that takes other names reads another order.
    assert not all(s.correct for s in conclude(questions, heads(TRUE), CATALOGUE))


def test_right_classes_lead_to_right_answers_in_the_words_of_right_answers() -> None:
    scores = conclude(QUESTIONS, heads(TRUE), CATALOGUE)
    assert {s.task for s in scores} == ASKED.keys()
    assert len({s.question_id for s in scores}) == len(QUESTIONS)
    assert [s for s in scores if not s.correct or s.strict is False] == []


def test_wrong_classes_are_matched_at_the_least_cost() -> None:
    """Against all orders of the three names; where two cost the least, neither is held to be the answer."""
    levels = shuffled(1)
    found = {s.question_id: s for s in conclude(QUESTIONS, heads(levels), CATALOGUE) if s.measure == "choice"}
    for q in (q for q in QUESTIONS if q.task == "POM"):
        said = [levels[o] for o in q.objects]
        options = sorted(q.objects, key=lambda o: CATALOGUE.objects[o].name.lower())
        true = np.array([TRUE[o] for o in options])
        orders = list(itertools.permutations(range(3)))
        costs = [np.abs(said - true[list(order)]).sum() for order in orders]
        best = ["".join(str(n + 1) for n in o) for o, cost in zip(orders, costs, strict=True) if cost == min(costs)]
        if len(best) == 1:
            assert found[q.question_id].predicted == best[0], q.question_id


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_the_right_answers_are_not_looked_at(seed: int) -> None:
    labels = shuffled(seed)
    ratings = {o: tuple((level,) for level in labels[o]) for o in TRUE}
    objects = {o: entry.model_copy(update={"ratings": ratings[o]}) for o, entry in CATALOGUE.objects.items()}
    relabelled = Catalogue(language=CATALOGUE.language, objects=objects)
    asked = [q for q in QUESTIONS if q.task in ("PC", "PSS")]
    blind = [q.model_copy(update={"gold": q.gold.model_copy(update={"choice": "", "labels": ()})}) for q in asked]
    seen, unseen = conclude(asked, heads(shuffled(7)), CATALOGUE), conclude(blind, heads(shuffled(7)), relabelled)
    assert [s.predicted for s in seen] == [s.predicted for s in unseen]


@pytest.mark.parametrize("task", ["PSS", "POM", "PSR"])
def test_among_equal_classes_the_mean_class_decides(task: str) -> None:
    levels, means = dict.fromkeys(TRUE, (1, 1, 1)), {o: tuple(map(float, labels)) for o, labels in TRUE.items()}
    asked = [q for q in QUESTIONS if q.task == task]
    scores = conclude(asked, heads(levels, means), CATALOGUE)
    assert len(scores) == len(asked) > 30
    assert all(s.correct for s in scores)


def test_a_scenario_whose_question_begins_like_anothers_does_not_answer_for_it() -> None:
    language = CATALOGUE.language
    decoys = [
        s.model_copy(update={"name": f"{s.name} 2", "question": s.question[:-4], "target": s.other, "other": s.target})
        for s in language.scenarios
    ]
    longer = language.model_copy(update={"scenarios": (*decoys, *language.scenarios)})
    catalogue = CATALOGUE.model_copy(update={"language": longer})
    asked = [q for q in QUESTIONS if q.task == "PSR"]
    assert conclude(asked, heads(TRUE), catalogue) == conclude(asked, heads(TRUE), CATALOGUE)


def test_a_video_that_the_heads_said_nothing_of_and_a_task_without_a_rule_have_no_score() -> None:
    some = dict(list(TRUE.items())[:40])
    scored = {s.question_id for s in conclude(QUESTIONS, heads(some), CATALOGUE)}
    assert scored == {q.question_id for q in QUESTIONS if some.keys() >= {*q.objects}}
    fruit = QUESTIONS[0].model_copy(update={"task": "RIPE"})
    assert conclude([fruit], heads(TRUE), CATALOGUE) == []


def test_rules_are_a_system_of_their_own_in_scores_and_effects() -> None:
    concluded = {0: conclude(QUESTIONS, heads(shuffled(1)), CATALOGUE)}
    rows = score_rows([], CATALOGUE, concluded=concluded)
    assert {(r.encoder, r.lora, r.opd, r.touch) for r in rows} == {("finetuned", "", "", "real")}
    for task in ASKED:
        (row,) = (r for r in rows if (r.task, r.measure, r.seed) == (task, TASKS[task].measure, "all"))
        own = [s.correct for s in concluded[0] if (s.task, s.measure) == (task, TASKS[task].measure)]
        assert row.accuracy == pytest.approx(sum(own) / len(own), abs=1e-6)
    assert RULES.lora == ""
    assert effect_rows([], CATALOGUE, concluded) == []
