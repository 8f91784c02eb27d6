"""The weights from which the tiny CLIP begins: random, with the structure that short training would not find."""

from __future__ import annotations

import math

import open_clip
import torch

QUERY_KEY = (0.7, 0.7)
VALUE_OUT = (0.4, -0.4)
"""Shares of noise and of the identity (Trockman and Kolter 2023, Mimetic Initialization, their values for vision)."""
POSITION_SCALE = 0.7


@torch.no_grad()
def initialise(model: open_clip.CLIP, temperature: float) -> None:
    """Set the start in place: attention, positions of the patches, and the logit scale."""
    model.logit_scale.fill_(math.log(1 / temperature))
    for block in model.visual.transformer.resblocks:
        _attention(block.attn)
    model.visual.positional_embedding[1:] = POSITION_SCALE * _positions(
        model.visual.grid_size[0], model.visual.positional_embedding.shape[1]
    )


def _attention(attention: torch.nn.MultiheadAttention) -> None:
    """Query times key close to the identity, value times output close to its negative."""
    width, heads = attention.embed_dim, attention.num_heads
    size = width // heads
    query, key, value = attention.in_proj_weight.chunk(3)
    for head in range(heads):
        rows = slice(head * size, (head + 1) * size)
        left, right = _halves(*QUERY_KEY, width, size)
        query[rows], key[rows] = left.T, right.T
    left, right = _halves(*VALUE_OUT, width, width)
    value.copy_(left.T)
    attention.out_proj.weight.copy_(right)


def _halves(noise: float, identity: float, width: int, rank: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Two matrices, width x rank, whose product (first times second transposed) is near noise plus identity."""
    product = noise * torch.randn(width, width) / math.sqrt(width) + identity * torch.eye(width)
    left, size, right = torch.linalg.svd(product)
    root = size[:rank].sqrt()
    return left[:, :rank] * root, right[:rank].T * root


def _positions(side: int, width: int) -> torch.Tensor:
    """Sines and cosines of row and column, patches x width, as in Chen et al. 2021 (MoCo v3)."""
    frequency = 1 / 100 ** (torch.arange(width // 4) / (width // 4))
    angle = torch.arange(side)[:, None] * frequency
    axis = torch.cat([angle.sin(), angle.cos()], 1)
    rows, columns = axis[:, None].expand(-1, side, -1), axis[None].expand(side, -1, -1)
    return torch.cat([rows, columns], 2).reshape(side * side, width)
