"""The report's tables about the language model: every variant under every seed, and where variants are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean, stdev

from pipeline.plan import Variant
from pipeline.records import Task, Touch
from pipeline.reporting.accuracy import Measure, outcomes
from pipeline.reporting.answered import Answered
from pipeline.reporting.compared import counterfactuals, describing, effects
from pipeline.reporting.inputs import Inputs
from pipeline.reporting.language_rows import AblationRow, VariantRow
from pipeline.reporting.table import Row, Table
from pipeline.statistics import clustered

FOLDER = "language"


def language_tables(inputs: Inputs) -> list[Table]:
    """All tables of this room; those without rows are left out."""
    measures = [Measure(task, "choice") for task in (Task.PC, Task.PSS, Task.POM, Task.PSR)]
    measures += [Measure(Task.OPD, name) for name in ("combined", *inputs.catalogue.property_names)]
    answered = Answered(inputs)
    real = {key: v for key, v in inputs.params.plan.variants.items() if v.touch is Touch.REAL}
    whole = [m for m in measures if m.whole]
    tables = [
        Table(
            "ablation",
            "Language model: every variant",
            "Mean over seeds; the CSV has every seed. *Base model* says where the language model, before any touch, "
            "cannot do the task on perfect descriptions in words either: what such a task shows is not about touch.",
            [row for key, v in real.items() for row in _ablation(answered, key, v, measures)],
            [row for axes in inputs.axes for row in _over_seeds(answered, inputs.variants(axes), measures)],
            folder=FOLDER,
        ),
        Table(
            "effects",
            "What each part brings",
            "Differences on the same questions, in percentage points, over seeds. Intervals and p draw objects anew; "
            "p (Holm) is adjusted for all comparisons with the same *Others*.",
            effects(answered, real, whole),
            folder=FOLDER,
        ),
        Table(
            "describing",
            "Describing what is needed, or everything",
            "The full system where it first describes only the properties that a question asks about, and where it "
            "describes all: errors and generated tokens. Before matching and describing all are needed.",
            describing(answered, inputs, whole),
            folder=FOLDER,
        ),
        Table(
            "touch",
            "Is touch used?",
            "The full system, trained as ever, answers on its videos and on something else in their place: no tactile "
            "embeddings (removed), those of a video of another object (swapped), or noise.",
            counterfactuals(answered, inputs, whole),
            folder=FOLDER,
        ),
    ]
    return [table for table in tables if table.rows]


def _ablation(answered: Answered, key: str, v: Variant, measures: Sequence[Measure]) -> list[AblationRow]:
    rows = []
    for measure in measures:
        scores = answered.every([key], measure)
        if scores:
            interval = clustered(outcomes(scores))
            rows.append(
                AblationRow(
                    source=answered.inputs.params.data.source,
                    encoder=v.encoder,
                    lora=v.lora,
                    opd=v.opd,
                    seed=v.seed,
                    task=measure.label,
                    accuracy=fmean(s.correct for s in scores),
                    low=interval.low if interval else None,
                    high=interval.high if interval else None,
                    n=len(scores),
                    chance=answered.chance(measure),
                    unparsed=fmean(not s.parsed for s in scores),
                    truncated=fmean(s.truncated for s in scores),
                    tokens=fmean(s.tokens for s in scores),
                    gate=answered.gate(measure),
                )
            )
    return rows


def _over_seeds(answered: Answered, seeds: Mapping[int, str], measures: Sequence[Measure]) -> list[Row]:
    rows: list[Row] = []
    for measure in measures:
        by_seed = [s for key in seeds.values() if (s := answered.every([key], measure))]
        if by_seed:
            variant = answered.inputs.params.plan.variants[next(iter(seeds.values()))]
            scores = [s for some in by_seed for s in some]
            answers, accuracies = outcomes(scores), [fmean(s.correct for s in some) for some in by_seed]
            interval = clustered(answers)
            rows.append(
                VariantRow(
                    encoder=variant.encoder,
                    lora=variant.lora,
                    opd=variant.opd,
                    task=measure.label,
                    accuracy=fmean(accuracies),
                    deviation=stdev(accuracies) if len(accuracies) > 1 else None,
                    low=interval.low if interval else None,
                    high=interval.high if interval else None,
                    n=len(answers),
                    chance=answered.chance(measure),
                    unparsed=fmean(not s.parsed for s in scores),
                    truncated=fmean(s.truncated for s in scores),
                    tokens=fmean(s.tokens for s in scores),
                    gate=answered.gate(measure),
                )
            )
    return rows
