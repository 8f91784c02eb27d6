"""Grading: raw answers to scores, by each task's own grader."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.errors import UserError
from pipeline.records import Prediction, Question, Score
from pipeline.tasks import TASKS
from pipeline.videos.catalogue import Catalogue


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
