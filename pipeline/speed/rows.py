"""One setting of one question: a row of reports/speed_error.csv."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.reporting.table import number


@dataclass(frozen=True, kw_only=True)
class SpeedRow:
    """What a setting costs and what it gets wrong; None where its source does not say."""

    question: str
    setting: str
    cost: float
    unit: str
    ratio: float
    """Cost over that of the question's baseline, whose ratio is 1, measured in the same run."""
    frames: float | None = None
    """A video."""
    tokens: float | None = None
    """An answer, or a conversation that is trained on."""
    flops: float | None = None
    """Floating-point operations of what the unit counts."""
    bytes: float | None = None
    """Weights of an encoder; of a language model the peak of the process's memory."""
    error: float | None = None
    """A share from 0 to 1, or what the question's caption says."""
    low: float | None = None
    """Ends of its 95 % interval."""
    high: float | None = None
    recommended: bool = False

    def display(self) -> Mapping[str, str]:
        """Columns for reading; the question is the table's title."""
        interval = "" if self.low is None or self.high is None else f"{self.low:.3f} to {self.high:.3f}"
        return {
            "Setting": f"**{self.setting}**" if self.recommended else self.setting,
            "Ratio": number(self.ratio, 3),
            "Cost": f"{self.cost:g} {self.unit}",
            "Frames": _count(self.frames),
            "Tokens": _count(self.tokens),
            "FLOPs": _count(self.flops),
            "Bytes": _count(self.bytes),
            "Error": number(self.error, 3),
            "95 %": interval,
            "Recommended": "yes" if self.recommended else "",
        }


def _count(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
