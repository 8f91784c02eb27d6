"""`octopi task check NAME`: questions of a task are built, and right and wrong answers to them graded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pipeline.core.records import Part, Prediction, Question
from pipeline.running.errors import UserError, did_you_mean
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool, TaskDefinition
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import Catalogue

EACH = 3
"""Questions of each kind."""
UNREAD = ("", "I cannot tell.", "yes or no", "a) or b)", "Conclusion:")
"""Answers that choose nothing."""


def check(name: str, catalogue: Catalogue) -> str:
    """Say what was tried; UserError for a name that is no task, or the first answer that is not graded as it should."""
    known = {key.lower(): task for key, task in TASKS.items()}
    if not (task := known.get(name.lower())):
        hint = did_you_mean(name.lower(), known)
        raise UserError(f"{name}: no task; {hint}name its module in MODULES of pipeline/tasks/__init__.py")
    pool = Pool(Part.TEST, catalogue, {o: [f"{o}_0"] for o in catalogue.objects})
    questions = build_questions(pool, {task.name: EACH * task.strata(catalogue)}, seed=0, distinct=True)
    wrong = (problem for q in questions for problem in _problems(task, q, questions, catalogue))
    if problem := next(wrong, "" if questions else "draft makes no question of the catalogue's objects"):
        raise UserError(f"{task.name}: {problem}")
    return f"{task.name}: {len(questions)} questions; right answers to them are graded right, and wrong ones wrong"


def _problems(
    task: TaskDefinition, question: Question, others: Sequence[Question], catalogue: Catalogue
) -> Iterator[str]:
    def right(*said: str) -> bool:
        given = Prediction(question_id=question.question_id, task=task.name, outputs=said, truncated=False, tokens=1)
        scores = task.grade(question, given, catalogue)
        return {s.measure for s in scores} == {*task.chance(catalogue)} and all(s.correct for s in scores)

    before: list[str] = []
    for dialogue in question.dialogues:
        asked, said = "".join(t.user for t in dialogue.turns), [t.assistant for t in dialogue.turns]
        *before, last = said
        if asked.count("{tactile}") != len(question.videos):
            yield f"not once {{tactile}} for each of {len(question.videos)} videos: {asked!r}"
        for text in (last, last.upper(), f"**{last}**\n"):
            if not right(*before, text):
                yield f"a right answer is graded wrong, or by other measures than those of chance: {text!r}"
        unlike = (o.dialogue(dialogue.opd) for o in others if _right(o) != _right(question))
        for text in (*UNREAD, *(d.turns[-1].assistant for d in unlike if d)):
            if right(*before, text):
                yield f"a wrong answer is graded right: {text!r} to {asked!r}"
    classes = [[(level, float(level)) for level in catalogue.labels(o)] for o in question.objects]
    ruled = task.conclude(question, classes, catalogue)
    if ruled is not None and not right(*before, ruled):
        yield f"what conclude says of the true classes is graded wrong: {ruled!r}"


def _right(question: Question) -> object:
    return question.gold.choice or question.gold.labels
