"""Pretraining of the strong recipe's encoder: telling of pictures of invented objects what is known of them."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from transformers import TrainerCallback

from pipeline.config import FramesConfig, PretrainConfig, RuntimeConfig
from pipeline.encoder import synthetic as lessons_module
from pipeline.encoder.scene_encoder import LessonModel, SceneEncoder
from pipeline.encoder.synthetic import Lessons, draw_lessons
from pipeline.records import Measurement
from pipeline.runtime import CHECKPOINTS, derive_seed, seed_everything
from pipeline.sampling import EpochDataset
from pipeline.scenes import invent
from pipeline.training import (
    TrainableTrainer,
    TrainingMonitor,
    checkpoint_dir,
    fingerprint,
    train,
    training_arguments,
)
from pipeline.videos.frames import subtraction
from pipeline.videos.frames.subtraction import MIDDLE

WARMUP = 0.04
"""Share of the updates."""
HELD_OUT = 0.04
"""Share of the lessons that the loss is told on at the end."""
REPORTS = 24
"""Points of the curve."""
STRENGTH = (0.7, 1.4)
"""How much weaker or stronger the light of a picture may be."""


class LessonDataset(EpochDataset[dict[str, torch.Tensor]]):
    """Lessons as `LessonModel` takes them; what is done to pictures depends on seed, epoch and lesson alone."""

    def __init__(self, lessons: Lessons, *, augment: bool, seed: int) -> None:
        super().__init__()
        self.lessons = lessons
        self.augment = augment
        self.seed = seed

    def __len__(self) -> int:
        return len(self.lessons.pictures)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        pictures = self.lessons.pictures[index]
        if self.augment:
            rng = np.random.default_rng(derive_seed(self.seed, self.epoch, index))
            pictures = vary(pictures, rng)
        return {
            "frames": torch.from_numpy(np.ascontiguousarray(pictures)),
            "quantities": torch.from_numpy(self.lessons.quantities[index]),
            "kinds": torch.from_numpy(self.lessons.kinds[index].astype(np.float32)),
        }


def vary(pictures: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Mirror a lesson's pictures, all alike, and vary the light of each: uint8, presses x side x side x RGB."""
    axes = tuple(axis for axis in (1, 2) if rng.random() < 0.5)
    low, high = map(math.log, STRENGTH)
    strength = np.exp(rng.uniform(low, high, (len(pictures), 1, 1, 1))).astype(np.float32)
    varied = MIDDLE + strength * (np.flip(pictures, axes).astype(np.float32) - MIDDLE)
    shown: npt.NDArray[np.uint8] = np.clip(np.rint(varied), 0, 255).astype(np.uint8)
    return shown


def pretrain(
    config: PretrainConfig, frames: FramesConfig, runtime: RuntimeConfig, callbacks: Sequence[TrainerCallback] = ()
) -> tuple[SceneEncoder, list[Measurement]]:
    """Draw the lessons and train the encoder on them; a killed run goes on where it was.

    Returns:
        The encoder, and the curve of its loss; `held_out_*` at the last step are over lessons that it never saw.
    """
    seed_everything(config.seed)
    drawing = [
        *sorted(Path(invent.__file__).parent.rglob("*.py")),
        Path(lessons_module.__file__),
        Path(subtraction.__file__),
    ]
    mark = fingerprint(config, frames.fit, frames.size, *drawing)
    work = CHECKPOINTS / "lessons" / mark
    lessons = draw_lessons(config, frames, work)
    border = len(lessons.pictures) - max(1, round(HELD_OUT * len(lessons.pictures)))
    taught, held = (
        Lessons(**{name: rows[part] for name, rows in vars(lessons).items()})
        for part in (slice(border), slice(border, None))
    )
    model = lesson_model(SceneEncoder(), taught)
    arguments = training_arguments(
        checkpoint_dir("pretrain", mark),
        runtime,
        config.seed,
        max_steps=config.steps,
        per_device_train_batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        warmup_steps=round(WARMUP * config.steps),
        logging_steps=max(1, config.steps // REPORTS),
        label_names=["kinds"],
    )
    trainer = TrainableTrainer(
        model=model,
        args=arguments,
        train_dataset=LessonDataset(taught, augment=config.augment, seed=config.seed),
        callbacks=[TrainingMonitor(), *callbacks],
    )
    history = train(trainer).history
    told = held_out(model.cpu(), LessonDataset(held, augment=False, seed=0))
    shutil.rmtree(work, ignore_errors=True)
    return model.encoder, [*history, *(Measurement(step=config.steps, name=n, value=v) for n, v in told.items())]


def lesson_model(encoder: SceneEncoder, lessons: Lessons) -> LessonModel:
    """The encoder with a head scaled to these lessons."""
    flat = lessons.quantities.reshape(-1, lessons.quantities.shape[2])
    scale = torch.from_numpy(np.stack([flat.mean(axis=0), flat.std(axis=0) + 1e-6]))
    return LessonModel(encoder, scale, lessons.kinds.shape[1])


@torch.inference_mode()
def held_out(model: LessonModel, lessons: LessonDataset) -> dict[str, float]:
    """Parts of the loss over lessons, each a mean."""
    model.eval()
    parts = []
    for i in range(len(lessons)):
        item = {name: value[None] for name, value in lessons[i].items()}
        parts.append({name: float(value) for name, value in model(**item).items()})
    return {f"held_out_{name}": float(np.mean([p[name] for p in parts])) for name in parts[0]}
