"""The typed records that stages hand to each other.

Each table or JSON-lines file holds one kind of record; `pipeline.artifacts` writes and reads them and
checks every row against the model.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

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


class Task(StrEnum):
    """The five tasks of the paper (its table "Task Details")."""

    OPD = "OPD"
    PC = "PC"
    PSS = "PSS"
    POM = "POM"
    PSR = "PSR"


class Opd(StrEnum):
    """How much an answer describes before it concludes (the ablation axis OPD)."""

    NONE = "none"
    NEEDED = "needed"
    ALL = "all"


class Video(Record):
    """One tactile video that decodes."""

    video_id: str
    """`<object>_<number>`, the file's stem."""
    object_id: str
    path: str
    """Relative to the data folder, so that a table does not depend on where the folder lies."""
    sha256: str
    frames: int = Field(ge=1)
    """Frames that really decode, not what the header says."""
    fps: float = Field(ge=0)
    width: int = Field(ge=1)
    """Pixels."""
    height: int = Field(ge=1)
    """Pixels."""


class Frame(Record):
    """One salient frame; row `row` of the frame tensor (uint8, frames x size x size x RGB)."""

    video_id: str
    frame_index: int = Field(ge=0)
    """Position in the video, in decoding order."""
    score: float = Field(ge=0)
    """Sum of absolute differences to the frame before, over pixels and channels (8-bit steps)."""
    row: int = Field(ge=0)


class Assignment(Record):
    """Which part of the split a video is in."""

    video_id: str
    object_id: str
    part: Part


class Turn(Record):
    """One exchange. `{tactile}` in `user` marks where the next video of the question goes."""

    user: str
    assistant: str


class Dialogue(Record):
    """A question as asked and answered under one OPD mode."""

    opd: Opd
    turns: tuple[Turn, ...] = Field(min_length=1)


class Gold(Record):
    """What a right answer says, apart from its wording."""

    choice: str
    """PC yes/no/same; PSS and PSR a letter; POM the option numbers of a), b), c), as in "312"; OPD empty."""
    labels: tuple[tuple[int, ...], ...]
    """One tuple of class indices a video, in the catalogue's order of properties."""
    properties: tuple[str, ...]
    """The properties that the question is about; OPD and POM name all."""


class Question(Record):
    """One question in every OPD mode that applies; all ablation variants share its id."""

    question_id: str
    task: Task
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
    task: Task
    outputs: tuple[str, ...]
    truncated: bool
    """Whether a turn ran into the token limit before the end token."""
    tokens: int = Field(ge=0)
    """Tokens generated, over all turns."""


class Score(Record):
    """One graded measure of one answer; OPD has one a property and `combined`, other tasks `choice`."""

    question_id: str
    task: Task
    measure: str
    correct: bool
    parsed: bool
    """False where the grader found no answer; such an answer counts as wrong."""
    truncated: bool
    expected: str
    predicted: str
    """Empty where nothing could be parsed."""
    objects: tuple[str, ...]


class Classification(Record):
    """What the encoder's heads say about one video and one property."""

    video_id: str
    object_id: str
    part: Part
    property: str
    expected: int = Field(ge=0)
    predicted: int = Field(ge=0)
    probabilities: tuple[float, ...]


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
