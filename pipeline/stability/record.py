"""A judged case, as the stage `stability` hands it to the report."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field, field_validator

from pipeline.records import Record

STABILITY_FILE = "stability.csv"


class Judgement(StrEnum):
    """What became of a case."""

    PASSED = "passed"
    FAILED = "failed"
    """The red row: not finite where it must be, or further off than its bound."""


class StabilityRow(Record):
    """One case in one number format."""

    part: str
    case: str
    dtype: str
    finite: bool
    """Whether every number of the result is."""
    error: float | None = Field(default=None, ge=0)
    """Largest distance to the exact result over the largest exact number (or over 1 where all are 0), to two digits;
    None where nothing finite came out, or where the float64 result is what the others are held against."""
    bound: float | None = Field(default=None, ge=0)
    """What the error may be; None where there is nothing to compare with, so that finiteness alone is judged."""
    verdict: Judgement

    @field_validator("error", "bound", mode="before")
    @classmethod
    def _empty_is_none(cls, value: object) -> object:
        return None if value == "" else value
