"""Training of the tactile encoder on property labels.

`paper` and `release` learn visual prompts and heads on a frozen CLIP by gradients (the paper's section III-A);
`pretrained` fits heads to the frozen features of an encoder that synthetic pictures have pretrained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.card import write_card
from pipeline.config import EncoderConfig, RuntimeConfig
from pipeline.encoder.clips import ClipDataset, EncoderData, collate_clips, describe_clips
from pipeline.encoder.frame_classifier import JointFrameClassifier, choose_strength, fit_frame_heads
from pipeline.encoder.model import PropertyClassifier
from pipeline.encoder.recipes import property_classifier
from pipeline.io import fingerprint
from pipeline.records import Measurement, Part
from pipeline.runtime import resolve_device, seed_everything
from pipeline.training.trainable import load_trainable
from pipeline.videos.catalogue import Catalogue

if TYPE_CHECKING:
    from transformers import EvalPrediction, TrainerCallback

GRADIENT_SETTINGS = {
    *("prompts", "prompt_layers", "epochs", "batch_size", "micro_batch_size", "autocast"),
    *("learning_rate", "weight_decay", "flip_probability"),
}
"""Of the section `encoder`: they mean nothing where heads are fitted."""


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
        pretrained: File of the encoder that synthetic pictures have pretrained; read for `pretrained` alone.

    Returns:
        The classifier, and its training's curve.
    """
    seed_everything(seed)
    model = property_classifier(config, data.classes)
    if isinstance(model, JointFrameClassifier):
        load_trainable(model.encoder, pretrained)
        return model, fit_heads(model, data, config, runtime, seed)
    return model, train_classifier(model, data, config, runtime, seed=seed, inputs=inputs, callbacks=callbacks)


def fit_heads(
    model: JointFrameClassifier, data: EncoderData, config: EncoderConfig, runtime: RuntimeConfig, seed: int
) -> list[Measurement]:
    """Fit a per-frame classifier's heads to the evaluation clips of the training videos."""
    videos = data.videos(Part.TRAIN)
    clips = describe_clips(model.encoder, data, videos, config.embed_batch_size, resolve_device(runtime.device))
    labels = np.array([video.labels for video in videos])
    owners = {a.video_id: a.object_id for a in data.assignments}
    objects = [owners[video.video_id] for video in videos]
    strength, curve = choose_strength(clips, labels, objects, data.classes, seed)
    fit_frame_heads(clips, labels, objects, data.classes, strength).copy_into(model)
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
    # Imported here, since fitted heads need no Trainer, and importing it takes seconds.
    from pipeline.training.trainer import TrainableTrainer, TrainingMonitor, checkpoint_dir, train, training_arguments

    train_set = ClipDataset(
        data.store,
        data.videos(Part.TRAIN),
        per_video=data.per_video,
        seed=seed,
        flip_probability=config.flip_probability,
    )
    validation = data.videos(Part.VALIDATION)
    micro = min(config.micro_batch_size or config.batch_size, config.batch_size)
    folder = checkpoint_dir(f"finetune_encoder-{seed}", fingerprint(config, seed, data.per_video, *inputs))
    arguments = training_arguments(
        folder,
        runtime,
        seed,
        num_train_epochs=config.epochs,
        per_device_train_batch_size=micro,
        per_device_eval_batch_size=micro,
        gradient_accumulation_steps=config.batch_size // micro,
        bf16=config.autocast == "bfloat16",
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
        wave=math.ceil(len(train_set) / config.batch_size) if model.cosine_per_epoch else None,
    )
    return train(trainer).history


def write_encoder_card(
    folder: Path, data: EncoderData, config: EncoderConfig, seed: int, pretrained: Path, source: str
) -> None:
    """Write the card of a fine-tuned encoder beside it."""
    fitted = config.recipe == "pretrained"
    names = [p.name for p in data.catalogue.properties]
    training = [a for a in data.assignments if a.part == Part.TRAIN]
    unused = {"weights", "standardize", "embed_batch_size"} | (GRADIENT_SETTINGS if fitted else set())
    write_card(
        folder,
        f"Tactile encoder with property heads, recipe {config.recipe}",
        bases={"network pretrained on synthetic pictures": pretrained} if fitted else {"CLIP": Path(config.weights)},
        data={
            f"training videos ({source})": len(training),
            "training objects": len({a.object_id for a in training}),
            "frames a video": data.per_video,
            "properties": names,
        },
        settings={**config.model_dump(exclude=unused), "seed": seed},
        limits=(
            f"It gives classes of {', '.join(names)} as annotators rated them, and no physical quantity.",
            "It knows objects and sensors only as its training videos show them.",
            "Weights of the base model that were frozen are not in this folder.",
        )[: 2 if fitted else 3],
    )


def accuracies(prediction: EvalPrediction, catalogue: Catalogue) -> dict[str, float]:
    """Validation accuracy a property, and combined: all properties of a video right."""
    logits, labels = cast(np.ndarray, prediction.predictions), cast(np.ndarray, prediction.label_ids)
    borders = np.cumsum([len(p.levels) for p in catalogue.properties])[:-1]
    guesses = np.stack([z.argmax(1) for z in np.split(logits, borders, axis=1)], axis=1)
    right = guesses == labels
    single = {f"validation_{p.name}": float(r.mean()) for p, r in zip(catalogue.properties, right.T, strict=True)}
    return {**single, "validation_combined": float(right.all(1).mean())}
