"""Every task grades its own answers as right and everything else as wrong or unread."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.language.chat import TACTILE
from pipeline.records import Assignment, Opd, Part, Prediction, Question, Score
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool, conclusion, find_level
from pipeline.tasks.questions import pool_of
from pipeline.videos.catalogue import load_catalogue
from tests.conftest import ROOT, fake_videos

CATALOGUE = load_catalogue(ROOT / "pipeline" / "physiclear")
POOL = pool_of(
    Part.TRAIN,
    [
        Assignment(video_id=v.video_id, object_id=v.object_id, part=Part.TRAIN)
        for v in fake_videos(sorted(CATALOGUE.objects))
    ],
    CATALOGUE,
)
HARDNESS = CATALOGUE.properties[0]


def drafted(task: str, each: int = 3, pool: Pool = POOL) -> list[Question]:
    """Some questions of every stratum."""
    definition, rng, questions = TASKS[task], random.Random(0), []
    for stratum in range(definition.strata(CATALOGUE)):
        drafts = (definition.draft(pool, stratum, rng) for _ in range(2000))
        for draft in islice(filter(None, drafts), each):
            fields = {name: getattr(draft, name) for name in ("videos", "objects", "dialogues", "gold")}
            questions.append(Question(question_id=f"{task}-{len(questions)}", task=task, part=pool.part, **fields))
    return questions


QUESTIONS = {task: drafted(task) for task in TASKS}


def answers(question: Question) -> Iterator[tuple[Opd, tuple[str, ...]]]:
    for dialogue in question.dialogues:
        yield dialogue.opd, tuple(turn.assistant for turn in dialogue.turns)


def grade(question: Question, *outputs: str) -> list[Score]:
    prediction = Prediction(
        question_id=question.question_id, task=question.task, outputs=outputs, truncated=False, tokens=1
    )
    return TASKS[question.task].grade(question, prediction, CATALOGUE)


def choice(question: Question, *outputs: str) -> Score:
    (score,) = grade(question, *outputs)
    return score


@pytest.mark.parametrize("task", list(TASKS))
def test_gold_answers_are_right_in_every_mode(task: str) -> None:
    for question in QUESTIONS[task]:
        for _, outputs in answers(question):
            for decorated in (outputs, tuple(f"  {o}\n" for o in outputs), tuple(o.upper() for o in outputs)):
                scores = grade(question, *decorated)
                assert all(s.correct and s.parsed and s.predicted == s.expected for s in scores), (decorated, scores)
                assert all(s.question_id == question.question_id and s.objects == question.objects for s in scores)


@pytest.mark.parametrize("task", list(TASKS))
def test_every_stratum_can_be_drawn(task: str) -> None:
    assert len(QUESTIONS[task]) == 3 * TASKS[task].strata(CATALOGUE)


@pytest.mark.parametrize("task", list(TASKS))
def test_prompts_show_each_video_once(task: str) -> None:
    for question in QUESTIONS[task]:
        assert len(question.videos) == len(question.objects) == len(question.gold.labels)
        assert len(set(question.objects)) == len(question.objects)
        for dialogue in question.dialogues:
            text = "".join(turn.user for turn in dialogue.turns)
            assert text.count(TACTILE) == len(question.videos)
            assert "{" not in text.replace(TACTILE, "")
            assert not any(TACTILE in turn.assistant for turn in dialogue.turns)


@pytest.mark.parametrize("task", list(TASKS))
def test_modes(task: str) -> None:
    modes = {Opd.NEEDED, Opd.ALL} if task == "OPD" else set(Opd)
    for question in QUESTIONS[task]:
        assert {d.opd for d in question.dialogues} == modes
        assert question.dialogue(Opd.ALL) is not None
        assert (question.dialogue(Opd.NONE) is None) == (task == "OPD")


@pytest.mark.parametrize("task", ["PC", "PSS", "POM"])
def test_labels_are_those_of_the_objects(task: str) -> None:
    for question in QUESTIONS[task]:
        assert question.gold.labels == tuple(map(CATALOGUE.labels, question.objects))


def test_the_extreme_is_unique() -> None:
    for question in QUESTIONS["PSS"]:
        (name,) = question.gold.properties
        index = CATALOGUE.property_index(name)
        prop = CATALOGUE.properties[index]
        levels = [labels[index] for labels in question.gold.labels]
        asked = question.dialogues[0].turns[0].user
        extreme = max(levels) if f"the {prop.most}" in asked else min(levels)
        assert levels.count(extreme) == 1
        assert levels.index(extreme) == "abc".index(question.gold.choice)


def test_the_comparison_is_true() -> None:
    for question in QUESTIONS["PC"]:
        (name,) = question.gold.properties
        index = CATALOGUE.property_index(name)
        prop = CATALOGUE.properties[index]
        first, second = (labels[index] for labels in question.gold.labels)
        rising = f" {prop.more} than" in question.dialogues[0].turns[0].user
        truth = "same" if first == second else "yes" if (first > second) == rising else "no"
        assert question.gold.choice == truth


def test_options_are_alphabetical_and_told_apart() -> None:
    for question in QUESTIONS["POM"]:
        options = sorted((CATALOGUE.objects[o].name for o in question.objects), key=str.lower)
        listed = ", ".join(f"{i}) {name}" for i, name in enumerate(options, 1))
        for dialogue in question.dialogues:
            assert dialogue.turns[0].user.endswith(f"in alphabetical order: {listed}.")
        names = [options[int(number) - 1] for number in question.gold.choice]
        assert names == [CATALOGUE.objects[o].name for o in question.objects]
        assert len(set(question.gold.labels)) == 3


def test_scenarios_prefer_what_their_classes_say() -> None:
    for question in QUESTIONS["PSR"]:
        asked = question.dialogues[0].turns[0].user
        scenario = next(s for s in CATALOGUE.language.scenarios if s.question in asked)
        right = "ab".index(question.gold.choice)
        for position, classes in ((right, scenario.target), (1 - right, scenario.other)):
            for name, allowed in classes.items():
                assert question.gold.labels[position][CATALOGUE.property_index(name)] in allowed
    assert {q.gold.choice for q in QUESTIONS["PSR"]} == {"a", "b"}


def test_a_description_is_graded_property_by_property() -> None:
    question = next(q for q in QUESTIONS["OPD"] if q.gold.labels == ((2, 0, 0),))
    scores = {
        s.measure: s for s in grade(question, "Overall, it presents a hard and slightly rough surface with no bumps.")
    }
    assert {m: s.correct for m, s in scores.items()} == {
        "hardness": True,
        "roughness": False,
        "bumpiness": True,
        "combined": False,
    }
    assert scores["roughness"].predicted == "slightly rough"
    assert scores["combined"].expected == "hard, smooth, no bumps"


@pytest.mark.parametrize(
    ("text", "level"),
    [
        ("a hard surface", 2),
        ("a moderately hard surface", 1),
        ("a Moderately  Hard surface", 1),
        ("a moderately\nhard surface", 1),
        ("a moderately-hard surface", 1),
        ("SOFT", 0),
        ("hard, very hard", 2),
        ("hard and soft", None),
        ("hard or moderately hard", None),
        ("hardly softened", None),
        ("a moderately", None),
        ("", None),
    ],
)
def test_levels_are_read_whole(text: str, level: int | None) -> None:
    assert find_level(text, HARDNESS) == level


@pytest.mark.parametrize("task", list(TASKS))
def test_an_answer_cut_off_before_its_end_is_never_right(task: str) -> None:
    """Cut before the sentence that holds the answer: wrong in every mode, whatever the descriptions said."""
    markers = {"OPD": "Overall", "PSR": "The most suitable"}
    for question in QUESTIONS[task]:
        for opd, outputs in answers(question):
            marker = markers.get(task, "Conclusion:" if opd != Opd.NONE else "")
            end = outputs[-1].index(marker) if marker else 0
            for stop in range(0, end + 1, 7):
                scores = grade(question, *outputs[:-1], outputs[-1][:stop])
                assert not any(s.correct or s.parsed for s in scores), outputs[-1][:stop]


@pytest.mark.parametrize("task", ["PC", "PSS", "POM", "PSR"])
def test_the_answer_to_another_question_is_wrong(task: str) -> None:
    by_choice = {}
    for question in QUESTIONS[task]:
        by_choice.setdefault(question.gold.choice, question)
    for question in QUESTIONS[task]:
        for other in by_choice.values():
            if other.gold.choice != question.gold.choice:
                for _, outputs in answers(other):
                    score = choice(question, *outputs)
                    assert not score.correct


@pytest.mark.parametrize("output", ["", " ", "yes", "Overall", "a)", "Conclusion:", "\x00", "🙂" * 50, "a" * 10_000])
def test_garbage_describes_nothing(output: str) -> None:
    assert not any(s.parsed or s.correct for s in grade(QUESTIONS["OPD"][0], output))


@pytest.mark.parametrize(
    "output",
    [
        *("", "Maybe.", "Not sure.", "None", "Nobody knows", "The first object is harder.", "Yesterday", "Bothersome"),
        *("Conclusion:", "Conclusion: maybe", "Yes. Conclusion: I cannot say.", "First object: Overall, yes."),
        *("Yes and no.", "yes or no", "Yes/No", "Conclusion: No / yes", "Both or no"),
    ],
)
def test_no_comparison_is_read_from(output: str) -> None:
    score = choice(QUESTIONS["PC"][0], output)
    assert not score.parsed
    assert not score.correct


def test_the_last_conclusion_counts() -> None:
    question = next(q for q in QUESTIONS["PC"] if q.gold.choice == "yes")
    assert choice(question, "Conclusion: No. Conclusion: Yes, the first object is harder.").correct
    assert not choice(question, "Conclusion: Yes. CONCLUSION : No, the second.").correct
    assert conclusion("no marker") == "no marker"


@pytest.mark.parametrize(
    "output",
    [
        "",
        "a",
        "The hardest.",
        "a), b) or c)",
        "d) is the hardest.",
        "a) is the hardest. b) is the hardest.",
        "ba) is the",
    ],
)
def test_no_superlative_is_read_from(output: str) -> None:
    score = choice(QUESTIONS["PSS"][0], output)
    assert not score.parsed
    assert not score.correct


def matching(*names: str) -> Question:
    """A matching question whose options bear these names, the videos in that order."""
    by_name = {o.name: o.object_id for o in CATALOGUE.objects.values()}
    question = QUESTIONS["POM"][0]
    order = "".join(str(sorted(names, key=str.lower).index(n) + 1) for n in names)
    gold = question.gold.model_copy(update={"choice": order})
    return question.model_copy(update={"objects": tuple(by_name[n] for n in names), "gold": gold})


def test_a_matching_must_be_whole() -> None:
    a, b, c = names = ("a tomato", "a baseball", "a lemon")
    question = matching(*names)
    assert choice(question, f"a) is {a}, b) is {b} and c) is {c}.").correct
    assert choice(question, f"c) is {c}; b) is {b}; a) is {a.upper()}").correct
    swapped = choice(question, f"a) is {b}, b) is {a} and c) is {c}.")
    assert swapped.parsed
    assert not swapped.correct
    for output in (
        f"a) is {a}, b) is {b}.",
        f"a) is {a}, b) is {b} and c) is {b}.",
        f"a) is {a}, a) is {a}, b) is {b} and c) is {c}.",
        f"a) is {a}, b) is {b} and c) is {c}s.",
        f"a) is {a}, b) is {b} and c) is a spaceship.",
        f"{a}, {b}, {c}",
        f"1) is {a}, 2) is {b} and 3) is {c}.",
    ):
        assert not choice(question, output).parsed, output


def test_a_longer_name_is_not_the_shorter_one() -> None:
    question = matching("a lanyard", "a tomato", "a potato")
    assert choice(question, "a) is a lanyard, b) is a tomato and c) is a potato.").correct
    assert not choice(question, "a) is a lanyard's card holder, b) is a tomato and c) is a potato.").parsed
    both = matching("a lanyard's card holder", "a lanyard", "a potato")
    assert choice(both, "a) is a lanyard's card holder, b) is a lanyard and c) is a potato.").correct


@pytest.mark.parametrize(
    ("output", "predicted"),
    [
        ("The most suitable object is a), because of its hardness.", "a"),
        ("The most suitable object is (b), because a) is soft.", "b"),
        ("the most suitable object is B)", "b"),
        ("The most suitable object is a) or b).", ""),
        ("The most suitable object is a) and b).", ""),
        ("The most suitable object is a). The most suitable object is b).", ""),
        ("The most suitable object is c).", ""),
        ("The most suitable object is x), because xxx", ""),
        ("The most suitable object is a hammer.", ""),
        ("a)", ""),
        ("", ""),
    ],
)
def test_what_is_read_of_a_scenario(output: str, predicted: str) -> None:
    assert choice(QUESTIONS["PSR"][0], "descriptions", output).predicted == predicted


@given(
    st.sampled_from(list(TASKS)),
    st.integers(0, 10**6),
    st.one_of(
        st.text(max_size=200),
        st.lists(
            st.sampled_from(
                ["Overall", "hard", "a)", "b)", " is ", "is the", "Conclusion:", "yes", "no", "(", "[", "\\", "*", "\n"]
            ),
            max_size=20,
        ).map(" ".join),
    ),
)
def test_no_text_crashes_a_grader(task: str, number: int, text: str) -> None:
    question = QUESTIONS[task][number % len(QUESTIONS[task])]
    for score in grade(question, text):
        assert score.parsed or (not score.correct and score.predicted == "")
        assert score.correct == (score.predicted == score.expected)


def test_truncation_is_passed_on() -> None:
    for task in TASKS:
        question = QUESTIONS[task][0]
        prediction = Prediction(question_id="x", task=task, outputs=("yes",), truncated=True, tokens=1)
        assert all(s.truncated for s in TASKS[task].grade(question, prediction, CATALOGUE))


def test_chance_is_that_of_a_uniform_guess() -> None:
    expected = {"PC": 1 / 3, "PSS": 1 / 3, "POM": 1 / 6, "PSR": 1 / 2}
    for task, value in expected.items():
        assert TASKS[task].chance(CATALOGUE) == {"choice": value}
    described = TASKS["OPD"].chance(CATALOGUE)
    assert described["combined"] == pytest.approx(1 / 27)
    assert math.prod(described[p] for p in CATALOGUE.property_names) == pytest.approx(described["combined"])


@pytest.mark.parametrize("task", list(TASKS))
def test_too_few_objects_are_no_crash(task: str) -> None:
    for objects in (["rug"], ["rug", "potato"]):
        pool = Pool(Part.TEST, CATALOGUE, {o: [f"{o}_0"] for o in objects})
        for stratum in range(TASKS[task].strata(CATALOGUE)):
            for _ in range(20):
                draft = TASKS[task].draft(pool, stratum, random.Random(0))
                assert draft is None or set(draft.objects) <= set(objects)
