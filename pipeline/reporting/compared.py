"""Variants compared on the same questions: what each part brings, what describing costs, whether touch is used."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from statistics import fmean

from pipeline.plan import FULL, Encoder, Lora
from pipeline.records import Opd, Touch
from pipeline.reporting.accuracy import Measure, outcomes
from pipeline.reporting.answered import Answered
from pipeline.reporting.compared_rows import DescribingRow, EffectRow, TouchRow
from pipeline.reporting.factors import FACTORS, adjusted
from pipeline.reporting.inputs import Axes, Inputs
from pipeline.statistics import Answer, Outcome, clustered, deviations, paired_over_seeds


def effects(answered: Answered, measures: Sequence[Measure]) -> list[EffectRow]:
    """What changing one axis does, the other axes as the paper proposes; over seeds that have both variants."""
    rows: list[EffectRow] = []
    for place, factor in enumerate(FACTORS):
        for other, one in itertools.combinations(factor.levels, 2):
            first, second = (answered.inputs.variants(_with(place, level)) for level in (one, other))
            pairs = {seed: (key, second[seed]) for seed, key in first.items() if seed in second}
            for measure in measures:
                if gains := answered.gains(pairs, measure):
                    rows.append(_effect(factor.name, f"{one} minus {other}", measure, gains, answered.gate(measure)))
    return adjusted(rows)


def _with(place: int, level: str) -> Axes:
    """The axes that the paper proposes but for one."""
    names = [level if i == place else str(value) for i, value in enumerate(FULL)]
    return Encoder(names[0]), Lora(names[1]), Opd(names[2])


def _effect(axis: str, change: str, measure: Measure, gains: Sequence[Answer], gate: str) -> EffectRow:
    gap = paired_over_seeds(gains)
    by_question: defaultdict[str, list[Answer]] = defaultdict(list)
    for gain in gains:
        by_question[gain.question].append(gain)
    seen = deviations([Outcome(fmean(g.correct for g in same), same[0].objects) for same in by_question.values()])
    return EffectRow(
        axis=axis,
        change=change,
        task=measure.label,
        difference=gap.value,
        low=gap.interval.low if gap.interval else None,
        high=gap.interval.high if gap.interval else None,
        p=gap.p,
        p_holm=None,
        p_mcnemar=gap.mcnemar,
        smallest_effect=gap.detectable,
        sd_objects=seen.between if seen else None,
        sd_questions=seen.within if seen else None,
        n=len(by_question),
        pairs=len({gain.seed for gain in gains}),
        gate=gate,
    )


def describing(answered: Answered, inputs: Inputs, measures: Sequence[Measure]) -> list[DescribingRow]:
    """Errors and tokens of the full system under OPD `needed` and `all`."""
    needed, everything = (inputs.variants((*FULL[:2], mode)) for mode in (Opd.NEEDED, Opd.ALL))
    rows = []
    for measure in measures:
        one, other = (answered.every(keys.values(), measure) for keys in (needed, everything))
        gains = answered.gains({s: (everything[s], needed[s]) for s in needed if s in everything}, measure)
        if gains:
            gap = paired_over_seeds(gains)
            rows.append(
                DescribingRow(
                    task=measure.label,
                    error_needed=1 - fmean(s.correct for s in one),
                    error_all=1 - fmean(s.correct for s in other),
                    difference=gap.value,
                    low=gap.interval.low if gap.interval else None,
                    high=gap.interval.high if gap.interval else None,
                    tokens_needed=fmean(s.tokens for s in one),
                    tokens_all=fmean(s.tokens for s in other),
                    n=len({gain.question for gain in gains}),
                    gate=answered.gate(measure),
                )
            )
    return rows


def counterfactuals(answered: Answered, inputs: Inputs, measures: Sequence[Measure]) -> list[TouchRow]:
    """The full system on its videos and on whatever else it was asked about; nothing where that is nothing."""
    real = inputs.variants(FULL)
    asked = [t for t in Touch if t is not Touch.REAL and inputs.variants(FULL, t)]
    rows = []
    for touch in (Touch.REAL, *asked) if asked else ():
        keys = inputs.variants(FULL, touch)
        for measure in measures:
            scores = answered.every(keys.values(), measure)
            if not scores:
                continue
            answers = outcomes(scores)
            interval = clustered(answers)
            gains = answered.gains({s: (real[s], key) for s, key in keys.items()}, measure)
            gap = paired_over_seeds(gains) if gains and touch is not Touch.REAL else None
            ends = gap.interval if gap else None
            rows.append(
                TouchRow(
                    touch=touch,
                    task=measure.label,
                    accuracy=fmean(s.correct for s in scores),
                    low=interval.low if interval else None,
                    high=interval.high if interval else None,
                    unchanged=_unchanged(answered, real, keys, measure) if gap else None,
                    difference=gap.value if gap else None,
                    difference_low=ends.low if ends else None,
                    difference_high=ends.high if ends else None,
                    p=gap.p if gap else None,
                    n=len(answers),
                    chance=answered.chance(measure),
                    gate=answered.gate(measure),
                )
            )
    return rows


def _unchanged(answered: Answered, real: Mapping[int, str], keys: Mapping[int, str], measure: Measure) -> float:
    same = []
    for seed, key in keys.items():
        one, other = answered.scores(real[seed], measure), answered.scores(key, measure)
        same += [one[q].predicted == other[q].predicted for q in one.keys() & other.keys()]
    return fmean(same)
