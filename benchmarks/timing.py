"""Times of settings that take turns, and counts that no machine changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING, TypeVar

from pipeline.core.runtime import cores, processor

if TYPE_CHECKING:
    from torch import nn

R = TypeVar("R")
T = TypeVar("T")


def timed(run: Callable[[], R]) -> tuple[R, float]:
    """What one call gives, and the milliseconds that it takes."""
    started = perf_counter()
    found = run()
    return found, 1000 * (perf_counter() - started)


def interleaved(
    settings: Mapping[str, Callable[[T], object]], items: Sequence[T], repeats: int, warm: bool = True
) -> dict[str, list[float]]:
    """Milliseconds an item: of each setting one figure a repeat, the median over the items.

    All settings have their turn at an item before the next item, so that a busy machine slows all alike.

    Args:
        warm: Run every setting once before, uncounted.
    """
    for run in settings.values() if warm else ():
        run(items[0])
    found: dict[str, list[float]] = {name: [] for name in settings}
    for _ in range(repeats):
        spent: dict[str, list[float]] = {name: [] for name in settings}
        for item in items:
            for name, run in settings.items():
                spent[name].append(timed(partial(run, item))[1])
        for name, own in spent.items():
            found[name].append(median(own))
    return found


def machine(threads: str) -> str:
    """The processor, how many cores there are and how many were used."""
    return f"{processor()}, {cores()} cores, {threads}"


def counted(run: Callable[[], R]) -> tuple[R, float]:
    """What a call gives, and its operations: two for a multiplication and an addition.

    torch counts those of matrix products, convolutions and attention. Fused kernels of attention, which its counter
    does not see into, are off meanwhile.
    """
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    fused = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        with FlopCounterMode(display=False) as counter:
            found = run()
    finally:
        torch.backends.mha.set_fastpath_enabled(fused)
    return found, float(counter.get_total_flops())


def megabytes(module: nn.Module) -> float:
    """Parameters and buffers as they lie in memory, in 10^6 bytes."""
    return float(sum(value.numel() * value.element_size() for value in module.state_dict().values())) / 1e6
