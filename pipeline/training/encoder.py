"""Fine-tuning of the encoder: visual prompts and property heads on a frozen CLIP (the paper's section III-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch.nn import functional as F
from torch.utils.data import DataLoader
from transformers import EvalPrediction, TrainingArguments

from pipeline.data.clips import ClipDataset, LabelledVideo, collate_clips
from pipeline.frames.store import FrameStore
from pipeline.models.tactile_encoder import PropertyClassifier, property_classifier
from pipeline.physiclear.catalogue import Catalogue
from pipeline.records import Assignment, Classification, Measurement, Part
from pipeline.runtime import seed_everything
from pipeline.sections import EncoderConfig, RuntimeConfig
from pipeline.training.trainer import (
    Log,
    TrainableTrainer,
    Watch,
    checkpoint_dir,
    fingerprint,
    one_device,
    progress_bar_off,
    train,
)


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
    log: Log | None = None,
) -> tuple[PropertyClassifier, list[Measurement]]:
    """Train prompts and heads; the epoch of best combined validation accuracy is kept (ties: the first).

    Without validation videos there is nothing to choose by, and the last epoch is kept.

    Args:
        inputs: Files that the training depends on, for the checkpoints' fingerprint.
    """
    seed_everything(seed)
    model = property_classifier(Path(config.weights), config.prompts, data.classes)
    train_set = ClipDataset(
        data.store,
        data.videos(Part.TRAIN),
        per_video=data.per_video,
        seed=seed,
        flip_probability=config.flip_probability,
    )
    validation = data.videos(Part.VALIDATION)
    arguments = TrainingArguments(
        output_dir=str(checkpoint_dir(f"finetune_encoder-{seed}", fingerprint(config, seed, data.per_video, *inputs))),
        num_train_epochs=config.epochs,
        per_device_train_batch_size=config.batch_size,
        per_device_eval_batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        lr_scheduler_type="cosine",
        optim="adamw_torch",
        eval_strategy="epoch" if validation else "no",
        save_strategy="epoch",
        save_total_limit=2,
        load_best_model_at_end=bool(validation),
        metric_for_best_model="validation_combined" if validation else None,
        logging_strategy="epoch",
        logging_nan_inf_filter=False,
        label_names=["labels"],
        remove_unused_columns=False,
        dataloader_pin_memory=False,
        report_to="none",
        disable_tqdm=progress_bar_off(),
        seed=seed,
        use_cpu=runtime.device == "cpu",
    )
    trainer = TrainableTrainer(
        model=model,
        args=one_device(arguments),
        train_dataset=train_set,
        eval_dataset=ClipDataset(data.store, validation, per_video=data.per_video) if validation else None,
        data_collator=collate_clips,
        compute_metrics=lambda prediction: accuracies(prediction, data.catalogue),
        callbacks=[Watch(log)],
    )
    return model, train(trainer).history


def accuracies(prediction: EvalPrediction, catalogue: Catalogue) -> dict[str, float]:
    """Validation accuracy a property, and combined: all properties of a video right."""
    logits, labels = cast(np.ndarray, prediction.predictions), cast(np.ndarray, prediction.label_ids)
    borders = np.cumsum([len(p.levels) for p in catalogue.properties])[:-1]
    guesses = np.stack([z.argmax(1) for z in np.split(logits, borders, axis=1)], axis=1)
    right = guesses == labels
    single = {f"validation_{p.name}": float(r.mean()) for p, r in zip(catalogue.properties, right.T, strict=True)}
    return {**single, "validation_combined": float(right.all(1).mean())}


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
            model(batch["frames"].to(device))["logits"].cpu()
            for batch in DataLoader(clips, batch_size=batch_size, collate_fn=collate_clips)
        ]
        if not outputs:
            continue
        for index, property_ in enumerate(data.catalogue.properties):
            logits = torch.cat(outputs).split(data.classes, dim=1)[index]
            for video, row in zip(videos, F.softmax(logits.double(), dim=1), strict=True):
                records.append(
                    Classification(
                        video_id=video.video_id,
                        object_id=objects[video.video_id],
                        part=part,
                        property=property_.name,
                        expected=video.labels[index],
                        predicted=int(row.argmax()),
                        probabilities=tuple(row.tolist()),
                    )
                )
    return records
