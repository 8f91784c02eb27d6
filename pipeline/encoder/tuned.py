"""The recipe `tuned`: a frame classifier on frozen backbones, then their last stages, or prompts, tuned with it.

First a linear probe is fitted (`frame_classifier`), then the probe and what the backbones unfreeze are trained by
gradients at a small rate: with a fitted head fine-tuning distorts the features less (LP-FT, Kumar et al. 2022, arXiv
2202.10054). The epoch with the best combined validation accuracy is kept. The probe is epoch 0 and wins ties, so tuning
is used only where it helped.

The layers below are frozen, so their output is computed only once for each picture and flip.
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
from pipeline.core.runtime import derive_seed, track
from pipeline.encoder.clips import AXES, ClipDataset, EncoderData, LabelledVideo, draw_flip
from pipeline.encoder.frame_classifier import JointFrameClassifier
from pipeline.encoder.model import SideBySide, load_backbones
from pipeline.training.sampling import EpochDataset

MEMORY = 2**30
"""Trunks' outputs of more bytes than this are kept in float16."""


def base_encoder(config: EncoderConfig) -> SideBySide:
    """The backbones as they come."""
    return SideBySide(load_backbones(config))


def property_classifier(config: EncoderConfig, classes: Sequence[int]) -> JointFrameClassifier:
    """The backbones, with what is tuned unfrozen, and a linear layer a property on their standardised features."""
    return JointFrameClassifier(SideBySide(load_backbones(config, tuned=True)), classes)


@dataclass(frozen=True)
class Trunks:
    """What frozen trunks make of the frames of each video's evaluation clip, under each flip."""

    rows: dict[str, int]
    """Of each video."""
    outputs: dict[Flip, list[torch.Tensor]]
    """Of each backbone: videos x frames x what the backbone's stage takes."""

    def of(self, video_id: str, flip: Flip = "none") -> list[torch.Tensor]:
        """Of each backbone: frames x what its stage takes."""
        found = [output[self.rows[video_id]] for output in self.outputs[flip]]
        return [output.float() if output.dtype == torch.float16 else output for output in found]


@torch.no_grad()
def run_trunks(
    encoder: SideBySide, data: EncoderData, videos: Sequence[LabelledVideo], device: torch.device, *, mirrored: bool
) -> Trunks:
    """Run the trunks over the evaluation clips of these videos, as they are or also mirrored in all ways."""
    encoder = encoder.to(device)
    clips = ClipDataset(data.store, videos, per_video=data.per_video)
    outputs: dict[Flip, list[torch.Tensor]] = {flip: [] for flip in AXES if mirrored or flip == "none"}
    for place in track(range(len(videos)), "frozen part of the encoder", "video"):
        frames = clips[place]["frames"].numpy()
        for flip, kept in outputs.items():
            shown = torch.from_numpy(np.flip(frames, AXES[flip]).copy())
            found = [output.cpu() for output in encoder.trunks(shown.to(device))]
            if not kept:
                size = len(videos) * len(outputs) * sum(output.nbytes for output in found)
                for output in found:
                    dtype = torch.float16 if output.is_floating_point() and size > MEMORY else output.dtype
                    kept.append(torch.empty(len(videos), *output.shape, dtype=dtype))
            for output, whole in zip(found, kept, strict=True):
                whole[place] = output
    return Trunks({video.video_id: row for row, video in enumerate(videos)}, outputs)


class TrunkDataset(EpochDataset[dict[str, Any]]):
    """Items: `outputs`, of each backbone's trunk, frames x what its stage takes; `labels`, int64.

    Flips depend on seed, epoch and video alone. Without a seed there are none.
    """

    def __init__(
        self, trunks: Trunks, videos: Sequence[LabelledVideo], *, seed: int | None = None, flip_probability: float = 0.0
    ) -> None:
        super().__init__()
        self.trunks, self.videos = trunks, videos
        self.seed, self.flip_probability = seed, flip_probability

    def __len__(self) -> int:
        return len(self.videos)

    def __getitem__(self, index: int) -> dict[str, Any]:
        video = self.videos[index]
        flip: Flip = "none"
        if self.seed is not None:
            rng = random.Random(derive_seed(self.seed, self.epoch, video.video_id))
            flip = draw_flip(rng, self.flip_probability)
        return {"outputs": self.trunks.of(video.video_id, flip), "labels": torch.tensor(video.labels)}
