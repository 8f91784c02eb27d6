"""Base classes of frame encoders and property classifiers; backbones and recipes have modules of their own."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import cast

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.weights.backbones import BACKBONES


class FrameEncoder(nn.Module):
    """Embeds single frames."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = dim
        """Length of an embedding."""

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """Embed frames as the language model is given them: float32, batch x dim.

        Frames are uint8, batch x side x side x RGB, their indices int64, batch: each frame's number in its video.
        """
        raise NotImplementedError

    def describe(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """Features of each frame for the classifier: those of `forward`, unless a recipe says otherwise."""
        described: torch.Tensor = self(frames, frame_indices)
        return described

    def trunk(self, frames: torch.Tensor) -> torch.Tensor:
        """Output of the frozen layers, those below all that fine-tuning changes: batch x anything.

        It is computed once for each picture and reused in every epoch. By default there are no such layers.
        """
        return frames

    def stage(self, entering: torch.Tensor) -> torch.Tensor:
        """The embedding, batch x dim, from what `trunk` gave."""
        embedded: torch.Tensor = self(entering, torch.zeros(len(entering), dtype=torch.int64, device=entering.device))
        return embedded


class SideBySide(FrameEncoder):
    """Several backbones as one encoder: their features one after the other."""

    def __init__(self, backbones: Sequence[FrameEncoder]) -> None:
        super().__init__(dim=sum(backbone.dim for backbone in backbones))
        self.backbones = nn.ModuleList(backbones)
        self.eval()

    def train(self, mode: bool = True) -> SideBySide:
        """Stays in evaluation mode, so that batch normalisation keeps its statistics and nothing is dropped."""
        super().train(False)
        return self

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """Features of all backbones: batch x dim, of frames, uint8, batch x side x side x RGB."""
        return torch.cat([backbone(frames, frame_indices) for backbone in self.backbones], dim=1)

    def trunks(self, frames: torch.Tensor) -> list[torch.Tensor]:
        """What each backbone's `trunk` makes of frames."""
        return [cast(FrameEncoder, backbone).trunk(frames) for backbone in self.backbones]

    def stages(self, entering: Sequence[torch.Tensor]) -> torch.Tensor:
        """Features of all backbones, batch x dim, from what `trunks` gave."""
        pairs = zip(self.backbones, entering, strict=True)
        return torch.cat([cast(FrameEncoder, backbone).stage(given) for backbone, given in pairs], dim=1)


class Heads(nn.ModuleList):
    """One linear layer a property on a video's mean features: the paper's three classification heads."""

    def __init__(self, dim: int, classes: Sequence[int]) -> None:
        super().__init__(nn.Linear(dim, count) for count in classes)

    def forward(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Logits a property, batch x classes, of features, batch x dim."""
        return [head(features) for head in self]


class PropertyClassifier(nn.Module):
    """ViFi-CLIP's mean over frames (Rasheed et al. 2023), then the properties' heads."""

    accepts_loss_kwargs = True  # has Trainer count an update's labels and give them to `forward`

    def __init__(self, encoder: FrameEncoder, heads: nn.Module, classes: Sequence[int]) -> None:
        super().__init__()
        self.encoder = encoder
        self.heads = heads
        self.classes = tuple(classes)

    def forward(
        self,
        frames: torch.Tensor | None = None,
        frame_indices: torch.Tensor | None = None,
        labels: torch.Tensor | None = None,
        num_items_in_batch: torch.Tensor | int | None = None,
        outputs: Sequence[torch.Tensor] | None = None,
    ) -> dict[str, torch.Tensor]:
        """Classify videos: `logits`, batch x (classes of all properties, side by side), and with labels `loss`.

        The loss is the sum of the properties' cross-entropies, so that the heads are trained simultaneously.

        Args:
            frames: uint8, batch x frames x side x side x RGB.
            frame_indices: int64, batch x frames: each frame's number in its video.
            labels: int64, batch x properties.
            num_items_in_batch: Labels of the whole update, so that accumulated batches weigh each video alike; by
                default those of this batch.
            outputs: In place of frames, the output of each backbone's `trunk`: batch x frames x (input of its `stage`).
        """
        if outputs is not None:
            entering, shape = [output.flatten(0, 1) for output in outputs], outputs[0].shape
            features = cast(SideBySide, self.encoder).stages(entering)
        else:
            assert frames is not None
            assert frame_indices is not None
            shape, features = frames.shape, self.encoder.describe(frames.flatten(0, 1), frame_indices.flatten())
        logits = self.classify(features.view(*shape[:2], -1))
        output = {"logits": torch.cat(logits, dim=1)}
        if labels is not None:
            losses = [F.cross_entropy(z, y, reduction="sum") for z, y in zip(logits, labels.unbind(1), strict=True)]
            videos = len(labels) if num_items_in_batch is None else num_items_in_batch / len(losses)
            output = {"loss": torch.stack(losses).sum() / videos, **output}
        return output

    def classify(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Logits a property, batch x classes, of the frames' features, batch x frames x dim."""
        logits: list[torch.Tensor] = self.heads(features.mean(1))
        return logits

    def decide(self, logits: torch.Tensor) -> torch.Tensor:
        """The class of each property: int64, batch x properties, of `forward`'s logits."""
        return torch.stack([z.argmax(1) for z in logits.split(self.classes, dim=1)], dim=1)


def mean_and_deviation(maps: torch.Tensor) -> torch.Tensor:
    """Mean and standard deviation of each channel: batch x 2 channels, of maps, batch x channels x places.

    Computed in float32 at least. A channel that is the same everywhere has deviation 0, with a gradient of 0.
    """
    values = maps if maps.dtype == torch.float64 else maps.float()
    mean = values.mean(2)
    variance = (values - mean[..., None]).square().mean(2)
    varies = variance > 0
    # The root's gradient at 0 is infinite, and 0 times infinity is NaN; so constant channels take the root of 1.
    known = torch.where(varies, variance, 1.0)
    # By its inverse: MKL's root, which torch takes, depends on the maker of the processor.
    deviation = known * known.rsqrt() * varies
    return torch.cat([mean, deviation], dim=1).to(maps.dtype)


def load_backbones(config: EncoderConfig, *, tuned: bool = False) -> list[FrameEncoder]:
    """The backbones of `encoder.backbone` with their pretrained weights; those that do not fit are a UserError.

    All is frozen but, with `tuned`, what fine-tuning changes: the last stage, or prompts.
    """
    return [import_module(BACKBONES[name].module).load_backbone(config, tuned=tuned) for name in config.backbone]
