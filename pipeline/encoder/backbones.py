"""Loading of backbones. A new one is a module with `load_backbone(config, *, tuned)` and an entry in `BACKBONES`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

from pipeline.config import EncoderConfig
from pipeline.errors import UserError, did_you_mean
from pipeline.weights import BACKBONES

if TYPE_CHECKING:
    from pipeline.encoder.model import FrameEncoder


def check_backbones(names: Sequence[str]) -> None:
    """Raise UserError where a name is no backbone's."""
    for name in names:
        if name not in BACKBONES:
            raise UserError(
                f"encoder.backbone: {name} is no backbone; {did_you_mean(name, BACKBONES)}known: {', '.join(BACKBONES)}"
            )


def load_backbones(config: EncoderConfig, *, tuned: bool = False) -> list[FrameEncoder]:
    """The backbones of `encoder.backbone` with their pretrained weights.

    Args:
        config: The section `encoder`.
        tuned: Whether what fine-tuning changes is to be unfrozen: the last stage, or prompts. All else is frozen.

    Raises:
        UserError: for an unknown name, or weights that are missing or do not fit.
    """
    check_backbones(config.backbone)
    return [import_module(BACKBONES[name].module).load_backbone(config, tuned=tuned) for name in config.backbone]
