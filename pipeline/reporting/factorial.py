"""The ablation as a factorial design: main effects and interactions of encoder, LoRA and OPD over all settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.reporting.accuracy import Measure
from pipeline.reporting.answered import Answered
from pipeline.reporting.compared_rows import FactorialRow
from pipeline.reporting.factors import FACTORS, adjusted
from pipeline.statistics import FactorialEffect, factorial_effects

ONE_PAIR = 2
"""Cells of a contrast that is made in one setting of the other factors only."""


def factorial(answered: Answered, measures: Sequence[Measure]) -> list[FactorialRow]:
    """Main effects of all measures, then interactions; each kind is a family of its own.

    A change that was made in one setting of the other parts alone is no mean over settings: where the paper proposes
    that setting, it stands among the one-at-a-time effects.
    """
    rows = []
    for measure in measures:
        inputs = answered.inputs
        answers = [
            replace(answer, levels=axes)
            for axes in inputs.axes
            for answer in answered.runs(inputs.variants(axes), measure)
        ]
        found = factorial_effects(answers, FACTORS)
        rows += [_row(e, measure, answered.gate(measure)) for e in found if e.cells > ONE_PAIR]
    main, crossed = ([r for r in rows if r.effect == kind] for kind in ("main", "interaction"))
    return [*adjusted(main), *adjusted(crossed)]


def _row(effect: FactorialEffect, measure: Measure, gate: str) -> FactorialRow:
    ends = effect.interval
    return FactorialRow(
        effect="main" if len(effect.factors) == 1 else "interaction",
        factors=" x ".join(effect.factors),
        change=" x ".join(effect.changes),
        task=measure.label,
        difference=effect.value,
        low=ends.low if ends else None,
        high=ends.high if ends else None,
        p=effect.p,
        p_holm=None,
        smallest_effect=effect.detectable,
        n=effect.questions,
        seeds=effect.seeds,
        cells=effect.cells,
        gate=gate,
    )
