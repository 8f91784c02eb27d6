"""The backbone `clip`, and the paper's recipe: CLIP's visual tower with visual prompts, and a linear head a property.

Visual prompt tuning is the deep variant (Jia et al. 2022, arXiv 2203.12119) on an unmodified open_clip tower: at each
transformer layer P learnable tokens join the sequence; the previous layer's outputs at its own prompts are discarded.
The paper adds "a shared linear layer"; here each prompt passes through one map common to all layers. The published
code has no such map, draws its prompts from N(0, .02), and puts the first layer's in before the tower's first
normalisation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.core.io import read_json
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.running.errors import UserError
from pipeline.weights import check_finite, first_words
from pipeline.weights.backbones import CLIP_CONFIG, GET_CLIP, frame_side

if TYPE_CHECKING:
    from open_clip.transformer import VisionTransformer


def load_visual_tower(folder: Path, embedding: str = "projected") -> VisionTransformer:
    """The visual tower of a folder in open_clip's format: float32, frozen, in evaluation mode.

    With the `embedding` class_token its output has the transformer's width, else the projection's. What is no vision
    transformer in safetensors that fit their configuration is a UserError.
    """
    import open_clip
    from safetensors import SafetensorError

    frame_side(folder, "clip")  # Called for its checks: open_clip would also read a pickle.
    try:
        text = read_json(folder / CLIP_CONFIG)["model_cfg"]["text_cfg"]
        if "hf_model_name" in text:
            raise UserError(
                f"encoder.weights: open_clip would ask a hub for the text tower of {folder} ({text['hf_model_name']}); "
                "name a CLIP with a text tower of its own"
            )
        model = open_clip.create_model(f"local-dir:{folder}", precision="fp32", require_pretrained=True)
    except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, OSError, SafetensorError) as error:
        reason, remedy = first_words(error), GET_CLIP.format(folder=folder)
        raise UserError(f"encoder.weights: {folder} does not fit its {CLIP_CONFIG} ({reason}); {remedy}") from None
    visual = model.visual
    if not isinstance(visual, open_clip.transformer.VisionTransformer) or not visual.transformer.batch_first:
        raise UserError(f"encoder.weights: {folder} is no vision transformer; visual prompts need one such as ViT-L/14")
    check_finite(folder, "encoder.weights", visual.named_parameters())
    visual.requires_grad_(False).eval()
    if embedding == "class_token":
        visual.proj = None
    return visual


class VisualPrompts(nn.Module):
    """Prompts for a tower's layers, and the hooks that put them there.

    Args:
        count: Prompts a layer.
        layers: How many of the first layers get prompts, 0 for all; later layers pass on the last prompts' tokens.
        shared: Whether all prompts pass through one linear map (the paper), or are as the published code has them.
    """

    def __init__(self, tower: VisionTransformer, count: int, layers: int = 0, *, shared: bool = True) -> None:
        deep, width = len(tower.transformer.resblocks), tower.transformer.width
        super().__init__()
        self.prompts = nn.Parameter(torch.empty(min(deep, layers or deep), count, width))
        self.shared: nn.Linear | None = None
        if shared:
            # As in VPT's code; a patch has its pixels times three channels.
            bound = math.sqrt(6.0 / (3 * math.prod(tower.patch_size) + width))
            nn.init.uniform_(self.prompts, -bound, bound)
            self.shared = nn.Linear(width, width)
            nn.init.kaiming_normal_(self.shared.weight, a=0, mode="fan_out")
            nn.init.zeros_(self.shared.bias)
        else:
            nn.init.normal_(self.prompts, std=0.02)

    def attach(self, visual: nn.Module) -> None:
        """Hook into `visual.transformer.resblocks`: tokens enter as batch x sequence x width and leave as they came."""
        blocks = cast(nn.ModuleList, visual.get_submodule("transformer.resblocks"))
        count, first_norm = self.prompts.shape[1], visual.get_submodule("ln_pre")

        def insert(index: int, _: nn.Module, inputs: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
            tokens, *rest = inputs
            if index > 0:
                tokens = tokens[:, :-count]
            prompts = self.prompts[index]
            if self.shared is not None:
                prompts = self.shared(prompts)
            elif index == 0:
                prompts = first_norm(prompts)
            return (torch.cat([tokens, prompts.to(tokens.dtype).expand(len(tokens), -1, -1)], dim=1), *rest)

        for index, block in enumerate(blocks[: len(self.prompts)]):
            block.register_forward_pre_hook(partial(insert, index))
        blocks[-1].register_forward_hook(lambda _, __, output: output[:, :-count])


class TactileEncoder(FrameEncoder):
    """CLIP's frozen visual tower, with visual prompts or (the base encoder) without.

    It takes frames of the tower's own side, or larger ones, which are averaged over areas.
    """

    def __init__(self, tower: VisionTransformer, prompts: VisualPrompts | None = None) -> None:
        super().__init__(tower.transformer.width if tower.proj is None else tower.proj.shape[1])
        self.visual = tower
        self.mean: torch.Tensor
        self.std: torch.Tensor
        for name in ("mean", "std"):
            value = torch.tensor(tower.preprocess_cfg[name]).view(1, 3, 1, 1)
            self.register_buffer(name, value, persistent=False)
        self.prompts = prompts
        if prompts is not None:
            prompts.attach(tower)

    def train(self, mode: bool = True) -> TactileEncoder:
        """The backbone stays in evaluation mode: frozen means that it behaves the same in training."""
        super().train(mode)
        self.visual.eval()
        return self

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """CLIP's own embeddings: float32, batch x dim."""
        return cast(torch.Tensor, self.visual(self.pixels(frames)))

    def pixels(self, frames: torch.Tensor) -> torch.Tensor:
        """Frames as the tower takes them: batch x 3 x side x side, normalised."""
        pixels = frames.permute(0, 3, 1, 2).to(self.mean.dtype) / 255
        if pixels.shape[-1] != self.visual.image_size[0]:
            pixels = F.interpolate(pixels, self.visual.image_size, mode="area")
        return (pixels - self.mean) / self.std


def load_backbone(config: EncoderConfig, *, tuned: bool) -> TactileEncoder:
    """The backbone `clip`: open_clip's ViT in `encoder.weights`; if `tuned`, with visual prompts, which are trained."""
    tower = load_visual_tower(Path(config.weights), config.embedding)
    return TactileEncoder(tower, VisualPrompts(tower, config.prompts, config.prompt_layers) if tuned else None)


def base_encoder(config: EncoderConfig) -> TactileEncoder:
    """The base of the recipe `paper`: CLIP as it comes."""
    return load_backbone(config, tuned=False)


def property_classifier(config: EncoderConfig, classes: Sequence[int]) -> PropertyClassifier:
    """The recipe `paper`: CLIP with visual prompts that pass one shared linear map, and one linear head a property."""
    encoder = load_backbone(config, tuned=True)
    return PropertyClassifier(encoder, Heads(encoder.dim, classes), classes)
