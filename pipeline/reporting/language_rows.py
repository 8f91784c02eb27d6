"""The rows of the tables about the language model: every variant, one run at a time and over its seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.reporting.table import number, percent, share_span


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
    """One variant under all its seeds. Shares, from 0 to 1."""

    encoder: str
    lora: str
    opd: str
    task: str
    seeds: int
    by_seed: str
    """The accuracy under each."""
    accuracy: float
    """Their mean."""
    deviation: float | None
    """Of the accuracies under each seed; None for one seed, as all that compares runs."""
    expected: float | None
    """The deviation that single answers alone would make, were all runs equally good."""
    most: float | None
    """What that is at the most, from the accuracy and the number of questions; of one seed alone."""
    sd_seeds: float | None
    """Square roots of the variance components of a single answer: whole runs are better or worse."""
    sd_objects: float | None
    """Objects are easier or harder, under all seeds."""
    sd_questions: float | None
    """Questions about the same objects are, under all seeds."""
    sd_answers: float | None
    """The same question is answered differently in another run, beyond how good that run is."""
    low: float | None
    """Of the 95 % interval for new objects and new seeds; for one seed, for new objects."""
    high: float | None
    n: int
    gate: str
    note: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        pairs = (one.split(": ") for one in self.by_seed.split(", "))
        return {
            "Encoder": self.encoder,
            "LoRA": self.lora,
            "OPD": self.opd,
            "Task": self.task,
            "Accuracy %": percent(self.accuracy),
            "95 %": share_span(self.low, self.high),
            "By seed": ", ".join(f"{seed}: {percent(float(share))}" for seed, share in pairs),
            "± over seeds": percent(self.deviation),
            "± by answers alone": percent(self.expected),
            "at the most": percent(self.most),
            "Seeds ±": percent(self.sd_seeds),
            "Objects ±": percent(self.sd_objects),
            "Questions ±": percent(self.sd_questions),
            "Answers ±": percent(self.sd_answers),
            "n": str(self.n),
            "Base model": self.gate,
            "Note": self.note,
        }


@dataclass(frozen=True)
class ReasoningRow:
    """Where answers of one variant go wrong, over its seeds: in describing or in concluding. Shares, from 0 to 1."""

    encoder: str
    lora: str
    opd: str
    task: str
    accuracy: float
    described: float | None
    """Answers that describe all that is asked about, of all objects, as labelled."""
    described_low: float | None
    described_high: float | None
    missing: float
    """Answers that leave out, or say unreadably, something that is asked about; they are not right."""
    n: int
    concluded: float | None
    """Right conclusions among the answers that described right; None where none did."""
    concluded_low: float | None
    concluded_high: float | None
    concluded_n: int
    """Questions that at least one seed's answer described right."""
    otherwise: float | None
    """Right conclusions among the other answers."""
    otherwise_low: float | None
    otherwise_high: float | None
    otherwise_n: int
    chance: float
    gate: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Encoder": self.encoder,
            "LoRA": self.lora,
            "OPD": self.opd,
            "Task": self.task,
            "Described right %": percent(self.described),
            "its 95 %": share_span(self.described_low, self.described_high),
            "Left out %": percent(self.missing),
            "n": str(self.n),
            "Right after that %": percent(self.concluded),
            "95 % of that": share_span(self.concluded_low, self.concluded_high),
            "n of that": str(self.concluded_n),
            "Right otherwise %": percent(self.otherwise),
            "95 % otherwise": share_span(self.otherwise_low, self.otherwise_high),
            "n otherwise": str(self.otherwise_n),
            "All right %": percent(self.accuracy),
            "Chance %": percent(self.chance),
            "Base model": self.gate,
        }
