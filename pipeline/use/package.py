"""Packaging: what the chain made of one variant, and what its answers need, in one folder."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from huggingface_hub import EvalResult

from pipeline.config import LANGUAGE_DIR, Params
from pipeline.core import layout
from pipeline.core.io import atomic_folder, read_json, read_jsonl, read_table, save_tensors, write_json
from pipeline.core.records import Encoder, Lora, Part, Question, TouchInput, Variant
from pipeline.encoder.records import Classification
from pipeline.evaluation.calibration import calibration_rows, fit_temperature
from pipeline.evaluation.grading import conclude
from pipeline.evaluation.records import Graded
from pipeline.evaluation.scores import score_rows
from pipeline.language.base import load_tokenizer
from pipeline.language.octopi import ADAPTER_DIR, CONFIG_FILE
from pipeline.language.start import OBJECTS_FILE
from pipeline.running.errors import UserError
from pipeline.tasks import TASKS
from pipeline.training.card import CARD_FILE, write_card
from pipeline.training.embeddings import STATISTICS_FILE, EmbeddingStore, Statistics
from pipeline.training.sampling import sample_evaluation
from pipeline.use.folder import (
    BACKBONE_DIR,
    BASE_DIR,
    CATALOGUE,
    CONFIG,
    ENCODER_DIR,
    SCENES,
    TRAINED,
    Base,
    ModelConfig,
    chat_sample,
    distance,
    find_base,
    provenance,
    read_folder,
)
from pipeline.videos.audit.files import quiet_level
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.frames.store import PROBES_FILE
from pipeline.videos.records import Assignment, Probe
from pipeline.weights.backbones import TIMM_WEIGHTS, backbone_files

LIMITS = (
    "It knows objects and sensors only as its training videos show them; for another, adapt it or train it anew.",
    "It was asked templates of the tasks above; what it answers to other questions was never measured.",
    "Its probabilities are calibrated on validation objects of the same sensor, and mean little for another.",
    "It does not say that it does not know; heed the notes of `look` and `describe`.",
    "Answers must not steer a machine that can hurt somebody.",
)


def package(params: Params, variant: Variant, base: Base, out: Path) -> None:
    """Write one variant's folder.

    Args:
        base: The language model.
        out: The folder, made anew.
    """
    encoder, language = params.encoder, params.language
    catalogue = load_catalogue(Path(params.data.catalogue))
    classified = read_table(layout.encoder_dir(variant.seed) / layout.CLASSIFIED_FILE, Classification)
    embeddings = layout.embeddings_dir(variant.encoder, variant.seed)
    validated = [c for c in classified if c.part == Part.VALIDATION]
    temperatures = {
        p.name: fit_temperature([c for c in validated if c.property == p.name]) for p in catalogue.properties
    }
    scores, ruled = _scores(params, variant, catalogue, classified)
    with atomic_folder(out) as folder:
        _copy(layout.encoder_dir(variant.seed) / TRAINED, folder / ENCODER_DIR / TRAINED)
        files, card = backbone_files(encoder), Path(encoder.weights) / CARD_FILE
        if card.is_file() and any(file.parent == card.parent for file in files):
            files.append(card)
        if "timm" in encoder.backbone:
            from pipeline.encoder.timm_backbone import STAGES, load_backbone

            files.remove(Path(encoder.weights) / TIMM_WEIGHTS)
            save_tensors(
                folder / ENCODER_DIR / BACKBONE_DIR / STAGES, load_backbone(encoder, tuned=False).model.state_dict()
            )
        for file in files:
            _copy(file, folder / ENCODER_DIR / (SCENES if file == layout.PRETRAINED else f"{BACKBONE_DIR}/{file.name}"))
        _copy(embeddings / STATISTICS_FILE, folder / ENCODER_DIR / STATISTICS_FILE)
        trained, aligned = layout.trained_dir(variant), layout.trained_dir(variant._replace(lora=Lora.WITHOUT))
        for file in (trained / CONFIG_FILE, *sorted(trained.glob("*.safetensors"))):
            _copy(file, folder / LANGUAGE_DIR / file.name)
        if (trained / ADAPTER_DIR).is_dir():
            shutil.copytree(trained / ADAPTER_DIR, folder / LANGUAGE_DIR / ADAPTER_DIR)
        write_json(folder / CATALOGUE, catalogue.model_dump(mode="json"))
        config = ModelConfig(
            **provenance(folder),
            variant=variant.key,
            encoder_used=variant.encoder,
            opd=variant.opd,
            trained_on=params.data.source,
            facts=params.questions.facts,
            names=params.questions.names,
            frames=params.frames,
            encoder=encoder,
            language=language,
            base=base,
            chat=chat_sample(load_tokenizer(Path(language.weights)), language),
            quiet=quiet_level(read_table(layout.FRAMES / PROBES_FILE, Probe)),
            usual=_largest_distance(embeddings, layout.split_file(variant.seed), params),
            temperatures=temperatures,
            objects=read_json(aligned / OBJECTS_FILE),
            scores={task: score[1:4] for task, score in scores.items()},
        )
        write_json(folder / CONFIG, config.model_dump(mode="json"))
        known = read_json(layout.REPORTS / params.report_name / "provenance.json")["settings"]
        _write_card(folder, config, classified, scores, ruled, params, known)


def export(folder: Path, to: Path, *, with_base: bool = False, base: Path | None = None) -> None:
    """Copy a folder, and put its language model in where `with_base`.

    Raises:
        UserError: where `to` is there already, the folder is no trained model, or its language model is not found.
    """
    config, _ = read_folder(folder)
    if to.exists():
        raise UserError(f"{to}: is there already; name a folder that is not")
    with atomic_folder(to) as made:
        shutil.copytree(folder, made, dirs_exist_ok=True, ignore=shutil.ignore_patterns(BASE_DIR))
        if with_base:
            found, doubts = find_base(folder, config.base, base)
            if doubts:
                raise UserError(f"{found}: {doubts[0]}; put no other model in, and name it where it is asked")
            shutil.copytree(found, made / BASE_DIR)


class TaskScore(NamedTuple):
    """Accuracy on one task."""

    n: int
    accuracy: float
    low: float
    high: float
    chance: float

    @property
    def shown(self) -> str:
        """In percent, with its interval."""
        return f"{100 * self.accuracy:.1f} [{100 * self.low:.1f}, {100 * self.high:.1f}]"


def _scores(
    params: Params, variant: Variant, catalogue: Catalogue, classified: Sequence[Classification]
) -> tuple[dict[str, TaskScore], dict[str, TaskScore]]:
    """By task, the accuracy of one model and of its encoder's heads with rules, where it has an interval.

    With folds this is its own fold, about objects that it was not trained on; the report pools the models of all folds.
    """
    graded = [
        g.model_copy(update={"seed": g.trained})
        for g in read_table(layout.GRADED, Graded)
        if g.variant == variant and g.touch is TouchInput.REAL
    ]
    asked = read_jsonl(layout.questions_file(variant.seed), Question)
    taken = catalogue.asking(params.questions.scenarios).called(params.questions.names)
    heads = {variant.seed: conclude(asked, classified, taken)} if variant.encoder is Encoder.FINETUNED else {}
    found: dict[bool, dict[str, TaskScore]] = {True: {}, False: {}}
    for row in score_rows(graded, catalogue, concluded=heads):
        whole = row.task in TASKS and row.measure == TASKS[row.task].measure and row.seed == str(variant.seed)
        if whole and row.low is not None and row.high is not None and row.chance is not None:
            found[bool(row.lora)][row.task] = TaskScore(row.n, row.accuracy, row.low, row.high, row.chance)
    return found[True], found[False]


def _largest_distance(embeddings: Path, split: Path, params: Params) -> float:
    """Largest distance of a training or validation video from the training mean, rounded up."""
    store, known = EmbeddingStore(embeddings), Statistics.load(embeddings / STATISTICS_FILE)
    distances = []
    for assignment in read_table(split, Assignment):
        if assignment.part in (Part.TRAIN, Part.VALIDATION):
            places = sample_evaluation(store.count(assignment.video_id), params.frames.per_video)
            found = store.features(assignment.video_id, places).double()
            distances.append(
                distance(found.numpy() if params.encoder.standardize else ((found - known.mean) / known.scale).numpy())
            )
    # Rounded up to the four digits that config.json keeps: rounding down would flag the farthest video itself.
    return math.ceil(1e4 * max(distances, default=0.0)) / 1e4


def _copy(source: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, to)


def _write_card(
    folder: Path,
    config: ModelConfig,
    classified: Sequence[Classification],
    scores: Mapping[str, TaskScore],
    ruled: Mapping[str, TaskScore],
    params: Params,
    known: str,
) -> None:
    """`ruled` are the scores of heads and rules; `known` says whether test objects were looked at before."""
    calibrated = calibration_rows([classified])
    bases = {"language model": Path(params.language.weights)}
    if (folder / ENCODER_DIR / BACKBONE_DIR).is_dir():
        bases["tactile encoder"] = Path(params.encoder.weights)
    if "scenes" in params.encoder.backbone:
        bases["tactile encoder, pretrained on synthetic scenes"] = layout.PRETRAINED
    results = [
        EvalResult(
            task_type="visual-question-answering",
            task_name=TASKS[task].title,
            dataset_type="tactile-videos",
            dataset_name=f"{params.data.source}, split {params.split.name}, test objects",
            dataset_config=task,  # By which the Hub tells results about one data set apart.
            metric_type="accuracy",
            metric_value=s.accuracy,
            metric_args={"low": s.low, "high": s.high, "n": s.n},
        )
        for task, s in scores.items()
    ]
    write_card(
        folder,
        f"Octopi: a language model with touch, {config.variant}",
        bases=bases,
        data={
            "videos": params.data.source,
            "catalogue": params.data.catalogue,
            "split": f"{params.split.name}; scores are of its test objects, which nothing was trained on",
            **({"test objects": " ".join(known.split())} if known else {}),
        },
        settings={
            **{
                f"{s}.{name}": value
                for s in ("frames", "encoder", "questions", "language", "align", "lora")
                for name, value in getattr(params, s).model_dump().items()
            },
            **config.versions,
        },
        limits=LIMITS,
        front={"library_name": "octopi-pipeline", "model_name": config.variant, "eval_results": results},
        tables={
            "Scores": [
                {
                    "Task": f"{TASKS[task].title} ({task})",
                    "n": s.n,
                    "Accuracy, %": s.shown,
                    "Heads and rules, %": ruled[task].shown if task in ruled else "",
                    "Chance, %": f"{100 * s.chance:.1f}",
                }
                for task, s in scores.items()
            ],
            "Calibration of the heads' probabilities": [
                {
                    "Property": row.property,
                    "Temperature": f"{config.temperatures[row.property]:.2f}",
                    "Test videos": row.n,
                    "Expected calibration error": f"{row.error:.3f}",
                    "Without the temperature": f"{row.without_temperature:.3f}",
                }
                for row in calibrated
            ],
        },
    )
