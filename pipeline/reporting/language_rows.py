"""The rows of the tables about the language model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.reporting.table import number, share_span


@dataclass(frozen=True)
class AblationRow:
    """One variant under one seed. Shares, from 0 to 1."""

    source: str
    encoder: str
    lora: str
    opd: str
    seed: int
    task: str
    accuracy: float
    low: float | None
    """Of the object-clustered 95 % interval."""
    high: float | None
    n: int
    chance: float
    unparsed: float
    """Answers without a choice that could be read; they count as wrong."""
    truncated: float
    tokens: float
    """Generated for an answer, on average."""
    gate: str
    """Whether the base language model can do the task on perfect descriptions; empty where nobody asked it."""

    def display(self) -> Mapping[str, str]:
        """All columns but source and seed."""
        return {
            "Encoder": self.encoder,
            "LoRA": self.lora,
            "OPD": self.opd,
            "Task": self.task,
            "Accuracy %": number(100 * self.accuracy, 1),
            "95 % over objects": share_span(self.low, self.high),
            "n": str(self.n),
            "Chance %": number(100 * self.chance, 1),
            "Unparsed %": number(100 * self.unparsed, 1),
            "Truncated %": number(100 * self.truncated, 1),
            "Tokens": number(self.tokens, 0),
            "Base model": self.gate,
        }


@dataclass(frozen=True)
class SeedsRow:
    """One variant over its seeds, for reading."""

    pooled: AblationRow
    """Every question counts once, with the share of its answers that are right; the seed is the first."""
    deviation: float | None
    """Of the accuracies under each seed; None for one seed."""

    def display(self) -> Mapping[str, str]:
        """All columns."""
        deviation = "" if self.deviation is None else number(100 * self.deviation, 1)
        return {**self.pooled.display(), "± over seeds": deviation}


@dataclass(frozen=True)
class EffectRow:
    """What a change of one axis does to the same questions. Differences of shares."""

    axis: str
    change: str
    others: str
    """`full system`: the other axes as the paper proposes; `all`: the mean over all their combinations in the plan."""
    task: str
    difference: float
    low: float | None
    high: float | None
    p: float | None
    p_holm: float | None
    """Adjusted over all rows with the same `others`."""
    n: int
    pairs: int
    """Pairs of variants, seeds among them, that each question's difference is the mean of."""
    gate: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Change": f"{self.axis}: {self.change}",
            "Others": self.others,
            "Task": self.task,
            "Difference": f"{100 * self.difference:+.1f}",
            "95 % over objects": share_span(self.low, self.high),
            "p": number(self.p, 3),
            "p (Holm)": number(self.p_holm, 3),
            "n": str(self.n),
            "Pairs": str(self.pairs),
            "Base model": self.gate,
        }


@dataclass(frozen=True)
class DescribingRow:
    """The full system under two ways of describing before it concludes. Shares, from 0 to 1."""

    task: str
    error_needed: float
    error_all: float
    difference: float
    """Error with `needed` less that with `all`."""
    low: float | None
    high: float | None
    tokens_needed: float
    tokens_all: float
    n: int
    gate: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Task": self.task,
            "Error %, needed": number(100 * self.error_needed, 1),
            "Error %, all": number(100 * self.error_all, 1),
            "Difference": f"{100 * self.difference:+.1f}",
            "95 % over objects": share_span(self.low, self.high),
            "Tokens, needed": number(self.tokens_needed, 0),
            "Tokens, all": number(self.tokens_all, 0),
            "n": str(self.n),
            "Base model": self.gate,
        }


@dataclass(frozen=True)
class TouchRow:
    """The full system on its videos, or on something else in their place. Shares, from 0 to 1."""

    touch: str
    task: str
    accuracy: float
    low: float | None
    high: float | None
    unchanged: float | None
    """Answers that are what they were on the real videos."""
    difference: float | None
    """Accuracy on the real videos less this one."""
    difference_low: float | None
    difference_high: float | None
    p: float | None
    n: int
    chance: float
    gate: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Touch": self.touch,
            "Task": self.task,
            "Accuracy %": number(100 * self.accuracy, 1),
            "95 % over objects": share_span(self.low, self.high),
            "Chance %": number(100 * self.chance, 1),
            "Answers unchanged %": "" if self.unchanged is None else number(100 * self.unchanged, 1),
            "Real minus this": "" if self.difference is None else f"{100 * self.difference:+.1f}",
            "its 95 %": share_span(self.difference_low, self.difference_high),
            "p": number(self.p, 3),
            "n": str(self.n),
            "Base model": self.gate,
        }
