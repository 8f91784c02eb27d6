"""Graded measures of an answer, as the graders of tasks give them."""

from __future__ import annotations

from pydantic import Field

from pipeline.core.records import Record


class Score(Record):
    """One graded measure of one answer; OPD has one a property and `combined`, other tasks `choice`."""

    question_id: str
    task: str
    measure: str
    correct: bool
    parsed: bool
    """False where the grader found no answer; such an answer counts as wrong."""
    truncated: bool
    expected: str
    predicted: str
    """Empty where nothing could be parsed."""
    objects: tuple[str, ...]
    tokens: int = Field(default=0, ge=0)
    """Tokens generated for the answer, over all turns; 0 where no language model answered."""
    strict: bool | None = None
    """Whether the published code's own comparison of texts calls it right; None where that code has none."""
