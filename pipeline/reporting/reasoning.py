"""Where answers go wrong: in what is felt and described, or in what is concluded from it.

As everywhere in the report each question counts once, whatever the number of its answers: among those that described
right, or among the others, a question has the share of these answers that are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from pipeline.records import Score, Task
from pipeline.reporting.accuracy import Measure, outcomes
from pipeline.reporting.answered import Answered
from pipeline.reporting.inputs import Axes, Inputs
from pipeline.reporting.language_rows import ReasoningRow
from pipeline.statistics import clustered


def reasoning(answered: Answered, inputs: Inputs, measures: Sequence[Measure]) -> list[ReasoningRow]:
    """One row a variant that describes, over its seeds, and task that has something to conclude."""
    tasks = [m for m in measures if m.task is not Task.OPD]
    found = (_row(answered, inputs, axes, measure) for axes in inputs.axes for measure in tasks)
    return [row for row in found if row]


@dataclass(frozen=True)
class _Share:
    """Of right answers among some; without any, n is 0 and the rest None."""

    value: float | None
    low: float | None
    high: float | None
    n: int


def _row(answered: Answered, inputs: Inputs, axes: Axes, measure: Measure) -> ReasoningRow | None:
    every = [
        (score, inputs.described[key][question])
        for key in inputs.variants(axes).values()
        for question, score in answered.scores(key, measure).items()
        if question in inputs.described.get(key, {})
    ]
    if not every:
        return None
    described = _share([score.model_copy(update={"correct": said is True}) for score, said in every])
    concluded = _share([score for score, said in every if said is True])
    otherwise = _share([score for score, said in every if said is not True])
    encoder, lora, opd = axes
    return ReasoningRow(
        encoder=encoder,
        lora=lora,
        opd=opd,
        task=measure.label,
        accuracy=fmean(score.correct for score, _ in every),
        described=described.value,
        described_low=described.low,
        described_high=described.high,
        missing=fmean(said is None for _, said in every),
        n=described.n,
        concluded=concluded.value,
        concluded_low=concluded.low,
        concluded_high=concluded.high,
        concluded_n=concluded.n,
        otherwise=otherwise.value,
        otherwise_low=otherwise.low,
        otherwise_high=otherwise.high,
        otherwise_n=otherwise.n,
        chance=answered.chance(measure),
        gate=answered.gate(measure),
    )


def _share(scores: Sequence[Score]) -> _Share:
    asked = outcomes(scores)
    if not asked:
        return _Share(None, None, None, 0)
    value, interval = fmean(outcome.correct for outcome in asked), clustered(asked)
    return _Share(value, interval.low if interval else None, interval.high if interval else None, len(asked))
