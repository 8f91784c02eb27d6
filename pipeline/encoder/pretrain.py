"""Synthetic pretraining of the backbone `scenes`: predicting what is known of invented objects from pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional as F
from transformers import TrainerCallback

from pipeline.config import FramesConfig, PretrainConfig, RuntimeConfig
from pipeline.core.records import MIDDLE, Measurement
from pipeline.core.runtime import derive_seed, seed_everything
from pipeline.encoder.scene_encoder import SIDE, SceneEncoder
from pipeline.encoder.synthetic import SyntheticPictures, draw_pictures
from pipeline.training.sampling import EpochDataset
from pipeline.training.trainer import TrainableTrainer, checkpoint_dir, train, training_arguments

WEIGHTS = {"quantities": 2.0, "kinds": 0.6}
"""Weights of the two parts of the loss."""
STRENGTH = (0.7, 1.4)
"""How much weaker or stronger the light of a picture may be."""


class PretrainingModel(nn.Module):
    """The encoder with a head that predicts, from single pictures, what is known of invented objects.

    Quantities are standardised by their mean and deviation over what it is trained on, `drawn`.
    """

    def __init__(self, encoder: SceneEncoder, drawn: SyntheticPictures) -> None:
        super().__init__()
        self.encoder = encoder
        quantities = drawn.quantities.reshape(-1, drawn.quantities.shape[2])
        self.scale = torch.from_numpy(np.stack([quantities.mean(axis=0), quantities.std(axis=0) + 1e-6]))
        outputs = quantities.shape[1] + drawn.kinds.shape[1]
        self.head = nn.Sequential(nn.Dropout(0.1), nn.Linear(encoder.dim, 192), nn.ReLU(), nn.Linear(192, outputs))

    def forward(self, frames: torch.Tensor, quantities: torch.Tensor, kinds: torch.Tensor) -> dict[str, torch.Tensor]:
        """The `loss` on some objects, and its parts: Huber's of standardised quantities, and cross-entropy of kinds.

        Args:
            frames: uint8, objects x presses x side x side x RGB.
            quantities: float32, objects x presses x quantities.
            kinds: float32, objects x kinds.
        """
        objects, presses = frames.shape[:2]
        features = self.encoder(frames.flatten(0, 1), torch.zeros(objects * presses, dtype=torch.int64))
        numbers, flags = self.head(features).split([quantities.shape[2], kinds.shape[1]], dim=1)
        mean, deviation = self.scale.to(quantities)
        wanted = ((quantities - mean) / deviation).flatten(0, 1)
        parts = {
            "quantities": F.smooth_l1_loss(numbers, wanted),
            "kinds": F.binary_cross_entropy_with_logits(flags, kinds.repeat_interleave(presses, dim=0)),
        }
        return {"loss": cast(torch.Tensor, sum(WEIGHTS[name] * part for name, part in parts.items())), **parts}


@dataclass
class PretrainingDataset(EpochDataset[dict[str, torch.Tensor]]):
    """Pictures as `PretrainingModel` takes them; what is done to them depends on seed, epoch and object alone."""

    drawn: SyntheticPictures
    augment: bool
    seed: int

    def __len__(self) -> int:
        return len(self.drawn.pictures)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        pictures = self.drawn.pictures[index]
        if self.augment:
            pictures = vary(pictures, np.random.default_rng(derive_seed(self.seed, self.epoch, index)))
        return {
            "frames": torch.from_numpy(np.ascontiguousarray(pictures)),
            "quantities": torch.from_numpy(self.drawn.quantities[index]),
            "kinds": torch.from_numpy(self.drawn.kinds[index].astype(np.float32)),
        }


def vary(pictures: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Mirror an object's pictures, all alike, and vary the light of each: uint8, presses x side x side x RGB."""
    axes = tuple(axis for axis in (1, 2) if rng.random() < 0.5)
    low, high = map(math.log, STRENGTH)
    strength = np.exp(rng.uniform(low, high, (len(pictures), 1, 1, 1))).astype(np.float32)
    varied = MIDDLE + strength * (np.flip(pictures, axes).astype(np.float32) - MIDDLE)
    shown: npt.NDArray[np.uint8] = np.clip(np.rint(varied), 0, 255).astype(np.uint8)
    return shown


def pretrain(
    config: PretrainConfig, frames: FramesConfig, runtime: RuntimeConfig, callbacks: Sequence[TrainerCallback] = ()
) -> tuple[SceneEncoder, list[Measurement]]:
    """Draw pictures and train the encoder on them, which is returned with its curve; a killed run goes on.

    The pictures are as large as the encoder will see frames: `frames.pixels`, but no larger than its own side.
    `held_out_*` at the last step of the curve are over objects that it never saw.
    """
    seed_everything(config.seed)
    frames = frames.model_copy(update={"pixels": min(frames.pixels, SIDE)})
    shown = repr((config.objects, config.seed))
    drawn = draw_pictures(config, frames, checkpoint_dir("pretrain", "pictures", shown, frames.fit, frames.pixels))
    # The loss is measured at the end on a share of the objects.
    border = len(drawn.pictures) - max(1, round(0.04 * len(drawn.pictures)))
    training, held = (SyntheticPictures._make(a[part] for a in drawn) for part in (slice(border), slice(border, None)))
    model = PretrainingModel(SceneEncoder(), training)
    arguments = training_arguments(
        checkpoint_dir("pretrain", config, frames.fit, frames.pixels),
        runtime,
        config.seed,
        config,
        max_steps=config.steps,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        warmup_steps=round(0.04 * config.steps),
        logging_steps=max(1, config.steps // 24),
        label_names=["kinds"],
    )
    trainer = TrainableTrainer(
        model=model,
        args=arguments,
        train_dataset=PretrainingDataset(training, augment=True, seed=config.seed),
        callbacks=callbacks,
    )
    history = train(trainer).history
    items = PretrainingDataset(held, augment=False, seed=0)
    model.cpu().eval()
    with torch.inference_mode():
        parts = [model(**{name: value[None] for name, value in items[i].items()}) for i in range(len(items))]
    measured = {f"held_out_{name}": float(np.mean([float(p[name]) for p in parts])) for name in parts[0]}
    return model.encoder, [*history, *(Measurement(step=config.steps, name=n, value=v) for n, v in measured.items())]
