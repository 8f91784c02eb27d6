"""Question sets: seeded, distinct, balanced, and only about the videos of their part."""

import itertools
import re
from collections import Counter, defaultdict
from statistics import fmean

import numpy as np
import pytest

from pipeline.config import SplitConfig
from pipeline.core.records import Part, Question
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.split import assign
from tests.conftest import fake_videos
from tests.tasks.shared import CATALOGUE

VIDEOS = fake_videos(sorted(CATALOGUE.objects), 5)
ASSIGNMENTS = assign(CATALOGUE, VIDEOS, SplitConfig(name="paper"))
COUNTS = {"OPD": 40, "PC": 36, "PSS": 36, "POM": 36, "PSR": 12}
POOLS = {part: pool_of(part, ASSIGNMENTS, CATALOGUE) for part in (Part.TRAIN, Part.VALIDATION, Part.TEST)}


def key(question: Question) -> tuple[object, ...]:
    last = question.dialogues[-1].turns[-1]
    situation = "" if "{tactile}" in last.user else last.user
    return question.task, question.videos, question.gold.properties, last.assistant, situation


def by_task(questions: list[Question]) -> Counter[str]:
    return Counter(q.task for q in questions)


@pytest.mark.parametrize("part", list(POOLS))
def test_questions_stay_in_their_part(part: Part) -> None:
    own = {a.video_id for a in ASSIGNMENTS if a.part == part}
    questions = build_questions(POOLS[part], COUNTS, seed=1, distinct=part != Part.TRAIN)
    assert questions
    for question in questions:
        assert question.part == part
        assert set(question.videos) <= own
        assert [v.rpartition("_")[0] for v in question.videos] == list(question.objects)
    assert len({q.question_id for q in questions}) == len(questions)


def test_counts_are_met_where_there_is_enough_to_ask_and_tasks_are_mixed() -> None:
    train = build_questions(POOLS[Part.TRAIN], COUNTS, seed=1, distinct=False)
    assert by_task(train) == COUNTS
    assert len({q.task for q in train[:20]}) > 2
    test = by_task(build_questions(POOLS[Part.TEST], COUNTS, seed=1, distinct=True))
    assert test["OPD"] == 35, "each of the 35 videos is described once"
    assert all(test[task] == COUNTS[task] for task in ("PC", "POM", "PSR"))


def test_questions_follow_from_the_seed_and_hang_on_no_other_task() -> None:
    first, again, other = (build_questions(POOLS[Part.TEST], COUNTS, seed=s, distinct=True) for s in (1, 1, 2))
    assert first == again
    assert {key(q) for q in first} != {key(q) for q in other}
    alone = build_questions(POOLS[Part.TEST], {"POM": 36}, seed=1, distinct=True)
    assert {key(q) for q in alone} == {key(q) for q in first if q.task == "POM"}


def test_questions_of_two_folds_share_no_id_and_no_object() -> None:
    config, asked = SplitConfig(name="kfold", folds=3), []
    for seed in (0, 1, 3):
        pool = pool_of(Part.TEST, assign(CATALOGUE, VIDEOS, config, seed), CATALOGUE)
        asked.append(build_questions(pool, COUNTS, seed=1, distinct=True, fold=config.fold_of(seed)))
    first, other, again = asked
    assert first == again, "seeds of one fold answer the same questions"
    assert not {q.question_id for q in first} & {q.question_id for q in other}
    assert not {o for q in first for o in q.objects} & {o for q in other for o in q.objects}


def test_distinct_questions_differ_in_more_than_wording() -> None:
    for part in (Part.VALIDATION, Part.TEST):
        questions = build_questions(POOLS[part], dict.fromkeys(TASKS, 100), seed=3, distinct=True)
        assert len({key(q) for q in questions}) == len(questions)
    # Two scenarios about the same classes may ask about the same videos.
    first = next(s for s in CATALOGUE.language.scenarios if len(s.target) == 1)
    scenarios = tuple(first.model_copy(update={"name": n, "question": f"Which suits {n}?"}) for n in ("one", "two"))
    language = CATALOGUE.language.model_copy(update={"scenarios": scenarios})
    pool = pool_of(Part.TEST, ASSIGNMENTS, Catalogue(language=language, objects=CATALOGUE.objects))
    asked = build_questions(pool, {"PSR": 500}, seed=0, distinct=True)
    assert len({key(q)[:-1] for q in asked}) < len({key(q) for q in asked}) == len(asked)


def test_strata_are_balanced() -> None:
    counts = {"OPD": 120, "PC": 180, "PSS": 180, "POM": 180, "PSR": 60}
    questions = build_questions(POOLS[Part.TRAIN], counts, seed=5, distinct=False)
    for task, choices in (("PC", 3), ("PSS", 3), ("POM", 6), ("PSR", 2)):
        found = Counter(q.gold.choice for q in questions if q.task == task)
        assert [*found.values()] == [counts[task] / choices] * choices
    for task in ("PC", "PSS"):
        found = Counter(q.gold.properties for q in questions if q.task == task)
        assert set(found.values()) == {60}
    described = Counter(q.objects for q in questions if q.task == "OPD")
    assert [*described.values()] == [2] * 60, "every object of the part is described equally often"


def test_facts_stand_before_the_same_matching_questions() -> None:
    plain = build_questions(POOLS[Part.TEST], COUNTS, seed=1, distinct=True)
    told = build_questions(POOLS[Part.TEST], COUNTS, seed=1, distinct=True, facts=True)
    orders = set()
    for without, question in zip(plain, told, strict=True):
        if question.task != "POM":
            assert question == without
            continue
        assert question.model_copy(update={"dialogues": without.dialogues}) == without
        for bare, dialogue in zip(without.dialogues, question.dialogues, strict=True):
            facts = dialogue.turns[0].user.removesuffix(bare.turns[0].user)
            assert facts != dialogue.turns[0].user
            assert dialogue.turns[0].assistant == bare.turns[0].assistant
            for object_id in question.objects:
                levels = zip(CATALOGUE.properties, CATALOGUE.labels(object_id), strict=True)
                classes = ", ".join(p.levels[level] for p, level in levels)
                assert f"{classes} is {CATALOGUE.objects[object_id].name}." in facts
        first = [facts.index(f" {CATALOGUE.objects[o].name}.") for o in question.objects]
        orders.add(tuple(sorted(range(3), key=first.__getitem__)))
    assert len(orders) == 6, "the order of the facts gives nothing away"


def test_texts_stand_in_place_of_phrases_and_change_nothing_else() -> None:
    """Every second object's texts are its phrases but for one letter, so that no length changes."""
    own = {o: CATALOGUE.unstructured(o) for o in sorted(CATALOGUE.objects)[::2]}
    texts = {o: tuple(text.replace("surface", f"surfac{n}") for n in range(3)) for o, text in own.items()}
    catalogue = Catalogue(language=CATALOGUE.language, objects=CATALOGUE.objects, texts=texts)
    drawn = defaultdict(set)
    for part, counts, more in ((Part.TEST, COUNTS, {}), (Part.TRAIN, {"PC": 60}, {"two_turns": 0.4, "restate": True})):
        pools = (pool_of(part, ASSIGNMENTS, c) for c in (catalogue, CATALOGUE))
        told, plain = (build_questions(pool, counts, seed=1, distinct=not more, **more) for pool in pools)
        for question, other in zip(told, plain, strict=True):
            said = question.model_dump_json()
            assert re.sub(r"surfac\d", "surface", said) == other.model_dump_json()
            kind = question.task, len(question.dialogues[-1].turns) > 1, *question.objects[: question.task == "OPD"]
            drawn[kind] |= {*re.findall(r"surfac(\d)", said)}
    assert all(len(found) > 1 for found in drawn.values() if found), "each question draws anew"


def test_inexact_facts_leave_the_right_matching_the_nearest() -> None:
    exact, told = (
        build_questions(POOLS[Part.TRAIN], {"POM": 200}, seed=1, distinct=True, facts=True, inexact=chance)
        for chance in (0.0, 0.35)
    )
    levels = [p.levels for p in CATALOGUE.properties]
    off = list[int]()
    for before, question in zip(exact, told, strict=True):
        assert (question.videos, question.gold) == (before.videos, before.gold)
        said = {}
        for object_id in question.objects:
            name = CATALOGUE.objects[object_id].name
            words = question.dialogues[0].turns[0].user.split(f" is {name}.")[0].split(". ")[-1].split(", ")
            said[object_id] = np.array([own.index(word) for own, word in zip(levels, words, strict=True)])
        right = np.array([CATALOGUE.labels(o) for o in question.objects])
        orders = itertools.permutations(question.objects)
        distance = {order: int(np.abs([said[o] for o in order] - right).sum()) for order in orders}
        assert sorted(distance.values())[1] > distance[question.objects] == min(distance.values())
        assert np.abs([said[o] for o in question.objects] - right).max() <= 1
        off.append(distance[question.objects])
    # Of nine classes a question, where .35 of each are drawn off and some drawings are refused.
    assert 1.5 < fmean(off) < 9 * 0.35


@pytest.mark.parametrize("objects", [[], ["rug"], ["rug", "potato"]])
def test_few_objects_give_few_questions_and_none_give_none(objects: list[str]) -> None:
    pool = Pool(Part.TEST, CATALOGUE, {o: [f"{o}_0"] for o in objects})
    questions = build_questions(pool, dict.fromkeys(TASKS, 40), seed=0, distinct=True)
    assert by_task(questions)["OPD"] == len(objects)
    assert not by_task(questions).keys() & {"PSS", "POM"}
    assert all(set(q.objects) <= set(objects) for q in questions)
