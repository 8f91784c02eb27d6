"""Scores to a folder of tables, figures and a page that a person reads."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from pipeline.io import read_table, write_json, write_text
from pipeline.params import PARAMS_FILE, Params
from pipeline.plan import Encoder
from pipeline.records import Embedding, Measurement, Part
from pipeline.reporting.audit import audit_table
from pipeline.reporting.compared_rows import EffectRow, FactorialRow
from pipeline.reporting.dataset import confusion_counts, dataset_tables
from pipeline.reporting.effects_figure import draw_effects
from pipeline.reporting.figures import Curve, draw_confusion, draw_curves, draw_embedding_map, training_panels
from pipeline.reporting.inputs import Inputs, no_test_videos, read_inputs
from pipeline.reporting.language import language_tables
from pipeline.reporting.page import Picture, render_page
from pipeline.reporting.provenance import provenance
from pipeline.reporting.results import headline, result_tables
from pipeline.reporting.samples import FOLDER as SAMPLES
from pipeline.reporting.samples import write_samples
from pipeline.reporting.stability import stability_table
from pipeline.reporting.table import Table, write_tables


def write_report(params: Params, root: Path) -> dict[str, float]:
    """Write reports/<scale>-<source>/ below `root` and return its headline accuracies (0 to 1) as flat metrics.

    The same input gives the same bytes. Other files in the folder are left alone.

    Raises:
        UserError: where the videos, the split or the questions are missing, or a file is broken. What is merely
            absent (scores, classifications, embeddings, curves) leaves cells or figures out, with a note why.
    """
    inputs = read_inputs(params, root)
    folder = root / "reports" / params.report_name
    checked = [audit_table(inputs.findings)] if inputs.findings else []
    checked += [stability_table(inputs.hard_cases)] if inputs.hard_cases else []
    tables = [*result_tables(inputs), *language_tables(inputs), *dataset_tables(inputs), *checked]
    write_tables(tables, folder)
    pictures = _draw(inputs, tables, root, folder / "figures")
    write_samples(inputs, root, folder / SAMPLES)
    origin = provenance(params, inputs.videos, [params.encoder.weights, params.language.weights], root)
    metrics = headline(inputs, tables)
    write_text(folder / "README.md", render_page(inputs, origin, tables, pictures))
    write_text(folder / "params.yaml", (root / PARAMS_FILE).read_text(encoding="utf-8"))
    write_json(folder / "provenance.json", origin.model_dump())
    write_json(folder / "metrics.json", metrics)
    return metrics


def _draw(inputs: Inputs, tables: Sequence[Table], root: Path, folder: Path) -> list[Picture]:
    folder.mkdir(parents=True, exist_ok=True)
    params = inputs.params
    footer = f"scale {params.scale}, source {params.data.source}, split {params.split.name}"
    pictures = [
        _confusion(inputs, folder, footer),
        _map(inputs, root, folder, footer),
        _curves(inputs, root, folder, footer),
        _effects(tables, folder, footer),
        _factorial(tables, folder, footer),
    ]
    for picture in pictures:
        if picture.missing:
            # A figure of an earlier run would pass for this one's.
            (folder / picture.file).unlink(missing_ok=True)
    return pictures


def _confusion(inputs: Inputs, folder: Path, footer: str) -> Picture:
    properties = inputs.catalogue.properties
    counts = [confusion_counts(inputs, p.name) for p in properties]
    right = [
        f"{p.name} {sum(c[i] for i, c in enumerate(m))} of {sum(map(sum, m))}"
        for p, m in zip(properties, counts, strict=True)
    ]
    picture = Picture(
        "confusion_matrices.png",
        "Confusion matrices",
        f"Confusion matrices of the fine-tuned encoder's heads on test videos. Right: {', '.join(right)}.",
        "What the fine-tuned encoder's heads say about test videos (summed over seeds). Numbers are videos, shades the "
        "share of a row; right answers stand on the diagonal.",
    )
    if not any(inputs.classifications.values()):
        return picture.without(_no_encoder(inputs))
    draw_confusion(folder / picture.file, properties, counts, footer)
    return picture


def _map(inputs: Inputs, root: Path, folder: Path, footer: str) -> Picture:
    import numpy as np

    test = {a.video_id: a.object_id for a in inputs.assignments if a.part == Part.TEST}
    key = next((k for k, job in inputs.params.plan.embeddings.items() if job.encoder is Encoder.FINETUNED), "")
    source = root / "data" / "embeddings" / key
    picture = Picture(
        "embedding_map.png",
        "Map of the embeddings",
        f"Scatter plots of {len(test)} test videos by the fine-tuned encoder's embeddings, one panel a property.",
        f"Each point is a test video: the mean embedding of its salient frames by the fine-tuned encoder ({key}), in "
        "two dimensions, by principal components and by t-SNE. In t-SNE neighbours are alike; distances between groups "
        "mean nothing.",
    )
    if len(test) < 2:
        return picture.without(no_test_videos(inputs) if not test else "one test video alone has no neighbours")
    if not key or not (source / "index.parquet").is_file():
        return picture.without("no embeddings of a fine-tuned encoder")
    from safetensors.numpy import load_file

    tensor = load_file(source / "embeddings.safetensors")["embeddings"]
    rows: dict[str, list[int]] = defaultdict(list)
    for entry in read_table(source / "index.parquet", Embedding):
        if entry.flip == "none" and entry.video_id in test:
            rows[entry.video_id].append(entry.row)
    features = np.stack([tensor[rows[video]].mean(axis=0, dtype=np.float64) for video in rows])
    labels = [inputs.catalogue.labels(test[video]) for video in rows]
    draw_embedding_map(folder / picture.file, features, labels, inputs.catalogue.properties, footer)
    return picture


def _curves(inputs: Inputs, root: Path, folder: Path, footer: str) -> Picture:
    plan = inputs.params.plan
    encoder = {str(seed): _history(root / "data" / "encoder" / str(seed)) for seed in plan.encoder_seeds}
    stages = (("Alignment", "align", plan.align), ("LoRA", "lora", plan.lora))
    pretrained = {
        "Pretraining on scenes": [
            Curve("invented objects", history)
            for key in plan.pretrain
            if (history := _history(root / "data" / "pretrained" / key))
        ]
    }
    language = {
        title: [
            Curve(f"OPD {job.opd}", history, dashed=job.encoder is Encoder.BASE)
            for key, job in jobs.items()
            if (history := _history(root / "data" / stage / key))
        ]
        for title, stage, jobs in stages
    }
    panels = training_panels({seed: points for seed, points in encoder.items() if points}, pretrained | language)
    picture = Picture(
        "training_curves.png",
        "Training curves",
        f"Line plots over optimiser steps: {'; '.join(f'{p.title}, {p.ylabel}' for p in panels)}.",
        "One line a seed and variant; validation accuracy is over validation videos.",
    )
    if not panels:
        return picture.without("no history of any training")
    draw_curves(folder / picture.file, panels, footer)
    return picture


def _effects(tables: Sequence[Table], folder: Path, footer: str) -> Picture:
    rows = [row for table in tables for row in table.rows if isinstance(row, EffectRow)]
    picture = Picture(
        "effects.png",
        "What each part brings, drawn",
        _panels(rows),
        "Differences of the table above with the other axes as the paper proposes. A line that crosses zero shows no "
        "effect; a hollow point is of a task that the base language model cannot do either.",
    )
    return _drawn(picture, rows, "no two variants that differ in one axis", folder, footer)


def _factorial(tables: Sequence[Table], folder: Path, footer: str) -> Picture:
    rows = [row for table in tables for row in table.rows if isinstance(row, FactorialRow)]
    picture = Picture(
        "factorial.png",
        "Main effects and interactions, drawn",
        _panels(rows),
        "Main effects (dots, above the dotted line) and interactions (diamonds, below it) over all variants. An "
        "interaction that crosses zero gives no reason to doubt that the parts' effects add up; a hollow point is of a "
        "task that the base language model cannot do either.",
    )
    return _drawn(picture, rows, "the plan's variants cross no two parts", folder, footer)


def _panels(rows: Sequence[EffectRow | FactorialRow]) -> str:
    return f"Points with intervals, one panel a task: {', '.join(dict.fromkeys(row.task for row in rows))}."


def _drawn(
    picture: Picture, rows: Sequence[EffectRow] | Sequence[FactorialRow], missing: str, folder: Path, footer: str
) -> Picture:
    if not rows:
        return picture.without(missing)
    draw_effects(folder / picture.file, rows, footer)
    return picture


def _history(folder: Path) -> list[Measurement]:
    file = folder / "history.parquet"
    return read_table(file, Measurement) if file.is_file() else []


def _no_encoder(inputs: Inputs) -> str:
    return no_test_videos(inputs) if not inputs.test_objects else "no classifications: no encoder was fine-tuned"
