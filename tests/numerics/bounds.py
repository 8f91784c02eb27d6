"""Bounds that more than one part uses. None is fitted to an error that was measured; its test says which kind it is.

- roundings: an operation count times the format's unit roundoff (Higham 2002, Accuracy and Stability of Numerical
  Algorithms, chapters 2 to 4), where a sum of n terms in any order is off by at most n u times the sum of their sizes;
- condition: the same times how much a computation magnifies relative changes, measured in float64 (`magnification`);
- use: an error that changes nothing for whoever reads the result, such as half a step of 8 bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import nn

from tests.numerics.harness import FLOAT32, Format


def summing(terms: int, fmt: Format) -> float:
    """Relative error of a sum of rounded products, in any order: n u (Higham 2002, section 3.1).

    Sums of 16-bit products are taken in float32 and rounded once; weights and inputs were rounded before: 3 u + n u32.
    """
    return 3 * fmt.roundoff + terms * FLOAT32.roundoff if fmt.short else (terms + 2) * fmt.roundoff


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
    """How many times as large as a random relative change of all weights the output's is, at most of some draws.

    Each weight w becomes w (1 + d) with d normal of deviation `CHANGE`. A change of every weight enters every layer and
    travels through all behind it, as roundings do. The module is in float64; in the end all weights are what they were.
    """
    draw = torch.Generator().manual_seed(0)
    kept = [(p, p.detach().clone()) for p in module.parameters()]
    largest = 0.0
    with torch.no_grad():
        before = compute().double()
        for _ in range(DRAWS):
            for p, value in kept:
                p.copy_(value * (1 + CHANGE * torch.randn(p.shape, generator=draw, dtype=torch.float64).to(p)))
            off = (compute().double() - before).abs().max() / before.abs().max()
            largest = max(largest, off.item() / CHANGE)
        for p, value in kept:
            p.copy_(value)
    return largest


def rounded(magnified: float, terms: int, fmt: Format) -> float:
    """The bound of a network's relative error: magnification x root of the roundings a layer x their deviation.

    Roundings are taken as random, evenly spread from -u to u, which has a deviation of u / sqrt 3. Products of 16 bits
    are added in float32, others in the format itself, so that the roundings of the longest sum (`longest_sum`) count.
    """
    return SURE * magnified * math.sqrt((STEPS if fmt.short else STEPS + terms) / 3) * fmt.roundoff


def longest_sum(module: nn.Module) -> int:
    """Terms of the longest sum that a layer of a network takes."""
    return max(layer.weight[0].numel() for layer in module.modules() if isinstance(layer, (nn.Linear, nn.Conv2d)))
