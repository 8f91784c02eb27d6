"""The hard cases as a table of the report: every row in the CSV, the tightest of each part and format on the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.reporting.table import Table
from pipeline.stability.record import Judgement, StabilityRow

SHORTEST = "float16"
"""The format that only some machines run."""


@dataclass(frozen=True)
class CaseRow:
    """One case in one number format; error and bound as text, since they go from 1e-17 to 10."""

    part: str
    case: str
    dtype: str
    finite: bool
    error: str
    bound: str
    verdict: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Part": self.part,
            "Format": self.dtype,
            "Case": self.case,
            "Finite": "yes" if self.finite else "no",
            "Error": self.error,
            "Bound": self.bound,
            "Verdict": self.verdict,
        }


@dataclass(frozen=True)
class PartRow:
    """All cases of one part in one format, and the one whose error is the largest share of its bound."""

    part: str
    dtype: str
    cases: int
    failed: int
    nearest: StabilityRow | None
    """None where no case of them has an error."""

    def display(self) -> Mapping[str, str]:
        """All columns."""
        near = self.nearest
        return {
            "Part": self.part,
            "Format": self.dtype,
            "Cases": str(self.cases),
            "Failed": str(self.failed),
            "Nearest to its bound": near.case if near else "",
            "Error": _small(near.error) if near else "",
            "Bound": _small(near.bound) if near else "",
        }


def stability_table(rows: Sequence[StabilityRow]) -> Table:
    """The table of these cases; a person reads a row a part and format."""
    failed = sum(row.verdict is Judgement.FAILED for row in rows)
    shortest = (
        f"{SHORTEST} ran on a CUDA device."
        if any(row.dtype == SHORTEST for row in rows)
        else f"There are no rows in {SHORTEST}: it is tried on a CUDA device, and the machine had none."
    )
    return Table(
        "stability",
        "Numerical stability",
        f"{len(rows)} rows, {failed} of them failed (a failed one stops the chain). Each is a hard case of a part in "
        "one number format: whether all numbers are finite, and the largest distance to float64 or to an exact result "
        "over the largest exact number. Bounds follow from the format's unit roundoff, or from what an error would "
        "change; none was fitted. Rows without an error are judged by being finite: float64 where other formats are "
        f"held against it, and what there is no float64 of. {shortest}",
        [CaseRow(r.part, r.case, r.dtype, r.finite, _small(r.error), _small(r.bound), r.verdict.value) for r in rows],
        _grouped(rows),
    )


def _grouped(rows: Sequence[StabilityRow]) -> list[PartRow]:
    groups: dict[tuple[str, str], list[StabilityRow]] = {}
    for row in rows:
        groups.setdefault((row.part, row.dtype), []).append(row)
    return [
        PartRow(
            part,
            dtype,
            len(group),
            sum(row.verdict is Judgement.FAILED for row in group),
            max((row for row in group if row.error is not None), key=_share, default=None),
        )
        for (part, dtype), group in groups.items()
    ]


def _share(row: StabilityRow) -> float:
    """How much of its bound an error takes; more than any other where nothing may differ and something does."""
    error = row.error or 0.0
    return error / row.bound if row.bound else math.inf if error else 0.0


def _small(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}" if value else "0"
