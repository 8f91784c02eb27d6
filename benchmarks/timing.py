"""Times of settings that take turns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median
from time import perf_counter
from typing import TypeVar

from pipeline.core.runtime import cores, processor

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
