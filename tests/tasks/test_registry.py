"""The registry: a task that is named there once is built, counted, graded and checked like the others."""

import sys
from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pipeline.cli.task import check
from pipeline.config import QuestionsConfig
from pipeline.core.io import read_jsonl, write_jsonl
from pipeline.core.records import Dialogue, Opd, Question, Turn
from pipeline.evaluation.grading import grade
from pipeline.tasks import TASKS, pc, psr
from pipeline.tasks.pom import fact
from pipeline.tasks.questions import CHOICES, build_questions, counts_by_task
from tests.conftest import ROOT, refused
from tests.tasks.shared import CATALOGUE, POOL, predicted

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
    for readings, words in (
        ({"yes": "yes"}, "PC: a right answer is graded wrong"),
        (dict.fromkeys(("yes", "no", "same"), "yes"), "PC: a right answer is graded wrong"),
    ):
        monkeypatch.setattr(pc, "read", lambda answer, known=readings, read=READ: known.get(read(answer)))
        with refused(words):
            check("pc", CATALOGUE)
    # Any "yes" in an answer is read, also in one that says neither.
    monkeypatch.setattr(pc, "read", lambda answer: READ(answer) or ("yes" if "yes" in answer.lower() else None))
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
            facts = [f"{x}) {fact(CATALOGUE, o)}" for x, o in zip("abc", question.objects, strict=True)]
            assert new.assistant.replace(" ".join((*facts, "")), "", 1) == old.assistant
            continue
        before, after = ([d for d in q.dialogues if d.opd is not Opd.ALL] for q in (question, restated))
        assert before == after
        prop = next(p for p in CATALOGUE.properties if p.name == question.gold.properties[0])
        head, _, tail = new.assistant.partition(f" {prop.spoken.capitalize()}: ")
        said, _, conclusion = tail.rpartition(". Conclusion: ")
        assert f"{head} Conclusion: {conclusion}" == old.assistant
        names = ("first object", "second object") if question.task == "PC" else ("a)", "b)", "c)")
        levels = [labels[CATALOGUE.property_index(prop.name)] for labels in question.gold.labels]
        told, _, found = said.partition(". ")
        assert told.split(", ") == [f"{n} {prop.levels[level]}" for n, level in zip(names, levels, strict=True)]
        word, _, named = found.lower().partition(": ")
        assert word in new.user
        extreme = max(levels) if word in (prop.more, prop.most) else min(levels)
        ends = [n for n, level in zip(names, levels, strict=True) if level == extreme]
        assert named == (ends[0] if len(ends) == 1 else "neither")
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
