"""The paper's tables of accuracies, and one of all variants that were run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.plan import Encoder, Lora
from pipeline.records import Classification, Opd, Part, Score, Task
from pipeline.reporting.accuracy import AccuracyRow, Cell, Measure, accuracy_row
from pipeline.reporting.inputs import Axes, Inputs, no_test_videos, why_empty
from pipeline.reporting.published import MODELS
from pipeline.reporting.table import Table
from pipeline.tasks import TASKS


@dataclass(frozen=True)
class System:
    """An answering system of the paper's tables."""

    name: str
    label: str
    axes: Axes


OCTOPI = System("octopi", "Octopi", (Encoder.FINETUNED, Lora.WITH, Opd.ALL))
NO_OPD = System("no_opd", "Octopi (no OPD)", (Encoder.FINETUNED, Lora.WITH, Opd.NONE))
BASE_CLIP = System("base_clip", "Octopi (base CLIP)", (Encoder.BASE, Lora.WITH, Opd.ALL))
WITHOUT_LORA = System("without_lora", "Octopi (without LoRA)", (Encoder.FINETUNED, Lora.WITHOUT, Opd.ALL))

UNDERSTANDING = (Task.PC, Task.PSS, Task.POM)


def result_tables(inputs: Inputs) -> list[Table]:
    """Every table of accuracies, in the paper's order, and `all_variants`."""
    choices = [Measure(task, "choice") for task in UNDERSTANDING]
    scenarios = Measure(Task.PSR, "choice")
    properties = [Measure(Task.OPD, name) for name in ("combined", *inputs.catalogue.property_names)]

    def table(name: str, title: str, caption: str, measures: Sequence[Measure], systems: Sequence[System]) -> Table:
        rows = [_answered(inputs, name, measure, system) for measure in measures for system in systems]
        return Table(name, title, caption, rows)

    once = " (published once, so under both)" if inputs.of_paper else ""
    description = table(
        "property_description",
        "Object property description",
        f"Accuracy in describing test videos; combined: all properties of a video right. {_heads(inputs)}: the "
        f"fine-tuned encoder with its classification heads, without a language model{once}. "
        "Majority class: what is most frequent among the training objects, said of every test video.",
        properties,
        [OCTOPI],
    )
    return [
        table(
            "understanding",
            "Physical understanding",
            "Property comparison (PC), superlative selection (PSS) and object matching (POM), with and without "
            "descriptions (OPD).",
            choices,
            [OCTOPI, NO_OPD],
        ),
        table(
            "scenario_reasoning",
            "Scenario reasoning",
            "Property scenario reasoning (PSR), never trained on.",
            [scenarios],
            [OCTOPI, NO_OPD],
        ),
        Table(
            description.name,
            description.title,
            description.caption,
            [*_baselines(inputs, properties), *description.rows],
        ),
        table(
            "encoder_property",
            "Ablation of the encoder: property description",
            "The encoder fine-tuned on properties, or CLIP as it comes.",
            properties,
            [OCTOPI, BASE_CLIP],
        ),
        table(
            "encoder_understanding",
            "Ablation of the encoder: physical understanding",
            "The encoder fine-tuned on properties, or CLIP as it comes.",
            [*choices, scenarios],
            [OCTOPI, BASE_CLIP],
        ),
        table(
            "lora_property",
            "Ablation of LoRA: property description",
            "With end-to-end fine-tuning, or the aligned model as it is.",
            properties,
            [OCTOPI, WITHOUT_LORA],
        ),
        table(
            "lora_understanding",
            "Ablation of LoRA: physical understanding",
            "With end-to-end fine-tuning, or the aligned model as it is.",
            [*choices, scenarios],
            [OCTOPI, WITHOUT_LORA],
        ),
        table(
            "all_variants",
            "All variants",
            "Every variant of the plan on every measure: encoder, LoRA and OPD by name.",
            [*choices, scenarios, *properties],
            [System("-".join(axes), _label(axes), axes) for axes in inputs.axes],
        ),
    ]


def headline(inputs: Inputs, tables: Iterable[Table]) -> dict[str, float]:
    """Measured accuracies (0 to 1) as flat metrics `<system>.<row>`: each variant, and the baselines."""
    chosen = {t.name: t.rows for t in tables if t.name in ("all_variants", "property_description")}
    names = {_label(axes): "-".join(axes) for axes in inputs.axes} | dict(_baseline_names(inputs).values())
    return {
        f"{names[row.system]}.{row.row}": round(row.value / 100, 6)
        for rows in chosen.values()
        for row in rows
        if isinstance(row, AccuracyRow) and row.value is not None and row.system in names
    }


def classified(inputs: Inputs) -> dict[int, list[Score]]:
    """By encoder seed, the heads' verdicts about test videos as if they were answers to OPD questions."""
    return {seed: _as_scores(inputs, records) for seed, records in inputs.classifications.items()}


def _baseline_names(inputs: Inputs) -> dict[str, tuple[str, str]]:
    """Label and metric of the systems without a language model, as published.csv calls them."""
    return {"majority": ("Majority class", "majority"), "ft_clip": (_heads(inputs), "ft-clip")}


def _heads(inputs: Inputs) -> str:
    return "FT encoder" if inputs.params.encoder.recipe == "strong" else "FT CLIP"


def _answered(inputs: Inputs, table: str, measure: Measure, system: System) -> AccuracyRow:
    scores = {
        seed: [s for s in inputs.scores.get(key, ()) if s.task == measure.task and s.measure == measure.name]
        for seed, key in inputs.variants(system.axes).items()
    }
    cell = _cell(inputs, table, measure, system.name, system.label)
    return accuracy_row(cell, scores, why_empty(inputs, system.axes, measure.task), _doubt(inputs, measure.task))


def _doubt(inputs: Inputs, task: Task) -> str:
    failed = not inputs.gate.get(task, True)
    doubts = ["the base language model fails its gate in this task"] * failed
    doubts += ["the question says what the named objects are like (questions.facts)"] * inputs.told(task)
    return "; ".join(doubts)


def _baselines(inputs: Inputs, properties: Sequence[Measure]) -> list[AccuracyRow]:
    note = no_test_videos(inputs) if not inputs.test_objects else "no classifications: no encoder was fine-tuned"
    by_name: dict[str, Mapping[int, Sequence[Score]]] = {
        "majority": {0: _majority(inputs)},
        "ft_clip": classified(inputs),
    }
    return [
        accuracy_row(
            _cell(inputs, "property_description", measure, name, _baseline_names(inputs)[name][0]),
            {seed: [s for s in scores if s.measure == measure.name] for seed, scores in by_seed.items()},
            note,
        )
        for name, by_seed in by_name.items()
        for measure in properties
    ]


def _cell(inputs: Inputs, table: str, measure: Measure, system: str, label: str) -> Cell:
    chance = TASKS[measure.task].chance(inputs.catalogue)[measure.name]
    # A published figure without a model (the fine-tuned CLIP) stands under both, since both were built on it.
    one, two = (
        inputs.published(table, measure.row, system, model) or inputs.published(table, measure.row, system)
        for model in MODELS
    )
    return Cell(measure.row, label, chance, (one, two))


def _majority(inputs: Inputs) -> list[Score]:
    """The training objects' most frequent class of each property, and combination, said of every test video."""
    trained = {a.object_id for a in inputs.assignments if a.part == Part.TRAIN}
    labels = [inputs.catalogue.labels(o) for o in sorted(trained)]
    # Ties go to the lower class, so that the baseline does not depend on any order of the objects.
    single = [
        min(Counter(column).items(), key=lambda item: (-item[1], item[0]))[0] for column in zip(*labels, strict=True)
    ]
    joint = min(Counter(labels).items(), key=lambda item: (-item[1], item[0]))[0]
    scores = []
    for a in inputs.assignments:
        if a.part == Part.TEST:
            actual = inputs.catalogue.labels(a.object_id)
            for name, guess, right in zip(inputs.catalogue.property_names, single, actual, strict=True):
                scores.append(_score(a.video_id, a.object_id, name, str(right), str(guess)))
            scores.append(_score(a.video_id, a.object_id, "combined", str(actual), str(joint)))
    return scores


def _as_scores(inputs: Inputs, records: Sequence[Classification]) -> list[Score]:
    by_video: dict[str, list[Classification]] = {}
    for record in records:
        by_video.setdefault(record.video_id, []).append(record)
    scores = []
    for video, judged in by_video.items():
        owner = judged[0].object_id
        scores += [_score(video, owner, c.property, str(c.expected), str(c.predicted)) for c in judged]
        expected, predicted = str([c.expected for c in judged]), str([c.predicted for c in judged])
        scores.append(_score(video, owner, "combined", expected, predicted))
    return scores


def _score(video: str, object_id: str, measure: str, expected: str, predicted: str) -> Score:
    return Score(
        question_id=video,
        task=Task.OPD,
        measure=measure,
        correct=expected == predicted,
        parsed=True,
        truncated=False,
        expected=expected,
        predicted=predicted,
        objects=(object_id,),
    )


def _label(axes: Axes) -> str:
    encoder, lora, opd = axes
    return f"{encoder} encoder, {lora} LoRA, OPD {opd}"
