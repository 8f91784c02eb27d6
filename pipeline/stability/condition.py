"""How much a network magnifies rounding, measured in float64, and the bound that follows for any format."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import nn

from pipeline.stability.case import Dtype

CHANGE = 1e-4
"""Relative change of the weights: small enough that its square does not count, large against float32's roundings, which
transformers' normalisation keeps in a float64 model."""
DRAWS = 3
SURE = 4.0
"""Deviations that a sum of random roundings stays within but for one in a thousand (Higham and Mary 2019, SIAM J. Sci.
Comput. 41, theorem 2.4: n of them add up to some sqrt(n), not n)."""
STEPS = 8
"""Roundings of a number on its way through one layer besides its sum: its weight, its input, the sum stored, the bias,
the activation or softmax, two of the normalisation, the residual."""


def magnification(module: nn.Module, compute: Callable[[], torch.Tensor]) -> float:
    """How many times as large as a random relative change of all weights the output's is.

    Each weight w becomes w (1 + d) with d normal of deviation `CHANGE`. A change of every weight enters every layer and
    travels through all behind it, as roundings do. In the end all weights are what they were.

    Args:
        module: In float64.
        compute: Its output.

    Returns:
        The largest of some draws: of the output, the largest change over the largest number, by `CHANGE`.
    """
    draw = torch.Generator().manual_seed(0)
    kept = {name: p.detach().clone() for name, p in module.named_parameters()}
    with torch.no_grad():
        before, largest = compute().double(), 0.0
        for _ in range(DRAWS):
            for name, p in module.named_parameters():
                noise = torch.randn(p.shape, generator=draw, dtype=torch.float64)
                p.copy_(kept[name] * (1 + CHANGE * noise.to(p.device, p.dtype)))
            off = (compute().double() - before).abs().max() / before.abs().max()
            largest = max(largest, off.item() / CHANGE)
        for name, p in module.named_parameters():
            p.copy_(kept[name])
    return largest


def rounded(magnified: float, terms: int, dtype: Dtype) -> float:
    """The bound of a network's relative error: magnification x root of the roundings a layer x their deviation.

    Roundings are taken as random, evenly spread from -u to u, which has a deviation of u / sqrt 3. Products of 16 bits
    are added in float32, others in the format itself, so that their sum's roundings count.

    Args:
        magnified: From `magnification`.
        terms: Of the longest sum in the network.
        dtype: The network's.
    """
    roundings = STEPS if dtype.short else STEPS + terms
    return SURE * magnified * math.sqrt(roundings / 3) * dtype.roundoff
