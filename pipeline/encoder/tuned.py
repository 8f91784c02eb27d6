"""The recipe `tuned`: a frame classifier on frozen backbones, then their last stages, or prompts, tuned with it.

First a linear probe is fitted (`frame_classifier`), then the probe and what the backbones unfreeze are trained by
gradients at a small rate: with a fitted head fine-tuning distorts the features less (LP-FT, Kumar et al. 2022, arXiv
2202.10054). The layers below are frozen, so their output is computed only once for each picture and flip.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pipeline.config import EncoderConfig
from pipeline.core.records import Flip
from pipeline.core.runtime import derive_seed
from pipeline.encoder.data import AXES, ClipDataset, EncoderData, LabelledVideo, draw_flip
from pipeline.encoder.frame_classifier import JointFrameClassifier
from pipeline.encoder.model import SideBySide, load_backbones
from pipeline.running.progress import track
from pipeline.training.sampling import EpochDataset

MEMORY = 2**30
"""Trunks' outputs of more bytes than this are kept in float16."""


def base_encoder(config: EncoderConfig) -> SideBySide:
    """The backbones as they come."""
    return SideBySide(load_backbones(config))


def property_classifier(config: EncoderConfig, classes: Sequence[int]) -> JointFrameClassifier:
    """The backbones, with what is tuned unfrozen, and a linear layer a property on their standardised features."""
    return JointFrameClassifier(SideBySide(load_backbones(config, tuned=True)), classes)


class Trunks(dict[tuple[str, Flip], list[torch.Tensor]]):
    """Outputs of the frozen trunks for each video's evaluation clip under each flip: frames x (input of the stage)."""

    def of(self, video_id: str, flip: Flip = "none") -> list[torch.Tensor]:
        """The outputs for one clip, in float32."""
        return [output.float() if output.dtype == torch.float16 else output for output in self[video_id, flip]]


@torch.no_grad()
def run_trunks(
    encoder: SideBySide, data: EncoderData, videos: Sequence[LabelledVideo], device: torch.device, *, mirrored: bool
) -> Trunks:
    """Run the trunks over the evaluation clips of these videos, as they are or also mirrored in all ways."""
    encoder, found = encoder.to(device), Trunks()
    clips = ClipDataset(data.store, videos, per_video=data.per_video)
    flips = [flip for flip in AXES if mirrored or flip == "none"]
    for place in track(range(len(videos)), "frozen part of the encoder", "video"):
        frames = clips[place]["frames"].numpy()
        for flip in flips:
            shown = torch.from_numpy(np.flip(frames, AXES[flip]).copy())
            outputs = [output.cpu().contiguous() for output in encoder.trunks(shown.to(device))]
            if len(videos) * len(flips) * sum(output.nbytes for output in outputs) > MEMORY:
                outputs = [output.half() if output.is_floating_point() else output for output in outputs]
            found[videos[place].video_id, flip] = outputs
    return found


@dataclass
class TrunkDataset(EpochDataset[dict[str, Any]]):
    """Items: `outputs`, of each backbone's trunk, frames x what its stage takes; `labels`, int64.

    Flips depend on seed, epoch and video alone. Without a seed there are none.
    """

    trunks: Trunks
    videos: Sequence[LabelledVideo]
    seed: int | None = None
    flip_probability: float = 0.0

    def __len__(self) -> int:
        return len(self.videos)

    def __getitem__(self, index: int) -> dict[str, Any]:
        video = self.videos[index]
        flip: Flip = "none"
        if self.seed is not None:
            rng = random.Random(derive_seed(self.seed, self.epoch, video.video_id))
            flip = draw_flip(rng, self.flip_probability)
        return {"outputs": self.trunks.of(video.video_id, flip), "labels": torch.tensor(video.labels)}
