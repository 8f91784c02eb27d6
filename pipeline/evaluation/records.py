"""Graded answers, of the chain's own variants and of models that it did not train."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import AfterValidator

from pipeline.core.records import Encoder, Lora, Opd, Record, TouchInput, Variant
from pipeline.tasks.records import Score

Share = Annotated[float, AfterValidator(lambda value: round(value, 6))]
"""A figure of a report."""


ADAPTED = ", adapted by "
"""Between a model's name and the number of rated objects that it was adapted by (`evaluate.rated`)."""


class Shown(StrEnum):
    """What a model that the chain did not train is shown."""

    FRAMES = "frames"
    """The kept frames of the question's videos."""
    PHOTOS = "photos"
    """Photos of the question's objects."""
    OUTSIDE = "answers from outside"
    """Whatever others showed it of the question's videos."""
    TOUCH = "touch"
    """The run's tactile videos; the models of `evaluate.models` are asked this way."""
    CLASSES = "classes"
    """The classes that such a model's property heads predict; rules answer from them, without a language model."""


class Graded(Score):
    """A score, and the variant that it belongs to."""

    encoder: Encoder
    lora: Lora
    opd: Opd
    seed: int
    """The replicate: with folds, all their answers together count as those of one seed."""
    trained: int
    """The seed of `ablation.seeds` under which the model was trained; with folds it says the fold."""
    touch: TouchInput

    @property
    def variant(self) -> Variant:
        """The answering system."""
        return Variant(self.encoder, self.lora, self.opd, self.trained)


class VisionModel(Record):
    """A model that this project does not run and how it was asked: a source.json.

    It stands behind an endpoint and answered about pictures; or its answers came in a file, of which only the name and
    the day are known.
    """

    model: str
    """As it was asked for."""
    served_as: tuple[str, ...] = ()
    """What the endpoint called it."""
    endpoint: str = ""
    shown: Shown
    per_video: int = 0
    """Most pictures in place of a video."""
    temperature: float = 0.0
    max_tokens: int = 0
    first: str
    """Day of the first reply, and of the last; UTC."""
    last: str
    ended: dict[str, int] = {}  # noqa: RUF012
    """How many replies ended with `stop`, `length`, `content_filter`, `refusal`, `nothing` (no text), `unsaid`, or
    another word of the endpoint's."""
    questions: dict[str, str] = {}  # noqa: RUF012
    """By seed, the fingerprint of the file of questions that it answered."""
    published: bool = False
    """Whether an earlier version asked it the paper's three prompts alone; else it is asked as the full system is."""
    folder: str = ""
    """Where its pictures lay."""
    frames: str = ""
    """Fingerprint of the frames that it saw (`frames_key`); empty for photos."""


class GradedVision(Score):
    """A score of a model that the chain did not train."""

    model: str
    shown: Shown
    seed: int
    """As in `Graded`."""
