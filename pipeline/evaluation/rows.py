"""Rows of a report's scores.csv and effects.csv: what only reports read, so that a new column runs no model again."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator

from pipeline.core.records import Record
from pipeline.evaluation.records import Share

Optional = Annotated[Share | None, BeforeValidator(lambda value: None if value == "" else value)]
"""Empty in a CSV where it is None."""
ALL_SEEDS = "all"
"""In place of a seed: the mean over seeds."""
# Values of the column `task` in rows that are no task's own accuracy.
HEADS, VALIDATION_HEADS = "heads", "heads_validation"
"""The fine-tuned encoder's property heads on test and on validation videos."""
RECALL = "heads_recall"
"""Of each class's test videos, the share that the heads put into it."""


class ScoreRow(Record):
    """One accuracy; all shares from 0 to 1."""

    task: str
    measure: str
    encoder: str
    """For a vision-only model the model's name."""
    lora: str = ""
    opd: str = ""
    touch: str = ""
    """For a vision-only model, what it was shown in place of touch."""
    seed: str
    """A number or `all`."""
    n: int
    """Questions, or videos; not multiplied by seeds."""
    sets: int
    """Distinct sets of objects that questions are about: many questions about one pair say little about other pairs."""
    right: Share
    """Right answers; over seeds their mean, which need not be whole."""
    unread: Share
    """Answers that could not be read, which count as wrong; over seeds their mean."""
    accuracy: Share
    low: Optional = None
    """Lower end of the 95 % interval over objects; None where the questions cannot show that objects differ."""
    high: Optional = None
    chance: Optional
    """None where there is nothing to guess among."""
    strict: Optional = None
    """Accuracy by the published code's comparison of texts; None where that code has none, or nobody wrote a text."""


class EffectRow(Record):
    """The effect of changing one part of the full system, on the same questions; differences from -1 to 1."""

    part: str
    """`encoder`, `lora`, `opd` or `touch`."""
    change: str
    """Such as `with - without`."""
    task: str
    measure: str
    difference: Share
    low: Optional = None
    """Lower end of the 95 % interval for new objects and, with several seeds, new seeds; None as in `ScoreRow`."""
    high: Optional = None
    p: Optional = None
    """Two-sided p value of the sign-flip test over objects. It takes few values (with seven objects none below 2/128)
    and holds for these runs alone, so it may disagree with the interval."""
    p_holm: Optional = None
    """Holm's adjustment over all rows of the report."""
    smallest_effect: Optional = None
    """Minimum detectable effect: the smallest true difference found with a power of 80 %; above 1 there is none."""
    n: int
    objects: int
    seeds: int
