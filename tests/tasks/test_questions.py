"""Question sets: seeded, distinct, balanced, reworded by a setting; a registered task is built like the others."""

import re
import sys
from collections import Counter, defaultdict
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pipeline.cli.task import check
from pipeline.config import QuestionsConfig, SplitConfig
from pipeline.core.io import read_jsonl, write_jsonl
from pipeline.core.records import Dialogue, Opd, Part, Question, Turn
from pipeline.evaluation.grading import grade
from pipeline.tasks import TASKS, pc, psr
from pipeline.tasks.base import Pool
from pipeline.tasks.pom import fact
from pipeline.tasks.questions import CHOICES, build_questions, counts_by_task, pool_of
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.split import assign
from tests.conftest import ROOT, fake_videos, refused
from tests.tasks.shared import CATALOGUE, POOL, predicted

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


@pytest.mark.parametrize("objects", [[], ["rug"], ["rug", "potato"]])
def test_few_objects_give_few_questions_and_none_give_none(objects: list[str]) -> None:
    pool = Pool(Part.TEST, CATALOGUE, {o: [f"{o}_0"] for o in objects})
    questions = build_questions(pool, dict.fromkeys(TASKS, 40), seed=0, distinct=True)
    assert by_task(questions)["OPD"] == len(objects)
    assert not by_task(questions).keys() & {"PSS", "POM"}
    assert all(set(q.objects) <= set(objects) for q in questions)


READ = pc.read


def test_a_registered_task_is_counted_built_stored_and_graded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    # The tasks that docs/tasks.md shows whole: about one video, and about two.
    for name, text in zip(
        ("hard", "same"), (ROOT / "docs" / "tasks.md").read_text().split("```python\n")[1:], strict=True
    ):
        module = ModuleType(f"pipeline.tasks.{name}")
        exec(text.split("```")[0], vars(module))
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(TASKS, name.upper(), module.TASK)
    counts = counts_by_task(QuestionsConfig(train={}, evaluation={"hard": 6, "pc": 2}), "evaluation")
    assert counts == {**dict.fromkeys(TASKS, 0), "PC": 2, "HARD": 6}
    built = build_questions(POOL, counts, seed=0, distinct=True, facts=True)
    write_jsonl(tmp_path / "q.jsonl", built)
    questions = [q for q in read_jsonl(tmp_path / "q.jsonl", Question) if q.task == "HARD"]
    assert sorted(q.question_id for q in questions) == [f"HARD-test-{i:05d}" for i in range(6)]
    scores = grade(questions, [predicted(q, "yes") for q in questions], CATALOGUE)
    assert [s.correct for s in scores] == [CATALOGUE.labels(s.objects[0])[0] == 2 for s in scores]
    assert sum(s.correct for s in scores) == 3
    for question in questions:
        classes = [[(level, float(level)) for level in CATALOGUE.labels(question.objects[0])]]
        concluded = TASKS["HARD"].conclude(question, classes, CATALOGUE)
        assert grade([question], [predicted(question, concluded)], CATALOGUE)[0].correct
    for name in TASKS:
        assert "questions; right answers" in check(name.lower(), CATALOGUE)


def test_a_task_that_reads_too_much_or_too_little_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with refused("pcc: no task; did you mean pc. name its module in MODULES"):
        check("pcc", CATALOGUE)
    monkeypatch.setattr(pc, "read", lambda *said: {"yes": "yes"}.get(READ(*said)))
    with refused("PC: a right answer is graded wrong"):
        check("pc", CATALOGUE)
    # Any "yes" in an answer is read, also in one that says neither.
    monkeypatch.setattr(pc, "read", lambda *said: READ(*said) or ("yes" if "yes" in said[0].lower() else None))
    with refused("PC: a wrong answer is graded right: 'yes or no'"):
        check("pc", CATALOGUE)


@pytest.mark.parametrize(
    ("train", "message"),
    [
        ({"pcc": 3}, "questions.train.pcc is not a task; did you mean pc. allowed here: opd, pc, pss, pom, psr, ripe"),
        ({"psr": 3}, "questions.train.psr must be 0: PSR is for evaluation only"),
    ],
)
def test_wrong_counts_are_one_line(train: dict[str, int], message: str) -> None:
    with refused(message):
        counts_by_task(QuestionsConfig(train=train, evaluation={}), "train")
    assert counts_by_task(QuestionsConfig(train={"psr": 0}, evaluation={"psr": 3}), "train")["PSR"] == 0


def reworded(counts: dict[str, int], **how: Any) -> list[tuple[Question, Question]]:
    """Questions that a setting changes, before and after; all else of them is the same."""
    before = build_questions(POOL, counts, seed=0, distinct=False)
    after = build_questions(POOL, counts, seed=0, distinct=False, **how)
    changed = [(q, r) for q, r in zip(before, after, strict=True) if q != r]
    assert all(r.model_copy(update={"dialogues": q.dialogues}) == q for q, r in changed)
    return changed


def turns_of(question: Question) -> tuple[Turn, ...]:
    return question.dialogue(Opd.ALL).turns


def test_a_share_of_the_questions_takes_several_turns() -> None:
    """Those about several videos, where everything is described: descriptions, the question, others about the same
    videos, each with its right answer."""
    changed = reworded({"OPD": 4, "PC": 40, "PSS": 40, "POM": 40, "PSR": 6}, two_turns=0.5)
    assert {q.task for q, _ in changed} == {"PC", "PSS", "POM"}
    assert 40 < len(changed) < 80
    choices = 0
    for question, split in changed:
        assert all(split.dialogue(opd) == question.dialogue(opd) for opd in (Opd.NONE, Opd.NEEDED))
        (whole,), (first, second, *more) = turns_of(question), turns_of(split)
        said = whole.assistant.replace("First object:", "a)").replace("Second object:", "b)")
        assert f"{first.assistant} {second.assistant}" == said
        assert (first.described, second.described) == (len(first.assistant), 0)
        assert first.user.count("{tactile}") == len(question.videos)
        assert not any("{tactile}" in turn.user for turn in (second, *more))
        assert len({t.user for t in (first, second, *more)}) == len(more) + 2
        for turn in more:
            if word := turn.user.partition("Which object is ")[2].partition("?")[0]:
                choices += 1
                (place,) = [i for i, p in enumerate(CATALOGUE.properties) if word in (p.more, p.less)]
                one, other = (labels[place] for labels in question.gold.labels)
                assert one != other
                right = "a" if (one > other) == (word == CATALOGUE.properties[place].more) else "b"
                assert psr.read(turn.assistant) == right
                continue
            words = {w: p for p in CATALOGUE.properties for w in (p.more, p.less, p.most, p.least) if w in turn.user}
            gold = question.gold.model_copy(update={"properties": (words[max(words, key=len)].name,)})
            about = question.model_copy(update={"gold": gold, "dialogues": (Dialogue(opd=Opd.NONE, turns=(turn,)),)})
            classes = [[(level, level) for level in labels] for labels in question.gold.labels]
            right = TASKS[question.task].conclude(about, classes, CATALOGUE)
            assert right == turn.assistant.removeprefix("Conclusion: ")
    assert 0 < choices <= CHOICES * len(changed)


def test_classes_are_restated_before_a_conclusion() -> None:
    """Where everything was described: of the property that is asked for, with what has most of it; of a matching the
    facts of each object."""
    changed = reworded({"OPD": 4, "PC": 36, "PSS": 36, "POM": 6, "PSR": 6}, restate=True)
    assert Counter(q.task for q, _ in changed) == {"PC": 36, "PSS": 36, "POM": 6}
    for question, restated in changed:
        (*_, old), (*_, new) = turns_of(question), turns_of(restated)
        assert old.user == new.user
        if question.task == "POM":
            said = " ".join(f"{x}) {fact(CATALOGUE, o)}" for x, o in zip("abc", question.objects, strict=True))
        else:
            before, after = ([d for d in q.dialogues if d.opd is not Opd.ALL] for q in (question, restated))
            assert before == after
            prop = next(p for p in CATALOGUE.properties if p.name == question.gold.properties[0])
            names = ("first object", "second object") if question.task == "PC" else ("a)", "b)", "c)")
            levels = [labels[CATALOGUE.property_index(prop.name)] for labels in question.gold.labels]
            told = dict(zip(names, levels, strict=True))
            (word,) = (w for w in (prop.more, prop.most, prop.less, prop.least) if w in new.user)
            extreme = (max if word in (prop.more, prop.most) else min)(levels)
            ends = [n for n, level in told.items() if level == extreme]
            said = ", ".join(f"{n} {prop.levels[level]}" for n, level in told.items())
            said = f"{prop.spoken}: {said}. {word}: {ends[0] if len(ends) == 1 else 'neither'}."
        place = new.assistant.lower().index(f"{said.lower()} ")
        assert new.assistant[:place] + new.assistant[place + len(said) + 1 :] == old.assistant
    right = [predicted(q, turns_of(q)[-1].assistant) for _, q in changed]
    assert all(score.correct and score.strict for score in grade([q for _, q in changed], right, CATALOGUE))


def test_some_comparisons_are_asked_as_people_do() -> None:
    changed = reworded({"OPD": 4, "PC": 90, "PSS": 9, "POM": 6}, plainly=0.5)
    assert {q.task for q, _ in changed} == {"PC"}
    assert 30 < len(changed) < 60
    assert {turns_of(q)[0].user.startswith("{tactile} {tactile}") for _, q in changed} == {True, False}
    for question, plain in changed:
        prop = next(p for p in CATALOGUE.properties if p.name == question.gold.properties[0])
        first, second = (labels[CATALOGUE.property_index(prop.name)] for labels in question.gold.labels)
        for old, new in zip(question.dialogues, plain.dialogues, strict=True):
            (usual,), (turn,) = old.turns, new.turns
            assert turn.user.count("{tactile}") == 2
            word = turn.user.replace("{tactile}", "").strip().removeprefix("Which is ").removesuffix("?")
            assert word in (prop.more, prop.less)
            assert word in usual.user
            more = "first" if (first > second) == (word == prop.more) else "second"
            said = f"Both objects are similar in {prop.spoken}." if first == second else f"The {more} object is {word}."
            assert turn.assistant[turn.described :].removeprefix(" Conclusion: ") == said
            assert turn.assistant[: turn.described] == usual.assistant[: usual.described]
