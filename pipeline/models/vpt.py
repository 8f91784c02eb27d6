"""Visual prompt tuning, deep variant (Jia et al. 2022, arXiv 2203.12119), on an unmodified open_clip tower.

At each transformer layer P learnable tokens join the sequence; what the layer before made of its own prompts is thrown
away. The paper adds "a shared linear layer": each prompt passes through one linear map common to all layers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import torch
from torch import nn


class VisualPrompts(nn.Module):
    """P prompts for each of L layers, and the hooks that put them there.

    Args:
        layers: L, the transformer's depth.
        count: P, prompts a layer.
        width: Length of a token.
        patch_area: Pixels in a patch, times channels; sets the spread of the initial values as in VPT's code.
    """

    def __init__(self, layers: int, count: int, width: int, patch_area: int) -> None:
        super().__init__()
        bound = math.sqrt(6.0 / (patch_area + width))
        self.prompts = nn.Parameter(torch.empty(layers, count, width).uniform_(-bound, bound))
        self.shared = nn.Linear(width, width)
        nn.init.kaiming_normal_(self.shared.weight, a=0, mode="fan_out")
        nn.init.zeros_(self.shared.bias)

    @property
    def count(self) -> int:
        """Prompts a layer."""
        return self.prompts.shape[1]

    def attach(self, visual: nn.Module) -> None:
        """Hook into `visual.transformer.resblocks`: tokens enter as batch x sequence x width and leave as they came."""
        blocks = cast(nn.ModuleList, visual.get_submodule("transformer.resblocks"))
        for index, block in enumerate(blocks):
            block.register_forward_pre_hook(self._insert(index), with_kwargs=False)
        blocks[-1].register_forward_hook(self._strip)

    def _insert(self, index: int) -> Callable[..., tuple[Any, ...]]:
        def hook(_: nn.Module, inputs: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
            tokens, *rest = inputs
            if index > 0:
                tokens = tokens[:, : -self.count]
            prompts = self.shared(self.prompts[index]).to(tokens.dtype).expand(len(tokens), -1, -1)
            return (torch.cat([tokens, prompts], dim=1), *rest)

        return hook

    def _strip(self, _: nn.Module, __: tuple[torch.Tensor, ...], output: torch.Tensor) -> torch.Tensor:
        return output[:, : -self.count]
