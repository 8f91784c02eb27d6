"""Why results differ from run to run: each variant under all its seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipeline.reporting.accuracy import Measure
from pipeline.reporting.answered import Answered
from pipeline.reporting.inputs import Axes
from pipeline.reporting.language_rows import SeedsRow
from pipeline.statistics import SeedParts, over_seeds

ONE_RUN = "one run says nothing of others"


def seeds(answered: Answered, measures: Sequence[Measure]) -> list[SeedsRow]:
    """One row a variant and measure that was asked."""
    found = (_row(answered, axes, measure) for axes in answered.inputs.axes for measure in measures)
    return [row for row in found if row]


def _row(answered: Answered, axes: Axes, measure: Measure) -> SeedsRow | None:
    answers = answered.runs(answered.inputs.variants(axes), measure)
    if not answers:
        return None
    found = over_seeds(answers)
    encoder, lora, opd = axes
    parts, ends, single = found.parts, found.interval, len(found.seeds) == 1
    return SeedsRow(
        encoder=encoder,
        lora=lora,
        opd=opd,
        task=measure.label,
        seeds=len(found.seeds),
        by_seed=", ".join(f"{seed}: {value:.4f}" for seed, value in zip(found.seeds, found.spread.values, strict=True)),
        accuracy=found.spread.mean,
        deviation=found.spread.deviation,
        expected=found.expected,
        most=found.most if single else None,
        sd_seeds=_root(parts, "seeds"),
        sd_objects=_root(parts, "objects"),
        sd_questions=_root(parts, "questions"),
        sd_answers=_root(parts, "answers"),
        low=ends.low if ends else None,
        high=ends.high if ends else None,
        n=found.questions,
        gate=answered.gate(measure),
        note=ONE_RUN if single else "",
    )


def _root(parts: SeedParts | None, name: str) -> float | None:
    return None if parts is None else math.sqrt(float(getattr(parts, name)))
