"""Pretraining of the strong recipe's encoder: telling of pictures of invented objects what is known of them."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from pipeline.data import lessons as lessons_module
from pipeline.data.epochs import EpochDataset
from pipeline.data.lessons import Lessons, draw_lessons
from pipeline.frames import subtraction
from pipeline.frames.subtraction import MIDDLE
from pipeline.models.scene_encoder import LessonModel, SceneEncoder
from pipeline.records import Measurement
from pipeline.runtime import CHECKPOINTS, derive_seed, seed_everything
from pipeline.scenes import invent
from pipeline.sections import FramesConfig, PretrainConfig, RuntimeConfig
from pipeline.training.trainer import (
    Log,
    TrainableTrainer,
    Watch,
    checkpoint_dir,
    fingerprint,
    train,
    training_arguments,
)

WARMUP = 0.04
"""Share of the updates."""
HELD_OUT = 0.04
"""Share of the lessons that the loss is told on at the end."""
REPORTS = 24
"""Points of the curve."""


@dataclass(frozen=True)
class Disturbance:
    """How far the light of a picture may be off: what differs between sensors more than the drawn ones show."""

    strength: float = 0.5
    """Largest logarithm of the factor on all channels."""
    tint: float = 0.16
    """The same for each channel alone."""
    shift: float = 1.2
    """Deviation of a shift of each channel, in steps of the difference picture."""
    noise: float = 3.6
    """Largest deviation of noise, in the same steps."""


class LessonDataset(EpochDataset[dict[str, torch.Tensor]]):
    """Lessons as `LessonModel` takes them; what is done to pictures depends on seed, epoch and lesson alone."""

    def __init__(self, lessons: Lessons, *, augment: Disturbance | None, seed: int) -> None:
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
            pictures = disturb(pictures, self.augment, rng)
        return {
            "frames": torch.from_numpy(np.ascontiguousarray(pictures)),
            "quantities": torch.from_numpy(self.lessons.quantities[index]),
            "kinds": torch.from_numpy(self.lessons.kinds[index].astype(np.float32)),
            "classes": torch.from_numpy(self.lessons.classes[index]),
        }


def disturb(pictures: npt.NDArray[np.uint8], amount: Disturbance, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Mirror a lesson's pictures, all alike, and vary the light of each: uint8, presses x side x side x RGB."""
    axes = tuple(axis for axis in (1, 2) if rng.random() < 0.5)
    pictures = np.flip(pictures, axes) if axes else pictures
    presses = len(pictures)
    gain = rng.uniform(-amount.strength, amount.strength, (presses, 1, 1, 1))
    gain = np.exp(gain + rng.uniform(-amount.tint, amount.tint, (presses, 1, 1, 3))).astype(np.float32)
    offset = MIDDLE * (1 - gain) + rng.normal(0, amount.shift, (presses, 1, 1, 3)).astype(np.float32)
    deviation = rng.uniform(0, amount.noise, (presses, 1, 1, 1)).astype(np.float32)
    changed = rng.standard_normal(pictures.shape, dtype=np.float32)
    changed *= deviation
    changed += pictures * gain
    changed += offset
    return np.clip(np.rint(changed, out=changed), 0, 255).astype(np.uint8)


def pretrain(
    config: PretrainConfig, frames: FramesConfig, runtime: RuntimeConfig, log: Log | None = None
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
        label_names=["classes"],
    )
    trainer = TrainableTrainer(
        model=model,
        args=arguments,
        train_dataset=LessonDataset(taught, augment=Disturbance() if config.augment else None, seed=config.seed),
        callbacks=[Watch(log)],
    )
    history = train(trainer).history
    told = held_out(model.cpu(), LessonDataset(held, augment=None, seed=0))
    shutil.rmtree(work, ignore_errors=True)
    return model.encoder, [*history, *(Measurement(step=config.steps, name=n, value=v) for n, v in told.items())]


def lesson_model(encoder: SceneEncoder, lessons: Lessons) -> LessonModel:
    """The encoder with heads scaled to these lessons."""
    flat = lessons.quantities.reshape(-1, lessons.quantities.shape[2])
    scale = torch.from_numpy(np.stack([flat.mean(axis=0), flat.std(axis=0) + 1e-6]))
    shares = [torch.from_numpy(np.bincount(column, minlength=3) / len(column)) for column in lessons.classes.T]
    return LessonModel(encoder, scale, lessons.kinds.shape[1], shares)


@torch.inference_mode()
def held_out(model: LessonModel, lessons: LessonDataset) -> dict[str, float]:
    """Parts of the loss over lessons, each a mean."""
    model.eval()
    parts = []
    for i in range(len(lessons)):
        item = {name: value[None] for name, value in lessons[i].items()}
        parts.append({name: float(value) for name, value in model(**item).items()})
    return {f"held_out_{name}": float(np.mean([p[name] for p in parts])) for name in parts[0]}
