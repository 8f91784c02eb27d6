"""Training of the tactile encoder on property labels.

`paper` and `release` learn visual prompts and heads on a frozen CLIP by gradients (the paper's section III-A); `strong`
fits heads to the frozen features of an encoder that scenes have pretrained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch.nn import functional as F
from torch.utils.data import DataLoader
from transformers import EvalPrediction, TrainerCallback

from pipeline.config import EncoderConfig, RuntimeConfig
from pipeline.encoder.clips import ClipDataset, LabelledVideo, collate_clips
from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.frame_heads import Clips, choose_strength, fit_votes
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.encoder.recipes import property_classifier
from pipeline.errors import UserError
from pipeline.records import Assignment, Classification, Measurement, Part
from pipeline.runtime import resolve_device, seed_everything
from pipeline.trainable import load_trainable
from pipeline.training import (
    TrainableTrainer,
    TrainingMonitor,
    checkpoint_dir,
    fingerprint,
    train,
    training_arguments,
)
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore


@dataclass(frozen=True)
class EncoderData:
    """What the encoder is trained and judged on."""

    store: FrameStore
    catalogue: Catalogue
    assignments: Sequence[Assignment]
    per_video: int

    def videos(self, part: Part) -> list[LabelledVideo]:
        """The labelled videos of a part."""
        return [
            LabelledVideo(a.video_id, self.catalogue.labels(a.object_id)) for a in self.assignments if a.part == part
        ]

    @property
    def classes(self) -> list[int]:
        """Number of classes of each property."""
        return [len(p.levels) for p in self.catalogue.properties]


def finetune(
    data: EncoderData,
    config: EncoderConfig,
    runtime: RuntimeConfig,
    *,
    seed: int,
    inputs: Sequence[Path],
    pretrained: Path,
    callbacks: Sequence[TrainerCallback] = (),
) -> tuple[PropertyClassifier, list[Measurement]]:
    """Train the classifier of the recipe.

    Args:
        inputs: Files that a training by gradients depends on, for its checkpoints' fingerprint.
        callbacks: Further callbacks for its Trainer, such as tracking.
        pretrained: File of the encoder that scenes have pretrained; read for `strong` alone.

    Returns:
        The classifier, and its training's curve.
    """
    seed_everything(seed)
    model = property_classifier(config, data.classes)
    if isinstance(model, FrameVotes):
        load_trainable(model.encoder, pretrained)
        return model, fit_heads(model, data, config, runtime, seed)
    return model, train_classifier(model, data, config, runtime, seed=seed, inputs=inputs, callbacks=callbacks)


def fit_heads(
    model: FrameVotes, data: EncoderData, config: EncoderConfig, runtime: RuntimeConfig, seed: int
) -> list[Measurement]:
    """Fit a strong classifier's heads to the evaluation clips of the training videos."""
    videos = data.videos(Part.TRAIN)
    clips = describe_clips(model.encoder, data, videos, config.embed_batch_size, resolve_device(runtime.device))
    labels = np.array([video.labels for video in videos])
    owners = {a.video_id: a.object_id for a in data.assignments}
    objects = [owners[video.video_id] for video in videos]
    strength, curve = choose_strength(clips, labels, objects, data.classes, seed)
    fit_votes(clips, labels, objects, data.classes, strength).put_into(model)
    return curve


def train_classifier(
    model: PropertyClassifier,
    data: EncoderData,
    config: EncoderConfig,
    runtime: RuntimeConfig,
    *,
    seed: int,
    inputs: Sequence[Path | str],
    callbacks: Sequence[TrainerCallback] = (),
) -> list[Measurement]:
    """Train what is not frozen; the epoch of best combined validation accuracy is kept (ties: the first).

    Without validation videos there is nothing to choose by, and the last epoch is kept.
    """
    train_set = ClipDataset(
        data.store,
        data.videos(Part.TRAIN),
        per_video=data.per_video,
        seed=seed,
        flip_probability=config.flip_probability,
    )
    validation = data.videos(Part.VALIDATION)
    mark = fingerprint(config, seed, data.per_video, *inputs)
    arguments = training_arguments(
        checkpoint_dir(f"finetune_encoder-{seed}", mark),
        runtime,
        seed,
        num_train_epochs=config.epochs,
        per_device_train_batch_size=config.batch_size,
        per_device_eval_batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        eval_strategy="epoch" if validation else "no",
        save_strategy="epoch",
        save_total_limit=2,
        load_best_model_at_end=bool(validation),
        metric_for_best_model="validation_combined" if validation else None,
        logging_strategy="epoch",
    )
    trainer = TrainableTrainer(
        model=model,
        args=arguments,
        train_dataset=train_set,
        eval_dataset=ClipDataset(data.store, validation, per_video=data.per_video) if validation else None,
        data_collator=collate_clips,
        compute_metrics=lambda prediction: accuracies(prediction, data.catalogue),
        callbacks=[TrainingMonitor(), *callbacks],
        wave=math.ceil(len(train_set) / config.batch_size) if config.recipe == "release" else None,
    )
    return train(trainer).history


def accuracies(prediction: EvalPrediction, catalogue: Catalogue) -> dict[str, float]:
    """Validation accuracy a property, and combined: all properties of a video right."""
    logits, labels = cast(np.ndarray, prediction.predictions), cast(np.ndarray, prediction.label_ids)
    borders = np.cumsum([len(p.levels) for p in catalogue.properties])[:-1]
    guesses = np.stack([z.argmax(1) for z in np.split(logits, borders, axis=1)], axis=1)
    right = guesses == labels
    single = {f"validation_{p.name}": float(r.mean()) for p, r in zip(catalogue.properties, right.T, strict=True)}
    return {**single, "validation_combined": float(right.all(1).mean())}


@torch.inference_mode()
def describe_clips(
    encoder: FrameEncoder, data: EncoderData, videos: Sequence[LabelledVideo], batch_size: int, device: torch.device
) -> Clips:
    """What the encoder says of the frames of each video's evaluation clip: float32, videos x frames x features."""
    encoder = encoder.to(device).eval()
    clips = ClipDataset(data.store, videos, per_video=data.per_video)
    features = []
    for batch in DataLoader(clips, batch_size=max(1, batch_size // data.per_video), collate_fn=collate_clips):
        frames, moments = batch["frames"].to(device), batch["moments"].to(device)
        described = encoder.describe(frames.flatten(0, 1), moments.flatten())
        features.append(described.view(*frames.shape[:2], -1).float().cpu())
    found = torch.cat(features)
    _check_finite(found.flatten(1), videos)
    return found.numpy()


@torch.inference_mode()
def classify(
    model: PropertyClassifier, data: EncoderData, parts: Sequence[Part], batch_size: int, device: torch.device
) -> list[Classification]:
    """What the heads say about the evaluation clip of each video of these parts."""
    model = model.to(device).eval()
    objects = {a.video_id: a.object_id for a in data.assignments}
    records = []
    for part in parts:
        videos = data.videos(part)
        clips = ClipDataset(data.store, videos, per_video=data.per_video)
        outputs = [
            model(batch["frames"].to(device), batch["moments"].to(device))["logits"].cpu()
            for batch in DataLoader(clips, batch_size=batch_size, collate_fn=collate_clips)
        ]
        if not outputs:
            continue
        logits = torch.cat(outputs)
        _check_finite(logits, videos)
        decided = model.decide(logits)
        for index, property_ in enumerate(data.catalogue.properties):
            rows = F.softmax(logits.split(data.classes, dim=1)[index].double(), dim=1)
            for video, row, classes in zip(videos, rows, decided.tolist(), strict=True):
                records.append(
                    Classification(
                        video_id=video.video_id,
                        object_id=objects[video.video_id],
                        part=part,
                        property=property_.name,
                        expected=video.labels[index],
                        predicted=classes[index],
                        probabilities=tuple(row.tolist()),
                    )
                )
    return records


def _check_finite(values: torch.Tensor, videos: Sequence[LabelledVideo]) -> None:
    """Values are videos x whatever."""
    for video, finite in zip(videos, values.isfinite().all(1).tolist(), strict=True):
        if not finite:
            raise UserError(
                f"{video.video_id}: what the encoder says of it is not finite; check the video and encoder.weights"
            )
