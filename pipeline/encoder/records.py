"""What the property heads say of a video."""

from __future__ import annotations

from pydantic import Field

from pipeline.core.records import Part, Record


class Classification(Record):
    """The heads' prediction for one video and one property."""

    video_id: str
    object_id: str
    part: Part
    property: str
    expected: int = Field(ge=0)
    predicted: int = Field(ge=0)
    probabilities: tuple[float, ...]
