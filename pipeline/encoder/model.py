"""Tactile encoders and property classifiers, and the paper's recipe: CLIP with visual prompts and three heads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, cast

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.encoder.clip import ImageFormat, VisualTower, load_visual_tower
from pipeline.encoder.vpt import VisualPrompts


class FrameEncoder(nn.Module):
    """Embeds single frames.

    Args:
        dim: Length of an embedding.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = dim

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """Embed frames as the language model is given them.

        Args:
            frames: uint8, batch x side x side x RGB.
            frame_indices: int64, batch: each frame's number in its video.

        Returns:
            float32, batch x dim.
        """
        raise NotImplementedError

    def describe(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """What the classifier is given of each frame: the same as `forward`, unless a recipe says otherwise."""
        described: torch.Tensor = self(frames, frame_indices)
        return described


class TactileEncoder(FrameEncoder):
    """CLIP's frozen visual tower, with visual prompts or (the base encoder) without, read as CLIP reads it.

    Args:
        tower: The tower; it takes frames of its own side or larger ones, which are averaged over areas.
        prompts: Prompts for it, not yet attached.
    """

    def __init__(self, tower: VisualTower, prompts: VisualPrompts | None = None) -> None:
        super().__init__(tower.dim)
        self.visual = tower.module
        self.image: ImageFormat = tower.image
        self.mean: torch.Tensor
        self.std: torch.Tensor
        self.register_buffer("mean", torch.tensor(tower.image.mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(tower.image.std).view(1, 3, 1, 1), persistent=False)
        self.prompts = prompts
        if prompts is not None:
            prompts.attach(self.visual)

    def train(self, mode: bool = True) -> TactileEncoder:
        """The backbone stays in evaluation mode: frozen means that it behaves the same in training."""
        super().train(mode)
        self.visual.eval()
        return self

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """CLIP's own embeddings: float32, batch x dim, of frames, uint8, batch x side x side x RGB."""
        return cast(torch.Tensor, self.visual(self.pixels(frames)))

    def pixels(self, frames: torch.Tensor) -> torch.Tensor:
        """Frames as the tower takes them: batch x 3 x side x side, normalised."""
        pixels = frames.permute(0, 3, 1, 2).to(self.mean.dtype) / 255
        if pixels.shape[-1] != self.image.size:
            pixels = F.interpolate(pixels, self.image.size, mode="area")
        return (pixels - self.mean) / self.std


class Heads(nn.ModuleList):
    """One linear layer a property on a video's mean features: the paper's three classification heads."""

    def __init__(self, dim: int, classes: Sequence[int]) -> None:
        super().__init__(nn.Linear(dim, count) for count in classes)

    def forward(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Logits a property, batch x classes, of features, batch x dim."""
        return [head(features) for head in self]


class PropertyClassifier(nn.Module):
    """ViFi-CLIP's mean over frames (Rasheed et al. 2023), then the properties' heads."""

    _keys_to_ignore_on_save = None  # read by transformers' Trainer when it reloads a checkpoint
    cosine_per_epoch: ClassVar[bool] = False
    """Whether the learning rate falls and rises again by a cosine as long as one epoch, or falls once in all."""

    def __init__(self, encoder: FrameEncoder, heads: nn.Module, classes: Sequence[int]) -> None:
        super().__init__()
        self.encoder = encoder
        self.heads = heads
        self.classes = tuple(classes)

    def forward(
        self, frames: torch.Tensor, frame_indices: torch.Tensor, labels: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Classify videos.

        Args:
            frames: uint8, batch x frames x side x side x RGB.
            frame_indices: int64, batch x frames: each frame's number in its video.
            labels: int64, batch x properties.

        Returns:
            `logits`, batch x (classes of all properties, side by side), and with labels `loss`: the sum of the
            properties' cross-entropies, so that the heads are trained simultaneously.
        """
        features = self.encoder.describe(frames.flatten(0, 1), frame_indices.flatten())
        logits = self.classify(features.view(*frames.shape[:2], -1))
        output = {"logits": torch.cat(logits, dim=1)}
        if labels is not None:
            losses = [F.cross_entropy(z, y) for z, y in zip(logits, labels.unbind(1), strict=True)]
            output = {"loss": torch.stack(losses).sum(), **output}
        return output

    def classify(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Logits a property, batch x classes, of the frames' features, batch x frames x dim."""
        logits: list[torch.Tensor] = self.heads(features.mean(1))
        return logits

    def decide(self, logits: torch.Tensor) -> torch.Tensor:
        """The class of each property: int64, batch x properties, of `forward`'s logits."""
        return torch.stack([z.argmax(1) for z in logits.split(self.classes, dim=1)], dim=1)


def base_encoder(config: EncoderConfig) -> TactileEncoder:
    """CLIP as it comes."""
    return TactileEncoder(load_visual_tower(Path(config.weights), config.embedding))


def property_classifier(config: EncoderConfig, classes: Sequence[int]) -> PropertyClassifier:
    """CLIP with visual prompts that pass one shared linear map, and one linear head a property."""
    tower = load_visual_tower(Path(config.weights), config.embedding)
    encoder = TactileEncoder(tower, visual_prompts(config, tower, shared=True))
    return PropertyClassifier(encoder, Heads(encoder.dim, classes), classes)


def visual_prompts(config: EncoderConfig, tower: VisualTower, *, shared: bool) -> VisualPrompts:
    """Fresh prompts that fit the tower, at as many of its layers as `encoder.prompt_layers` says (0: all)."""
    layers = min(tower.layers, config.prompt_layers or tower.layers)
    return VisualPrompts(layers, config.prompts, tower.width, tower.patch_area, shared=shared)
