"""The report's tables about the language model: every variant under every seed, and where variants are compared."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from pipeline.records import Task, Touch
from pipeline.reporting.accuracy import Measure, outcomes
from pipeline.reporting.answered import Answered
from pipeline.reporting.compared import counterfactuals, describing, effects
from pipeline.reporting.directions import directions
from pipeline.reporting.factorial import factorial
from pipeline.reporting.inputs import Inputs
from pipeline.reporting.language_rows import AblationRow
from pipeline.reporting.reasoning import reasoning
from pipeline.reporting.seeds import seeds
from pipeline.reporting.table import Table
from pipeline.statistics import clustered

FOLDER = "language"


def language_tables(inputs: Inputs) -> list[Table]:
    """All tables of this room; those without rows are left out."""
    measures = [Measure(task, "choice") for task in (Task.PC, Task.PSS, Task.POM, Task.PSR)]
    measures += [Measure(Task.OPD, name) for name in ("combined", *inputs.catalogue.property_names)]
    answered = Answered(inputs)
    real = {key: v for key, v in inputs.params.plan.variants.items() if v.touch is Touch.REAL}
    whole = [m for m in measures if m.whole]
    changes = effects(answered, whole)
    tables = [
        Table(
            "ablation",
            "Language model: every variant",
            "Mean over seeds; the CSV has every seed. *Base model* says where the language model, before any touch, "
            "cannot do the task on perfect descriptions in words either: what such a task shows is not about touch. "
            "*Facts told*: matching questions say what the named objects are like (`questions.facts`).",
            [row for key in real for measure in measures if (row := _row(answered, [key], measure))],
            [
                row
                for axes in inputs.axes
                for measure in measures
                if (row := _row(answered, [*inputs.variants(axes).values()], measure))
            ],
            folder=FOLDER,
        ),
        Table(
            "seeds",
            "Why results differ from run to run",
            "Each variant under all its seeds. Compare *± over seeds*, by how much the runs' accuracies deviate, with "
            "*± by answers alone*, by how much they would if all runs were equally good and only single answers fell "
            "this way or that. Where both are alike, more questions make runs agree; where the first is clearly "
            "larger, whole runs differ, and more seeds are needed. Both are rough with few seeds. The last four split "
            "the variance of a single answer; *95 %* is for other objects and other runs. A single run shows none of "
            "this: its interval is for other objects alone, and *at the most* is what single answers alone could make "
            "of it.",
            seeds(answered, whole),
            folder=FOLDER,
        ),
        Table(
            "directions",
            "Do the paper's directions hold?" if inputs.of_paper else "Does each part help?",
            "What the paper says each part brings, against what it brings here, in percentage points. A direction "
            "*holds* where the interval for new objects and seeds lies above zero, is *reversed* where it lies below, "
            "and otherwise is *not shown*, which is not the same as absent: the table after this one says how large an "
            "effect would have been found.",
            directions(inputs, whole, changes),
            folder=FOLDER,
        ),
        Table(
            "effects",
            "What each part brings",
            "One change at a time, the other parts as the paper proposes: differences on the same questions, in "
            "percentage points, over seeds. Intervals are for new objects and, with several seeds, new seeds. p flips "
            "the signs of whole objects: with few it takes few values, with seven none below .016; p (Holm) is "
            "adjusted for all rows. p (McNemar) takes questions to be independent, which they are not, and is only to "
            "be read beside p; with several seeds each is tested alone, and the smallest p counts times their number. "
            "*Smallest effect* is what a t test on this design would find in four of five repetitions; above 100 there "
            "is none.",
            changes,
            folder=FOLDER,
        ),
        Table(
            "factorial",
            "Main effects and interactions",
            "Over all variants, not the full system alone. A main effect is the mean, over all settings of the other "
            "parts, of what a change brings; an interaction is by how much that differs between two settings of "
            "another part. Percentage points on the same questions; intervals are for new objects and, with several "
            "seeds, new seeds; p (Holm) is adjusted for all main effects, or for all interactions.",
            factorial(answered, whole),
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
            "reasoning",
            "Touch or reasoning: where answers go wrong",
            "A system that describes before it concludes can err in either. *Described right*: all that the question "
            "asks about, of all its objects, is described as labelled; *left out*: part of it is not said, or cannot "
            "be read. *Right after that*: how many of the answers that described right then conclude right; what "
            "lacks to 100 is the language model's reasoning. *Right otherwise*: an answer whose descriptions are wrong "
            "may still be right by luck, or because the error does not matter to the question.",
            reasoning(answered, inputs, whole),
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


def _row(answered: Answered, keys: Sequence[str], measure: Measure) -> AblationRow | None:
    """One measure of variants that differ in nothing but the seed; None where none of them was asked."""
    scores = answered.every(keys, measure)
    if not scores:
        return None
    params = answered.inputs.params
    variant, answers = params.plan.variants[keys[0]], outcomes(scores)
    interval = clustered(answers)
    return AblationRow(
        source=params.data.source,
        encoder=variant.encoder,
        lora=variant.lora,
        opd=variant.opd,
        seed=variant.seed,
        task=measure.label,
        accuracy=fmean(a.correct for a in answers),
        low=interval.low if interval else None,
        high=interval.high if interval else None,
        n=len(answers),
        chance=answered.chance(measure),
        unparsed=fmean(not s.parsed for s in scores),
        truncated=fmean(s.truncated for s in scores),
        tokens=fmean(s.tokens for s in scores),
        gate=answered.gate(measure),
    )
