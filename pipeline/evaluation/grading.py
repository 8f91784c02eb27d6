"""Grading: raw answers to scores, by each task's own grader."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.errors import UserError
from pipeline.videos.catalogue import Catalogue
from pipeline.records import WHOLE, Prediction, Question, Score
from pipeline.tasks import TASKS


def grade(questions: Sequence[Question], predictions: Sequence[Prediction], catalogue: Catalogue) -> list[Score]:
    """Grade every prediction against its question; an answer to an unknown question is a UserError."""
    known = {q.question_id: q for q in questions}
    scores: list[Score] = []
    for prediction in predictions:
        question = known.get(prediction.question_id)
        if question is None:
            raise UserError(f"{prediction.question_id}: answered but not asked; run `dvc repro` to answer anew")
        scores += TASKS[question.task].grade(question, prediction, catalogue)
    return scores


def summarise(scores: Sequence[Score]) -> dict[str, float]:
    """Accuracy by task and measure, and the shares of answers unparsed and truncated, as flat metrics."""
    metrics: dict[str, float] = {}
    for task in dict.fromkeys(s.task for s in scores):
        of_task = [s for s in scores if s.task == task]
        for measure in dict.fromkeys(s.measure for s in of_task):
            chosen = [s.correct for s in of_task if s.measure == measure]
            metrics[f"{task}.{measure}.accuracy"] = sum(chosen) / len(chosen)
        questions = {s.question_id: s for s in of_task if s.measure in WHOLE}.values()
        metrics[f"{task}.n"] = len(questions)
        metrics[f"{task}.unparsed"] = sum(not s.parsed for s in questions) / len(questions)
        metrics[f"{task}.truncated"] = sum(s.truncated for s in questions) / len(questions)
    return metrics
