"""The registry: a task that is named there once is built, counted, graded and checked like the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.config import QuestionsConfig
from pipeline.core.io import read_jsonl, write_jsonl
from pipeline.core.records import Dialogue, Opd, Question
from pipeline.evaluation.grading import grade
from pipeline.tasks import TASKS, psr
from pipeline.tasks.base import TaskDefinition
from pipeline.tasks.pom import fact
from pipeline.tasks.questions import CHOICES, build_questions, counts_by_task
from tests.conftest import ROOT, refused
from tests.tasks.shared import CATALOGUE, POOL, predicted


def own_task() -> TaskDefinition:
    """The task that docs/tasks.md shows whole."""
    names: dict[str, TaskDefinition] = {}
    exec((ROOT / "docs" / "tasks.md").read_text().split("```python\n")[1].split("```")[0], names)
    return names["TASK"]


def config(train: dict[str, int], evaluation: dict[str, int]) -> QuestionsConfig:
    return QuestionsConfig(train=train, evaluation=evaluation)


def test_a_registered_task_is_counted_built_stored_and_graded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(TASKS, "HARD", own_task())
    counts = counts_by_task(config({}, {"hard": 6, "pc": 2}), "evaluation")
    assert counts == {"OPD": 0, "PC": 2, "PSS": 0, "POM": 0, "PSR": 0, "RIPE": 0, "HARD": 6}
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
        assert concluded is not None
        assert grade([question], [predicted(question, concluded)], CATALOGUE)[0].correct


def test_another_task_changes_no_question_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = config({}, dict.fromkeys(("opd", "pc", "pss", "pom", "psr"), 4))
    before = build_questions(POOL, counts_by_task(wanted, "evaluation"), seed=0, distinct=True)
    monkeypatch.setitem(TASKS, "HARD", own_task())
    assert build_questions(POOL, counts_by_task(wanted, "evaluation"), seed=0, distinct=True) == before


@pytest.mark.parametrize(
    ("train", "message"),
    [
        ({"pcc": 3}, "questions.train.pcc is not a task; did you mean pc. allowed here: opd, pc, pss, pom, psr, ripe"),
        ({"zzz": 3}, "questions.train.zzz is not a task; allowed here: opd"),
        ({"psr": 3}, "questions.train.psr must be 0: PSR is for evaluation only"),
    ],
)
def test_wrong_counts_are_one_line(train: dict[str, int], message: str) -> None:
    with refused(message):
        counts_by_task(config(train, {}), "train")
    assert counts_by_task(config({"psr": 0}, {"psr": 3}), "train")["PSR"] == 0


def test_a_share_of_the_questions_takes_several_turns() -> None:
    """Those about several videos, where everything is described; what is said stays the same.

    Each further turn is a right question about the same videos, that was not asked before.
    """
    counts = {"OPD": 4, "PC": 40, "PSS": 40, "POM": 40, "PSR": 6}
    before, after = (build_questions(POOL, counts, seed=0, distinct=False, two_turns=s) for s in (0.0, 0.5))
    changed = [(q, r) for q, r in zip(before, after, strict=True) if q != r]
    assert {q.task for q, _ in changed} == {"PC", "PSS", "POM"}
    assert 40 < len(changed) < 80
    further, placed = 0, set[int]()
    for question, split in changed:
        assert split.model_copy(update={"dialogues": question.dialogues}) == question
        for opd in (Opd.NONE, Opd.NEEDED):
            assert split.dialogue(opd) == question.dialogue(opd)
        old, new = (q.dialogue(Opd.ALL) for q in (question, split))
        assert old
        assert new
        (whole,), (first, second, *more) = old.turns, new.turns
        further += len(more)
        assert len({t.user for t in new.turns}) == len(new.turns)
        choices = [t for t in more if t.user.startswith("Which object is ")]
        assert question.task != "PC" or len(more) == 5 + len(choices), "three properties in two directions"
        assert len(choices) <= CHOICES
        placed |= {more.index(turn) for turn in choices}
        for turn in choices:
            word = turn.user.removeprefix("Which object is ").partition("?")[0]
            (place,) = [i for i, p in enumerate(CATALOGUE.properties) if word in (p.more, p.less)]
            one, other = (labels[place] for labels in question.gold.labels)
            assert one != other
            letter = "a" if (one > other) == (word == CATALOGUE.properties[place].more) else "b"
            assert psr.read(turn.assistant) == letter
        for turn in (t for t in more if t not in choices):
            words = [w for p in CATALOGUE.properties for w in (p.more, p.less, p.most, p.least) if w in turn.user]
            (prop,) = [p for p in CATALOGUE.properties if max(words, key=len) in (p.more, p.less, p.most, p.least)]
            gold = question.gold.model_copy(update={"properties": (prop.name,)})
            about = question.model_copy(update={"gold": gold, "dialogues": (Dialogue(opd=Opd.NONE, turns=(turn,)),)})
            classes = [[(level, level) for level in labels] for labels in question.gold.labels]
            assert TASKS[question.task].conclude(about, classes, CATALOGUE) == turn.assistant.removeprefix(
                "Conclusion: "
            )
        videos = len(question.videos)
        assert (first.user.count("{tactile}"), second.user.count("{tactile}")) == (videos, 0)
        assert all(f"{letter})" in t.user for t in more if t not in choices for letter in "abc"[:videos])
        assert all(f"{letter})" in first.user and f"{letter})" in second.user for letter in "abc"[:videos])
        assert first.described == len(first.assistant)
        assert second.described == 0
        said = whole.assistant.replace("First object:", "a)").replace("Second object:", "b)")
        assert f"{first.assistant} {second.assistant}" == said
        scenario = next(d for q in before if q.task == "PSR" and (d := q.dialogue(Opd.ALL)))
        assert videos == 3 or first.user == scenario.turns[0].user
    assert further > len(changed)
    assert 0 in placed


def test_classes_are_restated_before_a_conclusion() -> None:
    """Where everything was described, of the property that is asked for; nothing else of a question changes."""
    counts = {"OPD": 4, "PC": 36, "PSS": 36, "POM": 6, "PSR": 6}
    before, after = (build_questions(POOL, counts, seed=0, distinct=False, restate=r) for r in (False, True))
    changed = [(q, r) for q, r in zip(before, after, strict=True) if q != r]
    assert {q.task for q, _ in changed} == {"PC", "PSS", "POM"}
    assert len(changed) == sum(q.task in ("PC", "PSS", "POM") for q in before)
    for question, restated in changed:
        if question.task == "POM":
            (turn,), (bare,) = (q.dialogue(Opd.ALL).turns for q in (restated, question))  # type: ignore[union-attr]
            facts = [f"{x}) {fact(CATALOGUE, o)}" for x, o in zip("abc", question.objects, strict=True)]
            assert turn.assistant.replace(" ".join((*facts, "")), "", 1) == bare.assistant
            assert turn.assistant.index(facts[0]) == bare.described + 1
            continue
        prop = next(p for p in CATALOGUE.properties if p.name == question.gold.properties[0])
        place = CATALOGUE.property_index(prop.name)
        names = ("first object", "second object") if question.task == "PC" else ("a)", "b)", "c)")
        for old, new in zip(question.dialogues, restated.dialogues, strict=True):
            described, rest = new.turns[-1].assistant, old.turns[-1].assistant
            assert [t.user for t in new.turns] == [t.user for t in old.turns]
            if old.opd is not Opd.ALL:
                assert new == old
                continue
            head, _, tail = described.partition(f" {prop.spoken.capitalize()}: ")
            said, _, conclusion = tail.rpartition(". Conclusion: ")
            assert f"{head} Conclusion: {conclusion}" == rest
            labels = [CATALOGUE.labels(o)[place] for o in question.objects]
            said, _, found = said.partition(". ")
            assert said.split(", ") == [f"{n} {prop.levels[label]}" for n, label in zip(names, labels, strict=True)]
            word, _, named = found.partition(": ")
            rising = word.lower() in (prop.more, prop.most)
            assert word.lower() in ((prop.more, prop.most) if rising else (prop.less, prop.least))
            assert word.lower() in new.turns[-1].user
            ends = [n for n, x in zip(names, labels, strict=True) if x == (max(labels) if rising else min(labels))]
            assert named == (ends[0] if len(ends) == 1 else "neither")
    right = [predicted(q, d.turns[-1].assistant) for _, q in changed if (d := q.dialogue(Opd.ALL))]
    assert all(score.correct and score.strict for score in grade([q for _, q in changed], right, CATALOGUE))


def test_some_comparisons_are_asked_as_people_do() -> None:
    """In training alone: the answer names what has more of the property, by the labels."""
    counts = {"OPD": 4, "PC": 90, "PSS": 9, "POM": 6}
    before, after = (build_questions(POOL, counts, seed=0, distinct=False, plainly=s) for s in (0.0, 0.5))
    changed = [(q, r) for q, r in zip(before, after, strict=True) if q != r]
    assert {q.task for q, _ in changed} == {"PC"}
    assert 30 < len(changed) < 60
    in_front: set[bool] = set()
    for question, plain in changed:
        prop = next(p for p in CATALOGUE.properties if p.name == question.gold.properties[0])
        first, second = (labels[CATALOGUE.property_index(prop.name)] for labels in question.gold.labels)
        for old, new in zip(question.dialogues, plain.dialogues, strict=True):
            (usual,), (turn,) = old.turns, new.turns
            asked = turn.user.removeprefix("{tactile} {tactile} ").removesuffix(" {tactile} {tactile}")
            assert turn.user.count("{tactile}") == 2
            in_front.add(turn.user.startswith("{"))
            word = asked.removeprefix("Which is ").removesuffix("?")
            assert word in (prop.more, prop.less)
            assert word in usual.user
            more = "first" if (first > second) == (word == prop.more) else "second"
            said = f"Both objects are similar in {prop.spoken}." if first == second else f"The {more} object is {word}."
            assert turn.assistant[turn.described :].removeprefix(" Conclusion: ") == said
            assert turn.assistant[: turn.described] == usual.assistant[: usual.described]
    assert in_front == {True, False}
