"""What things cost: `python -m pipeline.benchmarks SECTION` writes reports/bench/SECTION.json."""

from __future__ import annotations

from pydantic import Field

from pipeline.records import Record


class BenchRow(Record):
    """One measured point; costs are compared only within one run on one machine."""

    case: str
    cost: float = Field(ge=0)
    """Median of the repeats."""
    unit: str
    baseline: str
    """The case of the same run that `ratio` refers to."""
    ratio: float = Field(ge=0)
    """Cost over the baseline's cost."""
    error: float | None = None
    """What the cost buys, where a section trades cost for error."""
    low: float
    """Lower end of the error's interval; of the repeats' costs where there is no error."""
    high: float
    """Upper end, likewise."""
