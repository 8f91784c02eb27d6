"""The backbone `timm`: any CNN or vision transformer of timm's, read at one of its stages, from a folder and no hub.

A frame's features are the mean and the deviation of each channel over the map that the stage `encoder.feature_stage`
leaves. Fine-tuning changes that stage alone, so that all below it is computed once a picture.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, cast

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.core.io import load_tensors
from pipeline.encoder.model import FrameEncoder, mean_and_deviation
from pipeline.running.errors import UserError
from pipeline.weights import check_finite, first_words
from pipeline.weights.backbones import frame_side

STAGES = "stages.safetensors"
"""File of a packaged model that replaces the network's weights: those of the stages that are read."""


class TimmBackbone(FrameEncoder):
    """A timm network with `forward_intermediates` (nearly all have it), read at a stage: an index in `feature_info`."""

    def __init__(self, model: nn.Module, stage: int) -> None:
        self.info: dict[str, Any] = cast(Any, model).feature_info[stage]
        super().__init__(dim=2 * self.info["num_chs"])
        self.model, self.index = model, stage
        cast(Any, model).prune_intermediate_layers([stage], prune_norm=True, prune_head=True)
        form: dict[str, Any] = cast(Any, model).pretrained_cfg
        # Position embeddings are as long as they were in pretraining; convolutions take any side.
        cut: Any = getattr(model, "patch_embed", None)
        plain = hasattr(cut, "strict_img_size")
        self.own: tuple[int, int] = tuple(cut.img_size if plain else form["input_size"][-2:])
        self.fixed = form.get("fixed_input_size") or (plain and cut.strict_img_size)
        self.patch: tuple[int, int] = cut.patch_size if plain else (1, 1)
        self.mean: torch.Tensor
        self.std: torch.Tensor
        self.register_buffer("mean", torch.tensor(form["mean"]).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(form["std"]).view(1, 3, 1, 1), persistent=False)

    @property
    def last(self) -> nn.Module:
        """The stage that is read."""
        return self.model.get_submodule(self.info["module"])

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """Mean and deviation a channel: batch x 2 channels, of frames, uint8, batch x side x side x RGB."""
        return mean_and_deviation(self._map(frames).flatten(2))

    def trunk(self, frames: torch.Tensor) -> torch.Tensor:
        """What enters the stage: a CNN's map, batch x channels x height x width, or tokens, batch x tokens x width."""
        entering: list[torch.Tensor] = []
        handle = self.last.register_forward_pre_hook(lambda _, inputs: entering.append(inputs[0]))
        try:
            self._map(frames)
        finally:
            handle.remove()
        return entering[0]

    def stage(self, entering: torch.Tensor) -> torch.Tensor:
        """The features, batch x dim, from what `trunk` gave."""
        maps: torch.Tensor = self.last(entering)
        if maps.dim() == 3:  # Tokens; class token and registers are no part of the map.
            maps = maps[:, cast(int, self.model.num_prefix_tokens) :].transpose(1, 2)
        return mean_and_deviation(maps.flatten(2))

    def _map(self, frames: torch.Tensor) -> torch.Tensor:
        """What the stage leaves, batch x channels x height x width, of frames in a size that the network takes."""
        pixels = frames.permute(0, 3, 1, 2).to(next(self.model.parameters()).dtype) / 255
        whole = tuple(max(p, n // p * p) for n, p in zip(pixels.shape[2:], self.patch, strict=True))
        size = self.own if self.fixed else whole
        if pixels.shape[2:] != size:
            pixels = F.interpolate(pixels, size, mode="area")
        pixels = ((pixels - self.mean) / self.std).contiguous(memory_format=torch.channels_last)
        found = cast(Any, self.model).forward_intermediates(
            pixels, indices=[self.index], stop_early=True, intermediates_only=True
        )
        return cast(torch.Tensor, found[0])


def load_backbone(config: EncoderConfig, *, tuned: bool) -> TimmBackbone:
    """The network in `encoder.weights`, in timm's own layout, or `STAGES` of it; fine-tuning changes the last one.

    Weights that do not fit, or a network or stage that cannot be read so, are a UserError.
    """
    import timm
    from safetensors import SafetensorError

    folder = Path(config.weights)
    cut = (folder / STAGES).is_file()
    if not cut:
        frame_side(folder, "timm")
    logging.getLogger("timm").setLevel(logging.WARNING)
    try:
        model = timm.create_model(f"local-dir:{folder}", pretrained=not cut)
    except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, OSError, SafetensorError) as error:
        raise UserError(f"encoder.weights: {folder} does not fit its config.json ({first_words(error)})") from None
    check_finite(folder, "encoder.weights", model.state_dict().items())
    stages = len(getattr(model, "feature_info", ()))
    if not hasattr(model, "forward_intermediates") or not stages:
        raise UserError(f"encoder.weights: {folder} is a network that timm cannot read at a stage; take another")
    if config.feature_stage >= stages:
        raise UserError(
            f"encoder.feature_stage is {config.feature_stage}, but the network in {folder} has stages 0 to {stages - 1}"
        )
    try:
        backbone = TimmBackbone(model.requires_grad_(False).eval(), config.feature_stage)
        if cut:
            backbone.model.load_state_dict(load_tensors(folder / STAGES))
        tried = torch.randint(256, (1, *backbone.own, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
        with torch.inference_mode():
            whole, apart = backbone(tried, torch.zeros(1)), backbone.stage(backbone.trunk(tried))
        same = whole.shape == apart.shape == (1, backbone.dim) and torch.allclose(whole, apart, 1e-3, 1e-3)
    except Exception:  # Networks of other kinds fail in as many ways.
        same = False
    if not same:
        raise UserError(
            f"encoder.weights: {folder} is neither a CNN nor a plain vision transformer; its stage "
            f"{config.feature_stage} cannot be read apart"
        )
    if tuned:
        backbone.last.requires_grad_(True)
    return backbone
