"""The encoder as the published code reads it (github.com/clear-nus/octopi), where that differs from the paper.

The language model is given the class token as the last transformer layer leaves it, the classifier the same token after
the tower's last normalisation; to both a sinusoid of the frame's number is added. The classifier scales a video's mean
to length 1 and puts a hidden layer, shared by the properties, before the heads. A tower that averages its patches has
no trained class token: there the average takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.encoder.clip import TactileEncoder, VisualPrompts, load_visual_tower
from pipeline.encoder.model import Heads, PropertyClassifier

if TYPE_CHECKING:
    from open_clip.transformer import VisionTransformer

DROPOUT = 0.5
SHORTEST_FEATURE = 1e-6
"""Below this length a video's mean stays as it is instead of being blown up to length 1; float16 still holds it."""


class PublishedEncoder(TactileEncoder):
    """The class token before the last normalisation and CLIP's projection; `dim` is the transformer's width."""

    def __init__(self, tower: VisionTransformer, prompts: VisualPrompts | None = None) -> None:
        super().__init__(tower, prompts)
        self.dim = tower.transformer.width
        self._token: torch.Tensor
        self.visual.get_submodule("transformer").register_forward_hook(self._keep)

    def _keep(self, _: nn.Module, __: object, tokens: torch.Tensor) -> None:
        self._token = tokens[:, 1:].mean(1) if self.visual.pool_type == "avg" else tokens[:, 0]

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """The class token, and the frame's number: float32, batch x width."""
        self.visual(self.pixels(frames))
        return self._token + sinusoid(frame_indices, self.dim).to(self._token.dtype)

    def describe(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """The same with the class token normalised."""
        self.visual(self.pixels(frames))
        normalised: torch.Tensor = self.visual.get_submodule("ln_post")(self._token)
        return normalised + sinusoid(frame_indices, self.dim).to(normalised.dtype)


class PublishedHeads(nn.Module):
    """A shared hidden layer, then one linear layer a property."""

    def __init__(self, dim: int, classes: Sequence[int]) -> None:
        super().__init__()
        self.shared = nn.Linear(dim, 512)
        self.dropout = nn.Dropout(DROPOUT)
        self.properties = Heads(512, classes)

    def forward(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Logits a property, batch x classes, of features, batch x dim."""
        features = F.normalize(features, dim=-1, eps=SHORTEST_FEATURE)
        logits: list[torch.Tensor] = self.properties(F.relu(self.dropout(self.shared(features))))
        return logits


def base_encoder(config: EncoderConfig) -> PublishedEncoder:
    """CLIP as it comes, read at its class token."""
    return PublishedEncoder(load_visual_tower(Path(config.weights)))


def property_classifier(config: EncoderConfig, classes: Sequence[int]) -> PropertyClassifier:
    """CLIP with visual prompts of their own at every layer, a shared hidden layer and one linear head a property."""
    tower = load_visual_tower(Path(config.weights))
    prompts = VisualPrompts(tower, config.prompts, config.prompt_layers, shared=False)
    encoder = PublishedEncoder(tower, prompts)
    return PropertyClassifier(encoder, PublishedHeads(encoder.dim, classes), classes)


def sinusoid(frame_indices: torch.Tensor, dim: int) -> torch.Tensor:
    """sin and cos of t / 10000^(2 i / dim) by turns (Vaswani et al. 2017, section 3.5): float32, frame_indices x dim.

    Computed in float64, on the CPU since not every device has it: in float32 late frames lose digits, in half precision
    the first rates already fall together.
    """
    rates = 10_000 ** (-torch.arange(0, dim, 2, dtype=torch.float64) / dim)
    angles = frame_indices.cpu().double()[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)[:, :dim].float().to(frame_indices.device)
