"""What follows from classes alone, against right answers and brute force; strict scores, as in the published code."""

import itertools
import random
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.records import Opd, Question
from pipeline.encoder.records import Classification
from pipeline.evaluation.grading import conclude
from pipeline.evaluation.scores import RULES, effect_rows, score_rows
from pipeline.tasks import TASKS
from pipeline.tasks.opd import as_published
from pipeline.tasks.pom import read
from pipeline.tasks.questions import build_questions
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue
from tests.conftest import classified
from tests.tasks import shared
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


EACH_TASK = {task: build_questions(POOL, {task: 12}, seed=0, distinct=True) for task in TASKS}
LABELS = st.tuples(*(st.integers(0, len(p.levels) - 1) for p in CATALOGUE.properties))
TAILS = ("", " Conclusion: yes", " The object is hard.", "\n", " USER: and more")


def graded(question: Question, *outputs: str) -> dict[str, Score]:
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
    assert {task for task, asked in EACH_TASK.items() if asked} == TASKS.keys()
    for question in (q for task in ("OPD", "PC", "PSS", "POM") for q in EACH_TASK[task]):
        for dialogue in question.dialogues:
            text = dialogue.turns[-1].assistant
            assert all(s.strict for s in graded(question, text).values())
            assert all(s.strict for s in graded(question, f"{text} And so on.").values())
            assert not any(s.strict for s in graded(question, text.upper()).values())

    # What was graded by hand has no strict score.
    for question in EACH_TASK["PSR"] + EACH_TASK["RIPE"]:
        outputs = [turn.assistant for turn in question.dialogue(Opd.ALL).turns]
        assert graded(question, *outputs)["choice"].strict is None


VERDICT = "Yes, the first object is harder."
COMPARED = {
    f"Conclusion: {VERDICT}": (True, True),
    "Conclusion: Yes.": (True, False),
    f"Conclusion: {VERDICT.lower()}": (True, False),
    VERDICT: (True, True),
    f"Conclusion: No. Conclusion: {VERDICT} No.": (True, True),
    "Conclusion: No, the second object is harder.": (False, False),
}
"""An answer, and whether it is right by rules and by the published comparison."""


def test_what_is_read_and_what_is_compared() -> None:
    questions = build_questions(POOL, {"PC": 60}, seed=1, distinct=True)
    question = next(q for q in questions if q.dialogues[0].turns[-1].assistant == VERDICT)
    scores = {said: graded(question, said)["choice"] for said in COMPARED}
    assert {said: (score.correct, score.strict) for said, score in scores.items()} == COMPARED
    question = random.Random(0).choice(EACH_TASK["POM"])
    a, b, c = (CATALOGUE.objects[o].name for o in question.objects)
    score = graded(question, f"Conclusion: b) is {b}, a) is {a} and c) is {c}.")["choice"]
    assert (score.correct, score.strict) == (True, False)


def test_what_cannot_be_cut_is_not_compared() -> None:
    """No word stands between two classes, at which the published code would cut."""
    bare = CATALOGUE.language.model_copy(update={"structured": "Overall, {hardness} {roughness} thing, {bumpiness}."})
    found = as_published("It is a hard rough thing.", (0, 0, 0), Catalogue(language=bare, objects=CATALOGUE.objects))
    assert found == dict.fromkeys((*CATALOGUE.property_names, "combined"))


def test_one_property_without_the_opening_is_wrong() -> None:
    properties = CATALOGUE.language.properties[:1]
    texts = {"structured": "Overall, it is {hardness}.", "unstructured": "It feels {hardness}.", "scenarios": ()}
    one = CATALOGUE.language.model_copy(update={**texts, "properties": properties})
    for said, right in (("Overall, it is soft.", True), ("soft.", False), ("Overall, it is hard.", False)):
        found = as_published(said, (0,), Catalogue(language=one, objects={}))
        assert found == {"hardness": right, "combined": right}


def test_names_that_begin_like_an_item_of_a_list_are_read() -> None:
    names = ("1. foam", "2. foam", "#400  sandpaper")
    said = "Conclusion: a) is 2. foam, b) is #400  sandpaper and c) is 1. foam."
    assert read(said, names) == {"a": 1, "b": 2, "c": 0}
