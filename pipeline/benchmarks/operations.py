"""Floating-point operations: what torch counts in a call, which no machine makes faster or slower."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch.utils.flop_counter import FlopCounterMode


def counted(run: Callable[[], object]) -> int:
    """Operations of matrix products, convolutions and attention in a call, two for a multiplication and an addition.

    Fused kernels of attention, which the counter does not see into, are off meanwhile. It does not see quantised layers
    either: there is no telling what they would have cost.
    """
    fused = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        with FlopCounterMode(display=False) as counter:
            run()
    finally:
        torch.backends.mha.set_fastpath_enabled(fused)
    return int(counter.get_total_flops())
