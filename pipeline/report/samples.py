"""Sample answers of the full system: a rule decides which, never a person. Text only: frames belong to who filmed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from pipeline.core.records import Opd, Prediction, Question, Score
from pipeline.tasks import TASKS
from pipeline.tasks.examples import EXAMPLES, LEAST_KNOWN_FIRST, grade_example
from pipeline.videos.catalogue import Catalogue

RULE = (
    "Of each task the first right and the first wrong answer, by the question's id, of the full system under its first "
    "seed, to real touch."
)
TACTILE = "{tactile}"
"""Where a video goes in a question's text (`pipeline.core.records.Turn`)."""


def choose_samples(
    questions: Iterable[Question], predictions: Iterable[Prediction], scores: Iterable[Score]
) -> dict[str, Any]:
    """The content of samples.json of one variant: what `RULE` says, in the order of tasks, the right answer first."""
    asked = {q.question_id: q for q in questions}
    said = {p.question_id: p for p in predictions}
    graded = sorted(
        (s for s in scores if s.question_id in said and s.question_id in asked), key=lambda s: s.question_id
    )
    samples = []
    for name, task in TASKS.items():
        for right in (True, False):
            wanted = (name, task.measure, right)
            score = next((s for s in graded if (s.task, s.measure, s.correct) == wanted), None)
            if score is not None:
                samples.append(_sample(asked[score.question_id], said[score.question_id], score))
    return {"rule": RULE, "samples": samples}


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
    dialogue = question.dialogue(Opd.ALL) or question.dialogues[0]
    names = [f"video {chr(ord('A') + place)}" for place in range(len(question.videos))]
    return {
        "task": question.task,
        "question_id": question.question_id,
        "right": score.correct,
        "asked": _named([turn.user for turn in dialogue.turns], names),
        "answered": list(said.outputs),
        "reference": [turn.assistant for turn in dialogue.turns],
        "expected": score.expected,
        "predicted": score.predicted,
        "truncated": said.truncated,
        "videos": dict(zip(names, question.videos, strict=True)),
    }


def _named(texts: Sequence[str], names: Sequence[str]) -> list[str]:
    """The texts with a name in brackets where a video goes, in the order of the question's videos."""
    waiting = iter(names)
    pieces = [text.split(TACTILE) for text in texts]
    return ["".join(p if i == 0 else f"[{next(waiting)}]{p}" for i, p in enumerate(parts)) for parts in pieces]
