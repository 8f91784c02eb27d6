"""Sample answers of the full system: a rule decides which, never a person. Text only, since frames belong to those who
filmed them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from typing import Any

from pipeline.core.records import Opd, Prediction, Question
from pipeline.tasks import TASKS
from pipeline.tasks.examples import EXAMPLES, LEAST_KNOWN_FIRST, grade_example
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue

RULE = (
    "Of each task the first right and the first wrong answer, by the question's id, of the full system under its first "
    "seed, to real touch."
)


def choose_samples(answered: Iterable[tuple[Question, Prediction]], scores: Iterable[Score]) -> dict[str, Any]:
    """The content of samples.json of one variant: what `RULE` says, in the order of tasks, the right answer first."""
    told = {question.question_id: (question, said) for question, said in answered}
    first: dict[tuple[str, bool], Score] = {}
    for score in sorted(scores, key=lambda score: score.question_id):
        if score.question_id in told and score.measure == TASKS[score.task].measure:
            first.setdefault((score.task, score.correct), score)
    wanted = [first[key] for key in itertools.product(TASKS, (True, False)) if key in first]
    return {"rule": RULE, "samples": [_sample(*told[score.question_id], score) for score in wanted]}


def choose_examples(answered: Iterable[tuple[Question, Prediction]], catalogue: Catalogue) -> dict[str, Any]:
    """What samples.json says of the paper's examples: those with answers, and the objects of those without.

    Args:
        answered: by full systems, in the order of seeds. Of several answers to an example the first is shown that is
            about objects of the test part, or else of validation, or else of training.
    """
    examples: dict[str, dict[str, Any]] = {}
    for question, said in sorted(answered, key=lambda pair: LEAST_KNOWN_FIRST.index(pair[0].part)):
        if question.question_id not in examples:
            sample = _sample(question, said, grade_example(question, said))
            examples[question.question_id] = {**sample, "part": question.part}
    asked = {sample["task"] for sample in examples.values()}
    here = [e for e in EXAMPLES if catalogue.objects.keys() >= {*e.objects}]
    rest = {e.name: list(e.objects) for e in here if e.name not in asked}
    return {"examples": [examples[name] for name in sorted(examples)], "not_asked": rest}


def _sample(question: Question, said: Prediction, score: Score) -> dict[str, Any]:
    # A video's name stands where the video goes in a question's text.
    dialogue = question.dialogue(Opd.ALL) or question.dialogues[0]
    names = [f"video {chr(ord('A') + place)}" for place in range(len(question.videos))]
    waiting = iter(names)
    return {
        "task": question.task,
        "question_id": question.question_id,
        "right": score.correct,
        "asked": [re.sub(r"\{tactile\}", lambda _: f"[{next(waiting)}]", turn.user) for turn in dialogue.turns],
        "answered": list(said.outputs),
        "reference": [turn.assistant for turn in dialogue.turns],
        "expected": score.expected,
        "predicted": score.predicted,
        "truncated": said.truncated,
        "videos": dict(zip(names, question.videos, strict=True)),
    }
