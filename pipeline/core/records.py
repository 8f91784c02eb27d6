"""Records that several rooms share: parts of a split, axes of the ablation, questions, answers, curves, embeddings.

A room's own are in its records.py. Each table or JSON-lines file holds one kind of record; `pipeline.core.io` writes
and reads them and checks every row against the model.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field


class Record(BaseModel):
    """An immutable row; unknown fields are an error, so a stale file is noticed when it is read."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Part(StrEnum):
    """The part of a split that a video belongs to."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"
    UNUSED = "unused"


class Opd(StrEnum):
    """How much an answer describes before it concludes (the ablation axis OPD)."""

    NONE = "none"
    NEEDED = "needed"
    ALL = "all"


class Encoder(StrEnum):
    """Which tactile encoder a variant uses (the ablation axis encoder)."""

    FINETUNED = "finetuned"
    BASE = "base"


class Lora(StrEnum):
    """Whether the language model was fine-tuned end to end (the ablation axis LoRA)."""

    WITH = "with"
    WITHOUT = "without"


class TouchInput(StrEnum):
    """What the language model is given: the question's videos, or an input ablation in their place."""

    REAL = "real"
    REMOVED = "removed"
    """No tactile embedding at all: the two delimiters stand next to each other."""
    SWAPPED = "swapped"
    """A video of another object."""
    NOISE = "noise"
    """Normal noise with each dimension's mean and deviation."""


class Variant(NamedTuple):
    """One answering system of the ablation."""

    encoder: Encoder
    lora: Lora
    opd: Opd
    seed: int

    @property
    def key(self) -> str:
        """Its name in folders and behind the @ of its stages, such as `finetuned-with-all-0`."""
        return f"{self.encoder}-{self.lora}-{self.opd}-{self.seed}"

    @property
    def full(self) -> bool:
        """Whether it is the system as the paper proposes it."""
        return (self.encoder, self.lora, self.opd) == (Encoder.FINETUNED, Lora.WITH, Opd.ALL)


class Turn(Record):
    """One exchange. `{tactile}` in `user` marks where the next video of the question goes."""

    user: str
    assistant: str
    described: int = 0
    """Characters at the beginning of `assistant` that describe; what stands behind them is concluded from them."""


class Dialogue(Record):
    """A question as asked and answered under one OPD mode."""

    opd: Opd
    turns: tuple[Turn, ...] = Field(min_length=1)


class Gold(Record):
    """The content of the right answer, independent of its wording."""

    choice: str
    """PC yes/no/same; PSS and PSR a letter; POM the option numbers of a), b), c), as in "312"; OPD empty."""
    labels: tuple[tuple[int, ...], ...]
    """One tuple of class indices a video, in the catalogue's order of properties."""
    properties: tuple[str, ...]
    """The properties that the question is about; OPD and POM name all."""


class Question(Record):
    """One question in every OPD mode that applies; all ablation variants share its id."""

    question_id: str
    task: str
    """Name of the task in `pipeline.tasks.TASKS`."""
    part: Part
    videos: tuple[str, ...]
    objects: tuple[str, ...]
    dialogues: tuple[Dialogue, ...]
    gold: Gold

    def dialogue(self, opd: Opd) -> Dialogue | None:
        """The dialogue of one OPD mode, or None where the task has none in that mode."""
        return next((d for d in self.dialogues if d.opd == opd), None)


class Prediction(Record):
    """The raw text that a variant generated, one entry a turn."""

    question_id: str
    task: str
    outputs: tuple[str, ...]
    truncated: bool
    """Whether a turn ran into the token limit before the end token."""
    tokens: int = Field(ge=0)
    """Tokens generated, over all turns."""


class Measurement(Record):
    """One logged value of a training: a point of a curve."""

    step: int = Field(ge=0)
    name: str
    value: float


Flip = Literal["none", "horizontal", "vertical", "both"]
"""How a clip is mirrored in training."""


class Embedding(Record):
    """Row `row` of the embedding tensor: one frame seen one way."""

    video_id: str
    frame_index: int = Field(ge=0)
    flip: Flip
    row: int = Field(ge=0)


MIDDLE, GAIN = 128, 2
"""Pictures of `encoder.reference=subtract` show the difference to the untouched sensor doubled, and 128 where there is
none: 99.9 % of the real data's differences lie within 50 of 255 steps."""
TENSOR = "embeddings"
"""The embedding tensor's name in its file: float32, rows x dim."""
TENSOR_FILE, INDEX_FILE = "embeddings.safetensors", "index.parquet"
