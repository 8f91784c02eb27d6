"""What the plan varies, and families of comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from pipeline.plan import Encoder, Lora
from pipeline.records import Opd
from pipeline.reporting.compared_rows import EffectRow, FactorialRow
from pipeline.statistics import Factor, holm

FACTORS = (
    Factor("encoder", tuple(Encoder)),
    Factor("LoRA", tuple(Lora)),
    # Both ways of describing are compared with none, and the shorter with the paper's.
    Factor("OPD", (Opd.NONE, Opd.ALL, Opd.NEEDED)),
)
"""In the order of a variant's axes."""

Tested = TypeVar("Tested", EffectRow, FactorialRow)


def adjusted(rows: Sequence[Tested]) -> list[Tested]:
    """One family: every row with what its p is worth, all of them having been looked at (Holm)."""
    worth = iter(holm([row.p for row in rows if row.p is not None]))
    return [row if row.p is None else replace(row, p_holm=next(worth)) for row in rows]
