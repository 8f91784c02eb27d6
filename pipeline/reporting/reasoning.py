"""Where answers go wrong: in what is felt and described, or in what is concluded from it.

As everywhere in the report each question counts once, whatever the number of its answers: among those that described
right, or among the others, a question has the share of these answers that are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from pipeline.records import Score, Task
from pipeline.reporting.accuracy import Measure, outcomes
from pipeline.reporting.answered import Answered
from pipeline.reporting.inputs import Axes, Inputs
from pipeline.reporting.language_rows import ReasoningRow
from pipeline.statistics import Outcome, clustered


def reasoning(answered: Answered, inputs: Inputs, measures: Sequence[Measure]) -> list[ReasoningRow]:
    """One row a variant that describes, over its seeds, and task that has something to conclude."""
    tasks = [m for m in measures if m.task is not Task.OPD]
    found = (_row(answered, inputs, axes, measure) for axes in inputs.axes for measure in tasks)
    return [row for row in found if row]


def _row(answered: Answered, inputs: Inputs, axes: Axes, measure: Measure) -> ReasoningRow | None:
    every = [
        (score, inputs.described[key][question])
        for key in inputs.variants(axes).values()
        for question, score in answered.scores(key, measure).items()
        if question in inputs.described.get(key, {})
    ]
    if not every:
        return None
    right = outcomes(score.model_copy(update={"correct": bool(said)}) for score, said in every)
    after, otherwise = ([score for score, said in every if bool(said) is wanted] for wanted in (True, False))
    described_low, described_high = _ends(right)
    encoder, lora, opd = axes
    concluded, luck = _given(after), _given(otherwise)
    return ReasoningRow(
        encoder=encoder,
        lora=lora,
        opd=opd,
        task=measure.label,
        accuracy=fmean(score.correct for score, _ in every),
        described=fmean(bool(said) for _, said in every),
        described_low=described_low,
        described_high=described_high,
        missing=fmean(said is None for _, said in every),
        n=len(right),
        concluded=concluded[0],
        concluded_low=concluded[1],
        concluded_high=concluded[2],
        concluded_n=concluded[3],
        otherwise=luck[0],
        otherwise_low=luck[1],
        otherwise_high=luck[2],
        otherwise_n=luck[3],
        chance=answered.chance(measure),
        gate=answered.gate(measure),
    )


def _given(scores: Sequence[Score]) -> tuple[float | None, float | None, float | None, int]:
    """The share of right answers, each question counted once; its interval; the number of questions."""
    if not scores:
        return None, None, None, 0
    asked = outcomes(scores)
    return (fmean(outcome.correct for outcome in asked), *_ends(asked), len(asked))


def _ends(asked: Sequence[Outcome]) -> tuple[float | None, float | None]:
    interval = clustered(asked)
    return (interval.low, interval.high) if interval else (None, None)
