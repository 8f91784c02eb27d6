"""The run's evaluation questions for any other model, and its answers, which are graded beside the chain's own.

Answers are written to `external/`, which the stages `grade` and `report` read: no stage asks a network.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from pydantic import ValidationError

from pipeline.config import Params
from pipeline.core.io import fingerprint, read_jsonl, read_table, write_json, write_jsonl, write_text
from pipeline.core.layout import EXTERNAL, VIDEOS, questions_file
from pipeline.core.records import Opd, Prediction, Question, Record
from pipeline.evaluation.grading import SOURCE_FILE
from pipeline.evaluation.records import Shown, VisionModel
from pipeline.running.errors import UserError, counted, first_problem
from pipeline.videos.records import Video


class Told(Record):
    """A line of a file of answers."""

    id: str
    text: str | tuple[str, ...]
    """The answer; to a question of several turns one for each, or the last alone."""


def asked(params: Params) -> dict[int, list[Question]]:
    """The evaluation questions of each seed; UserError where the chain has not built them."""
    return {seed: read_jsonl(questions_file(seed), Question) for seed in params.ablation.seeds}


def turns_of(question: Question) -> list[str]:
    """What is asked, turn by turn, as the full system is asked; every task has this mode."""
    return [turn.user for turn in next(d for d in question.dialogues if d.opd is Opd.ALL).turns]


def export(params: Params, file: Path) -> str:
    """Write the questions as JSON lines, without their answers: `id`, `task`, `turns` and `videos`.

    In a turn `{tactile}` stands for the next video. Returns a line that says what was done.
    """
    paths = {v.video_id: Path(params.data.dir, v.path).as_posix() for v in read_table(VIDEOS, Video)}
    questions = {q.question_id: q for own in asked(params).values() for q in own}
    lines = [
        json.dumps({"id": i, "task": q.task, "turns": turns_of(q), "videos": [paths[v] for v in q.videos]})
        for i, q in questions.items()
    ]
    write_text(file, "\n".join(lines) + "\n")
    return (
        f"{file}: {counted(len(lines), 'question')}; answer each as a line with id and text, `octopi questions grade`"
    )


def take(params: Params, file: Path, name: str) -> str:
    """Put answers beside the chain's own, as `name`; returns a line that says what was done.

    Raises:
        UserError: for a line that is no answer, an id that is not asked or twice there, or a question without answer.
    """
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise UserError(f"--name {name}: is a folder's name, too; write letters, digits, dots, hyphens")
    told: dict[str, Told] = {}
    try:
        # Not splitlines, which also cuts at separators of Unicode that JSON may hold.
        lines = file.read_text(encoding="utf-8").removesuffix("\n").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{file}: cannot be read ({error}); name a file of JSON lines with id and text") from None
    for number, line in enumerate(lines, 1):
        try:
            answer = Told.model_validate_json(line)
        except ValidationError as error:
            raise UserError(f"{file}, line {number}: {first_problem(error)}; write id and text") from None
        if answer.id in told:
            raise UserError(f"{file}, line {number}: {answer.id} is answered twice; keep one line")
        told[answer.id] = answer
    questions = asked(params)
    known = {q.question_id for own in questions.values() for q in own}
    if wrong := sorted(told.keys() - known):
        raise UserError(f"{file}: {wrong[0]} is none of this run's questions; `octopi questions export` writes them")
    if wrong := sorted(known - told.keys()):
        raise UserError(
            f"{file}: {wrong[0]} has no answer ({counted(len(wrong), 'question')} in all); answer it, if need be with "
            "an empty text"
        )
    answers = {seed: [_prediction(q, told[q.question_id].text) for q in own] for seed, own in questions.items()}
    day = datetime.now(UTC).date().isoformat()
    place = record(params, name, VisionModel(model=name, shown=Shown.OUTSIDE, first=day, last=day), answers)
    return f"{place}: {counted(len(told), 'answer')}; `dvc repro` grades them"


def record(params: Params, name: str, source: VisionModel, answers: Mapping[int, Sequence[Prediction]]) -> Path:
    """Write answers, by seed, to `external/<report>/<name>/`, and who gave them; returns the folder."""
    place = EXTERNAL / params.report_name / name
    for seed, predictions in answers.items():
        write_jsonl(place / f"{seed}.jsonl", predictions)
    # Written last, since this file vouches that the answers beside it belong to these questions.
    belongs = {str(seed): fingerprint(questions_file(seed)) for seed in answers}
    write_json(place / SOURCE_FILE, source.model_copy(update={"questions": belongs}).model_dump(mode="json"))
    return place


def _prediction(question: Question, text: str | tuple[str, ...]) -> Prediction:
    said = (text,) if isinstance(text, str) else text
    turns = len(turns_of(question))
    if len(said) > turns or not said:
        raise UserError(f"{question.question_id}: {len(said)} texts for {counted(turns, 'turn')}; write one for each")
    outputs = (*[""] * (turns - len(said)), *said)
    return Prediction(question_id=question.question_id, task=question.task, outputs=outputs, truncated=False, tokens=0)
