"""Visual prompt tuning, deep variant (Jia et al. 2022, arXiv 2203.12119), on an unmodified open_clip tower.

At each transformer layer P learnable tokens join the sequence; what the layer before made of its own prompts is thrown
away. The paper adds "a shared linear layer": each prompt passes through one linear map common to all layers. The
published code has no such map, draws its prompts from N(0, .02), and puts the first layer's in before the tower's first
normalisation.
"""

from __future__ import annotations

import math
from functools import partial
from typing import cast

import torch
from torch import nn

PUBLISHED_DEVIATION = 0.02


class VisualPrompts(nn.Module):
    """P prompts for each of L layers, and the hooks that put them there.

    Args:
        layers: L: the transformer's depth, or fewer; then the last prompts go on through the layers behind.
        count: P, prompts a layer.
        width: Length of a token.
        patch_area: Pixels in a patch, times channels; sets the spread of the initial values as in VPT's code.
        shared: Whether all prompts pass through one linear map (the paper), or are as the published code has them.
    """

    def __init__(self, layers: int, count: int, width: int, patch_area: int, *, shared: bool = True) -> None:
        super().__init__()
        self.prompts = nn.Parameter(torch.empty(layers, count, width))
        self.shared: nn.Linear | None = None
        if shared:
            bound = math.sqrt(6.0 / (patch_area + width))
            nn.init.uniform_(self.prompts, -bound, bound)
            self.shared = nn.Linear(width, width)
            nn.init.kaiming_normal_(self.shared.weight, a=0, mode="fan_out")
            nn.init.zeros_(self.shared.bias)
        else:
            nn.init.normal_(self.prompts, std=PUBLISHED_DEVIATION)

    @property
    def count(self) -> int:
        """Prompts a layer."""
        return self.prompts.shape[1]

    def attach(self, visual: nn.Module) -> None:
        """Hook into `visual.transformer.resblocks`: tokens enter as batch x sequence x width and leave as they came."""
        blocks = cast(nn.ModuleList, visual.get_submodule("transformer.resblocks"))
        norm = visual.get_submodule("ln_pre") if self.shared is None else None
        for index, block in enumerate(blocks[: len(self.prompts)]):
            block.register_forward_pre_hook(partial(self._insert, index, None if index else norm))
        blocks[-1].register_forward_hook(lambda _, __, output: output[:, : -self.count])

    def _insert(
        self, index: int, norm: nn.Module | None, _: nn.Module, inputs: tuple[torch.Tensor, ...]
    ) -> tuple[torch.Tensor, ...]:
        tokens, *rest = inputs
        if index > 0:
            tokens = tokens[:, : -self.count]
        prompts = self.prompts[index]
        for layer in (self.shared, norm):
            prompts = layer(prompts) if layer is not None else prompts
        return (torch.cat([tokens, prompts.to(tokens.dtype).expand(len(tokens), -1, -1)], dim=1), *rest)
