"""The rows of the tables that compare variants on the same questions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.reporting.table import number, percent, share_span


@dataclass(frozen=True)
class EffectRow:
    """What a change of one axis does to the same questions, the others as proposed. Differences of shares."""

    axis: str
    change: str
    task: str
    difference: float
    low: float | None
    """Of the 95 % interval for new objects and, where there are several, new seeds."""
    high: float | None
    p: float | None
    """Of the sign-flip test over objects, on means over seeds."""
    p_holm: float | None
    """Adjusted over all rows."""
    p_mcnemar: float | None
    """Exact, questions taken as independent; with several seeds the smallest of theirs times their number."""
    smallest_effect: float | None
    """The smallest true difference that a t test would find in four of five repetitions; above 1 there is none."""
    sd_objects: float | None
    """Deviation of the objects' own share in the differences, means over seeds."""
    sd_questions: float | None
    """Deviation of differences of questions about the same objects."""
    n: int
    pairs: int
    """Pairs of variants, one a seed, that each question's difference is the mean of."""
    gate: str

    def display(self) -> Mapping[str, str]:
        """What is tested; deviations are in the CSV."""
        return {
            "Change": f"{self.axis}: {self.change}",
            "Task": self.task,
            "Difference": f"{100 * self.difference:+.1f}",
            "95 %": share_span(self.low, self.high),
            "p": number(self.p, 3),
            "p (Holm)": number(self.p_holm, 3),
            "p (McNemar)": number(self.p_mcnemar, 3),
            "Smallest effect": percent(self.smallest_effect),
            "n": str(self.n),
            "Pairs": str(self.pairs),
            "Base model": self.gate,
        }


@dataclass(frozen=True)
class FactorialRow:
    """A main effect or an interaction over all settings of the other parts. Differences of shares."""

    effect: str
    """`main` or `interaction`."""
    factors: str
    change: str
    task: str
    difference: float
    """-1 to 1; of an interaction, by how much the one effect differs with the other part, -2 to 2."""
    low: float | None
    """Of the 95 % interval for new objects and, where there are several, new seeds."""
    high: float | None
    p: float | None
    """Of the sign-flip test over objects, on means over seeds."""
    p_holm: float | None
    """Adjusted over all rows with the same `effect`."""
    smallest_effect: float | None
    """As of the effects one at a time."""
    n: int
    seeds: int
    cells: int
    """Variants without their seeds whose answers are compared."""
    gate: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Effect": self.effect,
            "Of": self.factors,
            "Change": self.change,
            "Task": self.task,
            "Difference": f"{100 * self.difference:+.1f}",
            "95 %": share_span(self.low, self.high),
            "p": number(self.p, 3),
            "p (Holm)": number(self.p_holm, 3),
            "Smallest effect": percent(self.smallest_effect),
            "n": str(self.n),
            "Seeds": str(self.seeds),
            "Variants": str(self.cells),
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
            "95 %": share_span(self.low, self.high),
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
