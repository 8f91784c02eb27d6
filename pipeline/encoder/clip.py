"""Loading of CLIP's visual tower from a folder in open_clip's own format, never from a hub."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import nn

from pipeline.errors import UserError
from pipeline.weights import CLIP_CONFIG, GET_CLIP, check_finite


@dataclass(frozen=True)
class ImageFormat:
    """How the tower wants its input: side in pixels, and mean and deviation of RGB in [0, 1]."""

    size: int
    mean: tuple[float, float, float]
    std: tuple[float, float, float]


@dataclass(frozen=True)
class VisualTower:
    """CLIP's visual tower and its input format; `dim` is the length of an output embedding."""

    module: nn.Module
    image: ImageFormat
    dim: int
    width: int
    """Length of a token inside the transformer."""
    layers: int
    """Depth of the transformer."""
    patch_area: int
    """Values in a patch: pixels times channels."""
    averages: bool
    """Whether an embedding comes from the mean over patches, and not from the class token."""


def load_visual_tower(folder: Path, embedding: Literal["projected", "class_token"] = "projected") -> VisualTower:
    """Load the visual tower in float32, frozen and in evaluation mode; the text tower is dropped.

    `weights.check_encoder` has seen that the files are there and are no pickles.

    Args:
        folder: In open_clip's format.
        embedding: As `EncoderConfig.embedding`; a class token has the transformer's width.

    Raises:
        UserError: for a checkpoint that does not fit its configuration, or a
            tower that is not a vision transformer (visual prompts need one).
    """
    import open_clip
    from safetensors import SafetensorError

    logging.getLogger().setLevel(logging.WARNING)
    try:
        model = open_clip.create_model(f"local-dir:{folder}", precision="fp32", require_pretrained=True)
    except (RuntimeError, ValueError, OSError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"encoder.weights: {folder} does not fit its {CLIP_CONFIG} ({reason}); {GET_CLIP.format(folder=folder)}"
        ) from None
    visual = model.visual
    if not isinstance(visual, open_clip.transformer.VisionTransformer) or not visual.transformer.batch_first:
        raise UserError(f"encoder.weights: {folder} is no vision transformer; visual prompts need one such as ViT-L/14")
    check_finite(folder, "encoder.weights", visual.named_parameters())
    visual.requires_grad_(False).eval()
    if embedding == "class_token":
        visual.proj = None
    preprocess = visual.preprocess_cfg
    size = preprocess["size"]
    image = ImageFormat(
        size=size[0] if isinstance(size, (tuple, list)) else int(size),
        mean=tuple(preprocess["mean"]),
        std=tuple(preprocess["std"]),
    )
    with torch.inference_mode():
        dim = visual(torch.zeros(1, 3, image.size, image.size)).shape[-1]
    transformer, patch = visual.transformer, visual.patch_size
    return VisualTower(
        module=visual,
        image=image,
        dim=dim,
        width=transformer.width,
        layers=len(transformer.resblocks),
        patch_area=3 * patch[0] * patch[1],
        averages=visual.pool_type == "avg",
    )
