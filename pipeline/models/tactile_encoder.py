"""The tactile encoder: frames to embeddings, and the classifier that fine-tunes it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.artifacts import load_tensors, save_tensors
from pipeline.errors import UserError
from pipeline.models.clip import ImageFormat, VisualTower, load_visual_tower
from pipeline.models.vpt import VisualPrompts


class TactileEncoder(nn.Module):
    """CLIP's frozen visual tower, with visual prompts or (the base encoder) without."""

    def __init__(self, tower: VisualTower, prompts: int) -> None:
        super().__init__()
        self.visual = tower.module
        self.dim = tower.dim
        self.image: ImageFormat = tower.image
        self.mean: torch.Tensor
        self.std: torch.Tensor
        self.register_buffer("mean", torch.tensor(tower.image.mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(tower.image.std).view(1, 3, 1, 1), persistent=False)
        self.prompts: VisualPrompts | None = None
        if prompts:
            self.prompts = VisualPrompts(tower.layers, prompts, tower.width, tower.patch_area)
            self.prompts.attach(self.visual)

    def train(self, mode: bool = True) -> TactileEncoder:
        """The backbone stays in evaluation mode: frozen means that it behaves the same in training."""
        super().train(mode)
        self.visual.eval()
        return self

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """Embed frames: uint8, batch x side x side x RGB, to float32, batch x dim."""
        pixels = frames.permute(0, 3, 1, 2).to(self.mean.dtype) / 255
        return cast(torch.Tensor, self.visual((pixels - self.mean) / self.std))


class PropertyClassifier(nn.Module):
    """ViFi-CLIP's mean over frames (Rasheed et al. 2023), then one linear head a property."""

    _keys_to_ignore_on_save = None  # read by transformers' Trainer when it reloads a checkpoint

    def __init__(self, encoder: TactileEncoder, classes: Sequence[int]) -> None:
        super().__init__()
        self.encoder = encoder
        self.heads = nn.ModuleList(nn.Linear(encoder.dim, count) for count in classes)

    def forward(self, frames: torch.Tensor, labels: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Classify videos.

        Args:
            frames: uint8, batch x frames x side x side x RGB.
            labels: int64, batch x properties.

        Returns:
            `logits`, batch x (classes of all properties, side by side), and with labels `loss`: the sum of the
            properties' cross-entropies, so that the heads are trained simultaneously.
        """
        batch, count = frames.shape[:2]
        pooled = self.encoder(frames.flatten(0, 1)).view(batch, count, -1).mean(1)
        logits = [head(pooled) for head in self.heads]
        output = {"logits": torch.cat(logits, dim=1)}
        if labels is not None:
            losses = [F.cross_entropy(z, y) for z, y in zip(logits, labels.unbind(1), strict=True)]
            output = {"loss": torch.stack(losses).sum(), **output}
        return output


def trainable_state(module: nn.Module) -> dict[str, torch.Tensor]:
    """The parameters that are trained, by name."""
    return {name: p.detach() for name, p in module.named_parameters() if p.requires_grad}


def save_trainable(module: nn.Module, path: Path) -> None:
    """Write the trained parameters, and only those, as safetensors."""
    save_tensors(path, trainable_state(module))


def load_trainable(module: nn.Module, path: Path) -> None:
    """Read what `save_trainable` wrote; names and shapes must be exactly those of the module's trained parameters."""
    loaded, own = load_tensors(path), trainable_state(module)
    wrong = sorted(loaded.keys() ^ own.keys()) or [n for n in own if loaded[n].shape != own[n].shape]
    if wrong:
        raise UserError(
            f"{path}: does not fit the model ({wrong[0]} is missing, unknown or of another shape); it was made with "
            "other parameters or weights: run `dvc repro`"
        )
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if parameter.requires_grad:
                parameter.copy_(loaded[name])


def base_encoder(weights: Path) -> TactileEncoder:
    """The off-the-shelf CLIP encoder (the ablation's base)."""
    return TactileEncoder(load_visual_tower(weights), prompts=0)


def property_classifier(weights: Path, prompts: int, classes: Sequence[int]) -> PropertyClassifier:
    """The classifier to fine-tune, or to load a fine-tuned state into."""
    return PropertyClassifier(TactileEncoder(load_visual_tower(weights), prompts), classes)
