"""Grading: raw answers to scores, by each task's own grader."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.core.io import fingerprint, read_json, read_jsonl
from pipeline.core.records import Prediction, Question
from pipeline.encoder.records import Classification
from pipeline.evaluation.records import GradedVision, Shown, VisionModel
from pipeline.running.errors import UserError
from pipeline.tasks import TASKS
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue

SOURCE_FILE = "source.json"


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


def conclude(questions: Sequence[Question], classified: Iterable[Classification], catalogue: Catalogue) -> list[Score]:
    """Grade what follows from the heads' classes by each task's rule, without a language model.

    Questions about a video that the heads said nothing of, and tasks without a rule, have no score.

    Args:
        classified: Of the videos that the questions are about.
        catalogue: As `TaskDefinition.conclude` takes it.
    """
    said: dict[str, dict[str, tuple[int, float]]] = defaultdict(dict)
    for c in classified:
        said[c.video_id][c.property] = (c.predicted, sum(i * p for i, p in enumerate(c.probabilities)))
    predictions = []
    for q in questions:
        if all(video in said for video in q.videos):
            classes = [[said[video][name] for name in catalogue.property_names] for video in q.videos]
            if (told := TASKS[q.task].conclude(q, classes, catalogue)) is not None:
                answer = Prediction(question_id=q.question_id, task=q.task, outputs=(told,), truncated=False, tokens=0)
                predictions.append(answer)
    return grade(questions, predictions, catalogue)


def vision_models(folder: Path) -> dict[Path, VisionModel]:
    """The models with answers in a report's folder in `EXTERNAL`, by their own folders; empty where there are none.

    Raises:
        UserError: for a source.json that is none.
    """
    found = {}
    for file in sorted(folder.glob(f"*/{SOURCE_FILE}")):
        try:
            found[file.parent] = VisionModel.model_validate(read_json(file))
        except ValidationError:
            raise UserError(f"{file}: does not say who answered; run `octopi answer-with` again") from None
    return found


def grade_vision_models(
    folder: Path,
    questions: Mapping[int, Path],
    replicate_of: Callable[[int], int],
    catalogue: Catalogue,
    frames_now: Callable[[Path], tuple[str, int]],
) -> list[GradedVision]:
    """Grade what `vision_models` answered; answers to other questions, or about other frames, are left out with a
    warning.

    Args:
        folder: Of a report in `EXTERNAL`.
        questions: The file of evaluation questions of each seed.
        replicate_of: Maps a seed to the replicate that its answers are pooled under.
        frames_now: Gives the `frames_key` of a folder, and `frames.per_video`.
    """
    graded = []
    for place, source in vision_models(folder).items():
        seen = (source.frames, source.per_video)
        if source.shown is Shown.FRAMES and seen != frames_now(Path(source.folder)):
            logging.warning(f"{place}: saw other frames than there are now; run `octopi answer-with` again")
            continue
        for seed, file in questions.items():
            if source.questions.get(str(seed)) != fingerprint(file):
                lacks = f"no answers to the questions of seed {seed} as they are now"
                logging.warning(f"{place}: {lacks}; run `octopi answer-with` again")
                continue
            whose: dict[str, Any] = {"model": source.model, "shown": source.shown, "seed": replicate_of(seed)}
            scores = grade(read_jsonl(file, Question), read_jsonl(place / f"{seed}.jsonl", Prediction), catalogue)
            graded += [GradedVision(**score.model_dump(), **whose) for score in scores]
    return graded
