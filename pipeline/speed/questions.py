"""The questions that a user has about speed and error, where each is answered, and the rule that recommends a setting.

The recommended setting is the cheapest whose error is at most the question's margin above the lowest error of all;
where all settings compute the same and have no error, the cheapest. Of equally cheap ones the better, then the first.
Nothing but the table's own columns goes in, so that anyone can check it. Intervals over objects do not: they hold what
all settings have in common, which objects were measured, and are far wider than what differs between settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from pipeline.scenes.light import NOISE
from pipeline.speed.bench import Cases
from pipeline.speed.reports import Describing, Encoders
from pipeline.speed.rows import SpeedRow
from pipeline.speed.sources import Found, Missing

POINTS = 0.02
"""Margin of shares: how folds and trees happened to fall moves a setting by a point or two."""
WRONG = "error (not all properties right)"
CLASSIFIED = "The error is the share of videos of objects never touched of which not all properties are told right."
DIFFERS = "share of answers that differ"


class Source(Protocol):
    """Where a question is answered."""

    @property
    def baseline(self) -> str:
        """The setting whose ratio is 1."""
        ...

    def read(self, reports: Path, question: str) -> Found | Missing:
        """The rows, none recommended yet."""
        ...


@dataclass(frozen=True)
class Question:
    """One question."""

    key: str
    title: str
    source: Source
    error: str
    """What the error is, for the plot."""
    text: str
    """What is compared and what the error is, for the caption."""
    margin: float = POINTS


QUESTIONS = (
    Question(
        "frames",
        "Which frames, and how many?",
        Cases("selection", r"(.+)", "uniform, 5 frames"),
        WRONG,
        f"A rule and how many of what it keeps, for hand-made features with trees. {CLASSIFIED} The cost is the pass "
        "that selects, and the features of what it selects.",
    ),
    Question(
        "encoder",
        "Which encoder?",
        Encoders(),
        WRONG,
        f"From the file to the decided classes, on one core. {CLASSIFIED}",
    ),
    Question(
        "encoder frames",
        "How many frames for the strong encoder?",
        Cases("encoder", r"(?:frames a video|strong), (.+)", "default"),
        WRONG,
        f"The encoder alone, on one core. {CLASSIFIED}",
    ),
    Question(
        "frame size",
        "How large a frame for the strong encoder?",
        Cases("encoder", r"(?:side of a frame|strong), (.+)", "default"),
        WRONG,
        f"The encoder alone, on one core. {CLASSIFIED}",
    ),
    Question(
        "prompts",
        "How many visual prompts?",
        Cases("encoder", r"prompts, (.+)", "8 at all layers"),
        WRONG,
        "The paper's recipe after few epochs, the encoder alone, on one core. The error is that on the few validation "
        "videos, which also chose the epoch.",
    ),
    Question(
        "number format, strong encoder",
        "Which number format for the strong encoder?",
        Cases("encoder", r"(?:number format|strong), (.+)", "float32", named=(("default", "float32"),)),
        WRONG,
        f"The encoder alone, on one core. {CLASSIFIED}",
    ),
    Question(
        "number format, CLIP",
        "Which number format for CLIP?",
        Cases("encoder", r"CLIP's number format, (.+)", "float32"),
        WRONG,
        f"The encoder alone, on one core, with heads that vote. {CLASSIFIED}",
    ),
    Question(
        "number format, language model",
        "Which number format for the language model?",
        Cases(
            "language",
            r"answering, weights in (.+), \d+ at a time",
            "float32",
            low="error_low",
            high="error_high",
            rates="ms an answer",
        ),
        f"{DIFFERS} from float32's",
        "The stand-in on one core. The error is the share of answers that differ from those in float32.",
    ),
    Question(
        "OPD",
        "How much to describe before concluding?",
        Describing(),
        "error, mean over tasks",
        "The full system's errors and the tokens that it generates. Ends of intervals are means of the tasks' ends, "
        "which is as wide as if all tasks erred together.",
    ),
    Question(
        "contact tier",
        "Which model of contact?",
        Cases(
            "scenes",
            r"((?:winkler|layer, |half_space, |auto, ).*)",
            "winkler",
            error="image",
            low="image_low",
            high="image_high",
        ),
        "root mean square error of a frame in contact, 8-bit steps",
        "The error is in what the camera sees: root mean square difference of a frame in contact to that of the finest "
        "model, in 8-bit steps. The margin is the sensor's own noise from frame to frame.",
        margin=NOISE,
    ),
    Question(
        "contact tier, for a classifier",
        "Which model of contact to train on?",
        Cases("scenes", r"labels, (.+)", "layer, every pixel"),
        WRONG,
        "Hand-made features with trees learn from scenes of each model and are tested on scenes of the finest, of "
        "objects never seen. The error is the share of videos of which not all properties are told right.",
    ),
    Question(
        "language model, answering",
        "Which way to have the language model answer?",
        Cases(
            "language",
            r"answering, (?!weights in )(.+)",
            "published way",
            low="error_low",
            high="error_high",
            rates="ms an answer",
        ),
        f"{DIFFERS} from the published way's",
        "The stand-in on one core: how many questions at a time, with or without cached embeddings and the published "
        "loop's forward pass. The error is the share of answers that differ from the published way's.",
    ),
    Question(
        "language model, training",
        "Which way to train the language model?",
        Cases("language", r"training, (.+)", "published way", rates="ms a useful token"),
        "",
        "The stand-in on one core: batch size, cached embeddings, padding and logits. All ways compute the same loss, "
        "so there is no error to trade, and nothing to draw.",
    ),
)
"""In reading order."""


@dataclass(frozen=True)
class Answer:
    """A question with its rows, one of them recommended."""

    question: Question
    rows: tuple[SpeedRow, ...]
    origin: str

    @property
    def chosen(self) -> SpeedRow:
        """The recommended row."""
        return next(row for row in self.rows if row.recommended)


@dataclass(frozen=True)
class Unanswered:
    """A question without its measurements."""

    question: Question
    reason: str


def gather(reports: Path) -> tuple[tuple[Answer, ...], tuple[Unanswered, ...]]:
    """All questions that the files in a folder like reports/ can answer, and those that they cannot.

    Raises:
        UserError: for a file that is not what its name says.
    """
    answers, missing = [], []
    for question in QUESTIONS:
        found = question.source.read(reports, question.key)
        if isinstance(found, Missing):
            missing.append(Unanswered(question, found.reason))
        else:
            chosen = recommended(found.rows, question.margin)
            rows = tuple(replace(row, recommended=row is chosen) for row in found.rows)
            answers.append(Answer(question, rows, found.origin))
    return tuple(answers), tuple(missing)


def recommended(rows: Sequence[SpeedRow], margin: float) -> SpeedRow:
    """The cheapest row that is good enough; the module says when it is.

    Raises:
        ValueError: without rows.
    """
    errors = [row.error for row in rows if row.error is not None]
    # A hair more, so that a margin met exactly in decimals is met in binary fractions.
    bound = min(errors, default=0.0) + margin + 1e-9
    good = [row for row in rows if (row.error is None if not errors else row.error is not None and row.error <= bound)]
    return min(good, key=lambda row: (row.ratio, row.error or 0.0))
