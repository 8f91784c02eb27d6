"""The recipe `tuned`: a frame classifier on frozen backbones, then their last stages, or prompts, tuned with it.

First a linear probe is fitted (`frame_classifier`), then the probe and what the backbones unfreeze are trained by
gradients at a small rate: with a fitted head fine-tuning distorts the features less (LP-FT, Kumar et al. 2022, arXiv
2202.10054). The epoch with the best combined validation accuracy is kept. The probe is epoch 0, and wins where it is as
good, so that tuning is only taken where it helped.

All that lies below is frozen, and so is what it makes of a picture: it is computed once for each picture and flip.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from pipeline.config import EncoderConfig
from pipeline.core.runtime import derive_seed, track
from pipeline.encoder.clips import ClipDataset, EncoderData, LabelledVideo, check_finite
from pipeline.encoder.frame_classifier import Clips, JointFrameClassifier
from pipeline.encoder.model import SideBySide, load_backbones
from pipeline.training.sampling import EpochDataset

FLIPS: tuple[tuple[int, ...], ...] = ((), (2,), (1,), (1, 2))
"""Axes of frames x height x width that are mirrored; the first leaves a picture as it is."""
MEMORY = 2**30
"""Bytes of trunks' outputs up to which they are kept as they are; above, in float16."""


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
    outputs: list[list[torch.Tensor]]
    """Of each flip and backbone: videos x frames x what the backbone's stage takes."""

    def of(self, video_id: str, flip: int = 0) -> list[torch.Tensor]:
        """Of each backbone: frames x what its stage takes."""
        return [output[self.rows[video_id]] for output in self.outputs[flip]]


@torch.no_grad()
def run_trunks(
    encoder: SideBySide,
    data: EncoderData,
    videos: Sequence[LabelledVideo],
    device: torch.device,
    *,
    flips: int = len(FLIPS),
) -> Trunks:
    """Run the trunks over the evaluation clips of these videos, under the first so many of `FLIPS`."""
    encoder = encoder.to(device)
    clips = ClipDataset(data.store, videos, per_video=data.per_video)
    outputs: list[list[torch.Tensor]] = [[] for _ in range(flips)]
    for place in track(range(len(videos)), "frozen part of the encoder", "video"):
        frames = clips[place]["frames"].numpy()
        for flip, kept in enumerate(outputs):
            mirrored = torch.from_numpy(np.flip(frames, FLIPS[flip]).copy())
            found = [output.cpu() for output in encoder.trunks(mirrored.to(device))]
            if not kept:
                size = len(videos) * flips * sum(output.nbytes for output in found)
                short = [output.is_floating_point() and size > MEMORY for output in found]
                kept += [
                    torch.empty(len(videos), *output.shape, dtype=torch.float16 if half else output.dtype)
                    for output, half in zip(found, short, strict=True)
                ]
            for output, whole in zip(found, kept, strict=True):
                whole[place] = output
    return Trunks({video.video_id: row for row, video in enumerate(videos)}, outputs)


class AboveTrunks(nn.Module):
    """The trained part of the classifier: all that follows the frozen trunks, whose outputs are computed once."""

    _keys_to_ignore_on_save = None  # read by transformers' Trainer when it reloads a checkpoint
    accepts_loss_kwargs = True

    def __init__(self, classifier: JointFrameClassifier) -> None:
        super().__init__()
        self.classifier = classifier

    def forward(
        self,
        outputs: Sequence[torch.Tensor],
        labels: torch.Tensor | None = None,
        num_items_in_batch: torch.Tensor | int | None = None,
    ) -> dict[str, torch.Tensor]:
        """As `PropertyClassifier.forward`, of the trunks' outputs: each batch x frames x what its stage takes."""
        return self.classifier.from_features(self.features(outputs), labels, num_items_in_batch)

    def features(self, outputs: Sequence[torch.Tensor]) -> torch.Tensor:
        """The frames' features: batch x frames x dim."""
        encoder = self.classifier.encoder
        assert isinstance(encoder, SideBySide)
        given = [output.flatten(0, 1) for output in outputs]
        given = [output.float() if output.dtype == torch.float16 else output for output in given]
        return encoder.stages(given).view(*outputs[0].shape[:2], -1)

    @torch.inference_mode()
    def describe(self, trunks: Trunks, videos: Sequence[LabelledVideo], device: torch.device) -> Clips:
        """Features of the videos' evaluation clips: float32, videos x frames x dim."""
        self.to(device)
        rows = [self.features([o[None].to(device) for o in trunks.of(video.video_id)]) for video in videos]
        found = torch.cat(rows).float().cpu()
        check_finite(found.flatten(1), videos)
        return found.numpy()

    @torch.inference_mode()
    def logits(self, trunks: Trunks, videos: Sequence[LabelledVideo], device: torch.device) -> torch.Tensor:
        """As `forward` gives them, of the videos' evaluation clips."""
        features = torch.from_numpy(self.describe(trunks, videos, device)).to(device)
        return self.classifier.from_features(features)["logits"].cpu()


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
        video, flip = self.videos[index], 0
        if self.seed is not None:
            rng = random.Random(derive_seed(self.seed, self.epoch, video.video_id))
            across, down = (rng.random() < self.flip_probability for _ in range(2))
            flip = across + 2 * down
        return {
            "outputs": self.trunks.of(video.video_id, flip),
            "labels": torch.tensor(video.labels, dtype=torch.int64),
        }
