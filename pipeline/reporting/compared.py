"""Variants compared on the same questions: what each part brings, what describing costs, whether touch is used."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean

from pipeline.plan import FULL, Encoder, Lora, Variant
from pipeline.records import Opd, Touch
from pipeline.reporting.accuracy import Measure, outcomes
from pipeline.reporting.answered import Answered
from pipeline.reporting.inputs import Inputs
from pipeline.reporting.language_rows import DescribingRow, EffectRow, TouchRow
from pipeline.statistics import Outcome, clustered, holm, paired

CONTRASTS: tuple[tuple[str, int, Encoder | Lora | Opd, Encoder | Lora | Opd], ...] = (
    ("encoder", 0, Encoder.FINETUNED, Encoder.BASE),
    ("LoRA", 1, Lora.WITH, Lora.WITHOUT),
    ("OPD", 2, Opd.ALL, Opd.NONE),
    ("OPD", 2, Opd.NEEDED, Opd.NONE),
    ("OPD", 2, Opd.NEEDED, Opd.ALL),
)
"""Axis, its place in a variant's axes, and which of its values is compared with which."""


def effects(answered: Answered, variants: Mapping[str, Variant], measures: Sequence[Measure]) -> list[EffectRow]:
    """What changing one axis does, the other axes as the paper proposes and, where there are more, over all of them."""
    keys = {(v.encoder, v.lora, v.opd, v.seed): key for key, v in variants.items()}
    full, every = [], []
    for axis, place, one, other in CONTRASTS:
        pairs: list[tuple[str, str]] = []
        proposed: list[tuple[str, str]] = []
        for axes, key in keys.items():
            rival = keys.get((*axes[:place], other, *axes[place + 1 :]))  # type: ignore[arg-type]
            if axes[place] == one and rival is not None:
                pairs.append((key, rival))
                if all(axes[i] == FULL[i] for i in range(len(FULL)) if i != place):
                    proposed.append((key, rival))
        for measure in measures:
            change = f"{one} minus {other}"
            full += _effect(answered, proposed, measure, axis, change, "full system")
            if len(pairs) > len(proposed):
                every += _effect(answered, pairs, measure, axis, change, "all")
    return [*_adjusted(full), *_adjusted(every)]


def _effect(
    answered: Answered, pairs: Sequence[tuple[str, str]], measure: Measure, axis: str, change: str, others: str
) -> list[EffectRow]:
    gains, compared = _gains(answered, pairs, measure)
    if not gains:
        return []
    gap = paired(gains)
    return [
        EffectRow(
            axis=axis,
            change=change,
            others=others,
            task=measure.label,
            difference=gap.value,
            low=gap.interval.low if gap.interval else None,
            high=gap.interval.high if gap.interval else None,
            p=gap.p,
            p_holm=None,
            n=len(gains),
            pairs=compared,
            gate=answered.gate(measure),
        )
    ]


def _adjusted(rows: Sequence[EffectRow]) -> list[EffectRow]:
    tested = [row for row in rows if row.p is not None]
    adjusted = dict(zip(map(id, tested), holm([row.p for row in tested if row.p is not None]), strict=True))
    return [EffectRow(**{**vars(row), "p_holm": adjusted.get(id(row))}) for row in rows]


def _gains(answered: Answered, pairs: Iterable[tuple[str, str]], measure: Measure) -> tuple[list[Outcome], int]:
    """By question, the mean over pairs of variants of how much more often the first is right; and how many pairs."""
    gains: defaultdict[str, list[int]] = defaultdict(list)
    objects: dict[str, tuple[str, ...]] = {}
    compared = 0
    for first, second in pairs:
        one, other = answered.scores(first, measure), answered.scores(second, measure)
        compared += bool(one and other)
        for question in one.keys() & other.keys():
            gains[question].append(one[question].correct - other[question].correct)
            objects[question] = one[question].objects
    return [Outcome(fmean(gains[q]), objects[q]) for q in sorted(gains)], compared


def describing(answered: Answered, inputs: Inputs, measures: Sequence[Measure]) -> list[DescribingRow]:
    """Errors and tokens of the full system under OPD `needed` and `all`."""
    needed, everything = (inputs.variants((*FULL[:2], mode)) for mode in (Opd.NEEDED, Opd.ALL))
    rows = []
    for measure in measures:
        one, other = (answered.every(keys.values(), measure) for keys in (needed, everything))
        gains, _ = _gains(answered, [(everything[s], needed[s]) for s in needed if s in everything], measure)
        if gains:
            gap = paired(gains)
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
                    n=len(gains),
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
            gains, _ = _gains(answered, [(real[s], key) for s, key in keys.items()], measure)
            gap = paired(gains) if gains and touch is not Touch.REAL else None
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
