"""Training of the tactile encoder on property labels.

`paper` and `release` learn visual prompts and heads on a frozen CLIP by gradients (the paper's section IV-A); `tuned`
fits heads to frozen backbones and then tunes both (`pipeline.encoder.tuned`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import default_collate

from pipeline.config import EncoderConfig, RuntimeConfig
from pipeline.core.records import Measurement, Part
from pipeline.core.runtime import resolve_device, seed_everything
from pipeline.encoder.data import ClipDataset, EncoderData, LabelledVideo, check_finite
from pipeline.encoder.frame_classifier import JointFrameClassifier, choose_strength, fit_frame_heads
from pipeline.encoder.model import PropertyClassifier, SideBySide
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.tuned import TrunkDataset, Trunks, run_trunks
from pipeline.training.card import write_card
from pipeline.training.sampling import EpochDataset
from pipeline.training.trainable import trainable_state
from pipeline.videos.catalogue import Catalogue
from pipeline.weights.backbones import BACKBONES

if TYPE_CHECKING:
    from transformers import EvalPrediction, TrainerCallback

COMBINED = "validation_combined"
"""The measure that chooses the epoch."""


@dataclass(frozen=True)
class Training:
    """All that a training depends on."""

    data: EncoderData
    config: EncoderConfig
    runtime: RuntimeConfig
    seed: int
    inputs: Sequence[Path]
    """Files that a training by gradients depends on, for its checkpoints' fingerprint."""
    stage: str = "finetune_encoder@0"
    """In whose folder checkpoints lie, until all is written."""
    callbacks: Sequence[TrainerCallback] = ()
    """Further callbacks for its Trainer, such as tracking."""


def finetune(training: Training) -> tuple[PropertyClassifier, list[Measurement]]:
    """Train the recipe's classifier; return it with its training curve.

    `tuned` fits the heads, then tunes them and what is unfrozen of the encoder. The fitted heads count as epoch 0, and
    the best epoch is kept (ties: the first). Without validation videos the heads are kept as they were fitted, since
    nothing could show that tuning helps.
    """
    data, config, device = training.data, training.config, resolve_device(training.runtime.device)
    seed_everything(training.seed)
    model = property_classifier(config, data.classes)
    if not isinstance(model, JointFrameClassifier):
        return model, train_classifier(model, training)
    encoder, chosen = model.encoder, data.videos(Part.VALIDATION)
    assert isinstance(encoder, SideBySide)
    videos, mirrored = [*data.videos(Part.TRAIN), *chosen], config.flip_probability > 0
    trunks = run_trunks(encoder, data, videos, device, mirrored=mirrored)
    model.to(device)

    @torch.inference_mode()
    def described(videos: Sequence[LabelledVideo]) -> tuple[torch.Tensor, npt.NDArray[np.int64]]:
        """Features of the videos' evaluation clips, videos x frames x dim, and labels."""
        rows = [encoder.stages([output.to(device) for output in trunks.of(video.video_id)]) for video in videos]
        found = torch.stack(rows).float().cpu()
        check_finite(found.flatten(1), videos)
        return found, np.array([v.labels for v in videos])

    features, labels = described(data.videos(Part.TRAIN))
    objects = [a.object_id for a in data.assignments if a.part == Part.TRAIN]
    fitted = (features.numpy(), labels, objects, data.classes)
    strength, curve = choose_strength(*fitted, training.seed)
    fit_frame_heads(*fitted, strength).copy_into(model)
    if not chosen:
        return model, curve
    probe = {name: value.clone() for name, value in trainable_state(model).items()}
    features, labels = described(chosen)
    with torch.inference_mode():
        logits = torch.cat(model.classify(features.to(device)), dim=1).cpu().numpy()
    reached = accuracies(logits, labels, model.decide, data.catalogue)
    curve += [Measurement(step=0, name=name, value=value) for name, value in sorted(reached.items())]
    history = train_classifier(model, training, trunks)
    if max(m.value for m in history if m.name == COMBINED) <= reached[COMBINED]:
        with torch.no_grad():
            for name, value in trainable_state(model).items():
                value.copy_(probe[name])
    return model, [*curve, *history]


def train_classifier(model: PropertyClassifier, training: Training, trunks: Trunks | None = None) -> list[Measurement]:
    """Train what is not frozen; the epoch of best combined validation accuracy is kept (ties: the first).

    Without validation videos there is nothing to choose by, and the last epoch is kept. With `trunks`, the model is
    given these in place of pictures.
    """
    # Imported here, since fitted heads need no Trainer, and importing it takes seconds.
    from pipeline.training.trainer import TrainableTrainer, checkpoint_dir, train, training_arguments

    data, config = training.data, training.config
    show: Callable[..., EpochDataset[Any]] = (
        partial(ClipDataset, data.store, per_video=data.per_video) if trunks is None else partial(TrunkDataset, trunks)
    )
    chosen = data.videos(Part.VALIDATION)
    # Labels are part of the checkpoints' key, so that after a correction no training resumes from the wrong labels.
    labelled = repr([(a.video_id, a.part, data.catalogue.labels(a.object_id)) for a in data.assignments])
    folder = checkpoint_dir(training.stage, config, training.seed, data.per_video, labelled, *training.inputs)
    # The published code's cosine falls to a hundredth within one epoch and rises again in the next: half a cycle an
    # epoch.
    waves = {
        "lr_scheduler_type": "cosine_with_min_lr",
        "lr_scheduler_kwargs": {"min_lr_rate": 0.01, "num_cycles": config.epochs / 2},
    }
    arguments = training_arguments(
        folder,
        training.runtime,
        training.seed,
        config,
        num_train_epochs=config.epochs,
        bf16=config.autocast == "bfloat16",
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        eval_strategy="epoch" if chosen else "no",
        save_strategy="epoch",
        save_total_limit=2,
        metric_for_best_model=COMBINED if chosen else None,
        logging_strategy="epoch",
        **(waves if config.recipe == "release" else {}),
    )

    def measures(prediction: EvalPrediction) -> dict[str, float]:
        logits, labels = cast(np.ndarray, prediction.predictions), cast(np.ndarray, prediction.label_ids)
        return accuracies(logits, labels, model.decide, data.catalogue)

    trainer = TrainableTrainer(
        model=model,
        args=arguments,
        train_dataset=show(data.videos(Part.TRAIN), seed=training.seed, flip_probability=config.flip_probability),
        eval_dataset=show(chosen) if chosen else None,
        data_collator=default_collate,
        compute_metrics=measures,
        callbacks=training.callbacks,
    )
    return train(trainer).history


def write_encoder_card(folder: Path, data: EncoderData, config: EncoderConfig, seed: int, source: str) -> None:
    """Write the card of a fine-tuned encoder beside it."""
    names = [p.name for p in data.catalogue.properties]
    training = [a for a in data.assignments if a.part == Part.TRAIN]
    own = {key for name in config.backbone for key in BACKBONES[name].settings}
    unused = {"weights", "standardize", "embed_batch_size"} | {k for b in BACKBONES.values() for k in b.settings} - own
    write_card(
        folder,
        f"Tactile encoder with property heads, recipe {config.recipe}",
        bases={name: BACKBONES[name].place(config) for name in config.backbone},
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
        ),
    )


def accuracies(
    logits: npt.NDArray[np.floating],
    labels: npt.NDArray[np.integer],
    decide: Callable[[torch.Tensor], torch.Tensor],
    catalogue: Catalogue,
) -> dict[str, float]:
    """Validation accuracy a property, and combined: all properties of a video right.

    Logits are videos x (classes of all properties, side by side), labels videos x properties; `decide` is a
    classifier's decision about logits.
    """
    right = decide(torch.from_numpy(logits)).numpy() == labels
    single = {f"validation_{p.name}": float(r.mean()) for p, r in zip(catalogue.properties, right.T, strict=True)}
    return {**single, COMBINED: float(right.all(1).mean())}
