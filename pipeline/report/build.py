"""Everything that a report is made of, from the results of a run to the files in reports/<scale>-<source>/."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import pandas as pd

from pipeline.config import AblationConfig, Params
from pipeline.config.params import PARAMS_FILE
from pipeline.core import layout
from pipeline.core.io import R, read_csv, read_jsonl, read_table, write_csv, write_json, write_text
from pipeline.core.records import TENSOR_FILE, Lora, Measurement, Part, Prediction, Question, TouchInput, Variant
from pipeline.encoder.records import Classification
from pipeline.evaluation.calibration import CalibrationRow, calibrated, calibration_rows
from pipeline.evaluation.grading import conclude, vision_models
from pipeline.evaluation.maps import map_frame, means
from pipeline.evaluation.records import Graded, GradedVision, Shown
from pipeline.evaluation.rows import HEADS, EffectRow, ScoreRow
from pipeline.evaluation.scores import effect_rows, score_rows
from pipeline.report.figures import draw_figures
from pipeline.report.load import load_report, published
from pipeline.report.provenance import provenance
from pipeline.report.readme import render_readme
from pipeline.report.samples import choose_examples, choose_samples
from pipeline.report.tables import headline, marked, over_seeds
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.records import Assignment, Finding, Video
from pipeline.videos.split import read_splits

MOST_METRICS = 12
"""Columns of `dvc metrics show` that a person still reads."""
LOGGED = ("loss", "validation_loss", "validation_combined")
"""Curves that a report keeps; the others are in data/ and in MLflow."""


def write_report(params: Params, root: Path) -> dict[str, float]:
    """Write reports/<scale>-<source>/ below `root`. The same input gives the same bytes.

    Args:
        params: those in params.yaml of `root`.
        root: holds data/, the weights and reports/.

    Returns:
        What metrics.json holds: accuracies from 0 to 1.

    Raises:
        UserError: where videos, split or graded answers are missing, or a file is broken. What a run may lack
            (an encoder, curves, samples) is not in its report.
    """
    folder = root / layout.REPORTS / params.report_name
    catalogue = load_catalogue(root / params.data.catalogue)
    videos = read_table(root / layout.VIDEOS, Video)
    splits = list(read_splits(params.split, params.ablation.seeds, root).values())
    graded = read_table(root / layout.GRADED, Graded)
    vision = [*_read(root / layout.GRADED_VISION, GradedVision), *_read(root / layout.EVALUATED, GradedVision)]
    # The heads' classifications; and, with the folds of a replicate pooled, these and what follows from them by rule.
    by_encoder: dict[int, list[Classification]] = {}
    pooled: dict[int, list[Classification]] = defaultdict(list)
    concluded: dict[int, list[Score]] = defaultdict(list)
    # As the stage `questions` took it.
    taken = catalogue.asking(params.questions.scenarios).called(params.questions.names)
    # By the lists in params.yaml, not by the files: after an ablation is narrowed, files of removed variants remain.
    for seed in sorted(params.ablation.seeds):
        if classified := _read(root / layout.encoder_dir(seed) / layout.CLASSIFIED_FILE, Classification):
            by_encoder[seed] = classified
            asked = read_jsonl(root / layout.questions_file(seed), Question)
            concluded[params.split.replicate_of(seed)] += conclude(asked, classified, taken)
            # A video may be in the validation part of several folds, each time another encoder's.
            fold = params.split.fold_of(seed)
            pooled[params.split.replicate_of(seed)] += [
                c.model_copy(update={"video_id": f"{c.video_id}@{fold}"}) if c.part is Part.VALIDATION else c
                for c in classified
            ]
    origin = provenance(params, catalogue, videos, splits, [g.objects for g in graded or vision], root)
    # Without those whose answers are to other questions than today's, which were not graded.
    rated = {(g.model, g.shown) for g in vision}
    sources = vision_models(root / layout.EXTERNAL / params.report_name).values()
    origin["vision"] = [s.model_dump(mode="json") for s in sources if (s.model, s.shown) in rated]
    write_csv(folder / "scores.csv", ScoreRow, score_rows(graded, catalogue, pooled, vision, concluded))
    write_csv(folder / "effects.csv", EffectRow, effect_rows(graded, catalogue, concluded, vision))
    write_csv(folder / "calibration.csv", CalibrationRow, calibration_rows(list(by_encoder.values())))
    audit = root / layout.AUDIT / "audit.csv"
    write_csv(folder / "audit.csv", Finding, read_csv(audit, Finding) if audit.is_file() else [])
    frames = {
        "dataset.csv": dataset_frame(catalogue, videos, splits),
        "confusion.csv": confusion_frame(pooled, catalogue),
        "described.csv": described_frame(by_encoder, params, root, catalogue),
        "curves.csv": curves_frame(root, params.ablation),
        "map.csv": maps_frame(params, root, catalogue),
    }
    for name, frame in frames.items():
        write_text(folder / name, frame.to_csv(index=False, lineterminator="\n"))
    full = [variant for variant in params.ablation.variants() if variant.full]
    examples = [pair for v in full for pair in _answered(root, v, "examples", "examples")]
    chosen = choose_samples(
        [pair for v in full[:1] for pair in _answered(root, v, "evaluation", TouchInput.REAL)],
        [g for g in graded if g.variant in full[:1] and g.touch is TouchInput.REAL],
    )
    write_json(folder / "samples.json", {**chosen, **choose_examples(examples, catalogue)})
    write_text(folder / "params.yaml", without_places((root / PARAMS_FILE).read_text(encoding="utf-8")))
    write_json(folder / "provenance.json", origin)
    return finish_report(folder)


def without_places(text: str) -> str:
    """The text of params.yaml for others to read: of this machine's paths only the last part, no tracking server."""
    text = re.sub(r"(?m)^(  uri: ).*$", r"\1''", text)
    return re.sub(r"(?m)^(  \w+: )['\"]?(?:/|~|[A-Za-z]:\\).*?([^/\\'\"\n]+)[/\\]*['\"]?$", r"\1\2", text)


def finish_report(folder: Path) -> dict[str, float]:
    """Write metrics.json, figures/ and README.md from the other files of a report; return the metrics."""
    report = load_report(folder)
    # The full system's tasks, then the encoder's heads on test videos.
    tasks, heads = headline(report.scores), over_seeds(report.scores[report.scores["task"] == HEADS])
    heads = heads.sort_values("measure", key=lambda measure: measure != "combined", kind="stable")
    named = [tasks.set_index("task"), heads.set_index("encoder_" + heads["measure"])]
    if not report.provenance["base_models"]:  # Of models that were trained before, their answers.
        others = marked(over_seeds(report.scores)).query(f"whole and by == 'shipped' and touch == '{Shown.TOUCH}'")
        named = [others.set_index(others["encoder"] + "_" + others["task"])]
    found = pd.concat(named)["accuracy"]
    metrics = {str(name): round(float(value), 6) for name, value in found.head(MOST_METRICS).items()}
    write_json(folder / "metrics.json", metrics)
    write_text(folder / "README.md", render_readme(report, draw_figures(report)))
    return metrics


def dataset_frame(
    catalogue: Catalogue, videos: Sequence[Video], splits: Sequence[Sequence[Assignment]]
) -> pd.DataFrame:
    """The paper's tables about its data set: one row per class, per combination of classes (that an object has or the
    paper counts), per number of videos that an object has, per property that is annotated, and per figure of lengths.

    `percent` is the share of all objects. An annotation is, as the paper counts, one rater's class of one video.
    Of several splits, an object counts in each part that any of them puts it in.
    Published figures stand beside where the catalogue is the paper's, joined by (table, row).
    """
    printed = published(catalogue.language.dataset)
    values = printed[printed["model"] == ""].set_index(["task", "measure"])["value"].to_dict()
    levels = [p.levels for p in catalogue.properties]
    labels = [catalogue.labels(o) for o in catalogue.objects]
    classes = [[words[n] for n in own] for words, *own in zip(levels, *labels, strict=True)]
    filmed = Counter(v.object_id for v in videos)
    parts = {(a.object_id, a.part) for assignments in splits for a in assignments}
    counted = ["objects", "with_videos", Part.TRAIN, Part.VALIDATION, Part.TEST]
    counts = [[1, filmed[o] > 0, *((o, part) in parts for part in counted[2:])] for o in catalogue.objects]
    objects = pd.DataFrame(counts, columns=[str(name) for name in counted]).astype("Int64")
    # By property and for all of them: what each object is, and what it can be.
    groups: list[tuple[str, str, list[str], list[str]]] = [
        ("property_counts", f"{p.name}: ", own, list(p.levels))
        for p, own in zip(catalogue.properties, classes, strict=True)
    ]
    have, every = ([", ".join(words) for words in them] for them in (zip(*classes, strict=True), product(*levels)))
    groups.append(("property_combinations", "", have, every))
    numbers = [str(n) for n in sorted({*filmed.values()})]
    groups.append(("videos_per_object", "", [str(filmed[o]) for o in catalogue.objects], numbers))
    found = []
    for table, before, own, names in groups:
        rows = objects.groupby(own).sum().reindex(names, fill_value=0)
        beside = [values.get((table, name)) for name in names]
        share = (100 * rows["objects"] / len(objects)).round(2)
        rows = rows.assign(table=table, row=[before + name for name in names], percent=share, published=beside)
        found.append(rows[(rows["objects"] > 0) | rows["published"].notna() | (table == "property_counts")])
    if videos:
        rated = [sum(len(catalogue.objects[v.object_id].ratings[i]) for v in videos) for i in range(len(levels))]
        rows = pd.DataFrame({"row": catalogue.property_names, "annotations": rated})
        found.append(rows.astype({"annotations": "Int64"}).assign(table="annotations"))
        figures = {"average": "mean", "median": "median", "minimum": "min", "maximum": "max"}
        frames = pd.Series([float(v.frames) for v in videos]).agg([*figures.values()]).tolist()
        beside = [values.get(("video_lengths", row)) for row in figures]
        found.append(pd.DataFrame({"table": "video_lengths", "row": [*figures], "frames": frames, "published": beside}))
    order = ["table", "row", "objects", "percent", *objects.columns[1:], "annotations", "frames", "published"]
    return pd.concat(found).reindex(columns=order)


def confusion_frame(by_seed: Mapping[int, Sequence[Classification]], catalogue: Catalogue) -> pd.DataFrame:
    """Rated and predicted class of test videos by the property heads: a row a seed, video and property."""
    levels = {p.name: p.levels for p in catalogue.properties}
    rows = [
        (seed, c.video_id, name, words[c.expected], words[c.predicted])
        for seed, found in sorted(by_seed.items())
        for name, words in levels.items()
        for c in found
        if c.part is Part.TEST and c.property == name
    ]
    return pd.DataFrame(rows, columns=["seed", "video_id", "property", "rated", "predicted"])


def maps_frame(params: Params, root: Path, catalogue: Catalogue) -> pd.DataFrame:
    """The maps of test videos by each encoder's embeddings, of the first seed alone."""
    seed = min(params.ablation.seeds)
    maps = [pd.DataFrame(columns=["encoder", "method", "video_id", "x", "y", *catalogue.property_names])]
    split = read_table(root / layout.split_file(seed), Assignment)
    tested = sorted((a for a in split if a.part is Part.TEST), key=lambda a: a.video_id)
    for encoder in sorted(params.ablation.encoders):
        folder = root / layout.embeddings_dir(encoder, seed)
        if len(tested) > 1 and (folder / TENSOR_FILE).is_file():
            maps.append(map_frame(means(folder, tested), tested, catalogue).assign(encoder=str(encoder)))
    return pd.concat(maps, ignore_index=True)


def described_frame(
    by_encoder: Mapping[int, Sequence[Classification]], params: Params, root: Path, catalogue: Catalogue
) -> pd.DataFrame:
    """What `octopi describe` says of test videos, beside their labels: a row a seed and video.

    Of each property: its label, the heads' class, and its calibrated probability; then the full system's own sentence.
    """
    levels = {p.name: p.levels for p in catalogue.properties}
    sentences: dict[tuple[int, str], str] = {}
    for variant in (v for v in params.ablation.variants() if v.full):
        for asked, answer in _answered(root, variant, "evaluation", TouchInput.REAL):
            if asked.task == "OPD":
                sentences[variant.seed, asked.videos[0]] = " ".join(answer.outputs[-1].split())
    rows: dict[tuple[int, str], dict[str, object]] = {}
    for seed, found in by_encoder.items():
        for _, c in calibrated(found):
            row = rows.setdefault((seed, c.video_id), {"seed": seed, "video_id": c.video_id})
            row[c.property] = levels[c.property][c.expected]
            row[f"{c.property}, heads"] = levels[c.property][c.predicted]
            row[f"{c.property}, probability"] = round(c.probabilities[c.predicted], 4)
    for key, row in rows.items():
        row["sentence"] = sentences.get(key, "")
    # A table without rows has a head all the same.
    return pd.DataFrame(rows.values() if rows else {"seed": [], "video_id": []})


def curves_frame(root: Path, ablation: AblationConfig) -> pd.DataFrame:
    """The histories of this ablation's trainings below data/; a stage is named as DVC names it."""
    places = {"pretrain": layout.PRETRAINED.parent}
    places |= {f"finetune_encoder@{seed}": layout.encoder_dir(seed) for seed in sorted(ablation.seeds, key=str)}
    for stage, lora in (("align", Lora.WITHOUT), ("lora", Lora.WITH)):
        trained = {layout.trained_dir(variant._replace(lora=lora)) for variant in ablation.variants()}
        places |= {f"{stage}@{folder.name}": folder for folder in sorted(trained)}
    rows = [
        (stage, m.name, m.step, m.value)
        for stage, folder in places.items()
        for m in sorted(_read(root / folder / layout.HISTORY_FILE, Measurement), key=lambda m: (m.name, m.step))
        if m.name in LOGGED
    ]
    return pd.DataFrame(rows, columns=["stage", "name", "step", "value"])


def _answered(root: Path, variant: Variant, asked: str, said: str) -> list[tuple[Question, Prediction]]:
    """A variant's questions with its answers, by the names of their files; none where either file is missing."""
    questions = root / layout.questions_file(variant.seed, asked)
    answers = root / layout.answers_dir(variant) / f"{said}.jsonl"
    if not questions.is_file() or not answers.is_file():
        return []
    by_id = {q.question_id: q for q in read_jsonl(questions, Question)}
    return [(by_id[p.question_id], p) for p in read_jsonl(answers, Prediction) if p.question_id in by_id]


def _read(path: Path, model: type[R]) -> list[R]:
    """The records of a table that a run may lack."""
    return read_table(path, model) if path.is_file() else []
