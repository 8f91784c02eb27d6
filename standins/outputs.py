"""What the recipes write: whole folders at once, small tables, and intervals for shares."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.io import write_text

Z95 = 1.959963984540054
"""The normal quantile of a two-sided 95 % interval."""


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """Give an empty folder beside `folder` that takes its place if the block succeeds."""
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    temporary.mkdir(parents=True)
    try:
        yield temporary
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV table; floats with four decimals."""
    lines = [",".join(header)]
    lines += [",".join(f"{cell:.4f}" if isinstance(cell, float) else str(cell) for cell in row) for row in rows]
    write_text(path, "\n".join(lines) + "\n")


def wilson(correct: int, n: int) -> tuple[float, float, float]:
    """A share with its 95 % interval (Wilson 1927): share, low, high."""
    if n == 0:
        raise ValueError("a share of nothing")
    p, z2 = correct / n, Z95**2 / n
    centre = (p + z2 / 2) / (1 + z2)
    half = Z95 / (1 + z2) * math.sqrt(p * (1 - p) / n + z2 / (4 * n))
    return p, max(0.0, centre - half), min(1.0, centre + half)
