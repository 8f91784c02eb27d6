"""What a trained model says, as records: `model_dump()` of all but `Touch` is plain JSON."""

from __future__ import annotations

import os
from typing import Literal, NamedTuple

from pydantic import ConfigDict

from pipeline.core.records import Record
from pipeline.use.memory import Similar
from pipeline.videos.frames.subtraction import Pictures

Video = str | os.PathLike[str] | Pictures
"""A file, or uint8, frames x height x width x RGB."""


class Exchange(NamedTuple):
    """One turn of a conversation. The caller keeps the list of them; the model remembers nothing."""

    question: str
    videos: tuple[Video, ...]
    answer: str


class Touch(Record):
    """What the model sees of a video."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    frames: Pictures
    """The frames that it is given: uint8, frames x side x side x RGB."""
    numbers: tuple[int, ...]
    """Each frame's place in the video, from 0."""
    reference: Pictures
    """The sensor untouched: uint8, side x side x RGB."""
    difference: Pictures
    """Each frame less the reference, as `frames`: 128 where nothing differs, two steps for each step of difference."""
    contact: float
    """Share of the picture, 0 to 1, that is touched in the frame with the largest such share."""
    strength: float
    """Largest contact strength in the video (`pipeline.videos.frames.reference.contact_strength`), in 8-bit steps."""
    notes: tuple[str, ...]
    """What should make one doubt an answer, such as that nothing touches the sensor."""


class Description(Record):
    """What the property heads and the language model say of one video."""

    video: str = ""
    """Its name, as notes have it."""
    levels: dict[str, str]
    """By property, the class that the heads choose. Where the encoder's recipe decides on all jointly, by which classes
    occur together in training, it need not be the likeliest class of that property alone."""
    probabilities: dict[str, dict[str, float]]
    """By property, the heads' probability of each class."""
    calibrated: bool = True
    """Whether these were calibrated on real videos; else they are scores that are mostly too sure."""
    sentence: str
    """The model's own description; empty where its variant never learnt to describe."""
    frames: tuple[int, ...]
    """Numbers of the frames that it was given."""
    notes: tuple[str, ...]


class Comparison(Record):
    """Whether a comparative holds between two videos."""

    question: str
    answer: str
    choice: Literal["yes", "no", "same"] | None
    """None where the answer cannot be read."""
    heads: str
    """What the property heads say, by a plain rule; empty where there are none."""
    notes: tuple[str, ...]
    """What should make one doubt it: of the model, then of each video, after its name."""


class Ranking(Record):
    """Videos from least to most of a property."""

    property: str
    levels: tuple[str, ...]
    """The property's classes, least first."""
    order: tuple[int, ...]
    """Places in the list of videos, from 0, by the heads' expected class, smallest first."""
    expected: tuple[float, ...]
    """By video: the sum over classes of class times probability."""
    answer: str
    """What the model answers when asked which video is the most so; empty unless there are two or three videos."""
    most: int | None
    """The place that this answer names; None where it cannot be read."""
    notes: tuple[str, ...]


class Matching(Record):
    """Which of two or three videos is of which of as many objects."""

    question: str
    answer: str
    names: tuple[str, ...] | None
    """The name that the answer gives each video, in the videos' order; None where it cannot be read."""
    heads: tuple[str, ...]
    """The names by the property heads and no language model: the matching whose classes are off by the fewest steps."""
    notes: tuple[str, ...]


class Choice(Record):
    """Which of two videos suits a situation."""

    question: str
    answer: str
    choice: int | None
    """Place in the list of videos, from 0; None where the answer cannot be read."""
    notes: tuple[str, ...]


class Recognition(Record):
    """What a touch is like, of all that is remembered."""

    objects: tuple[Similar, ...]
    """Most similar first."""
    touches: int
    """How many are remembered."""
    notes: tuple[str, ...]
