"""Folds of objects: all videos of an object are in one, as videos of one object look alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Labels = npt.NDArray[np.int64]
"""Videos x properties: classes from 0."""


def deal(objects: Sequence[str], folds: int, seed: int) -> list[frozenset[str]]:
    """Deal the distinct objects, shuffled, into folds whose numbers of objects differ by at most one."""
    names = sorted(set(objects))
    order = np.random.default_rng(seed).permutation(len(names))
    return [frozenset(names[i] for i in order[fold::folds]) for fold in range(folds)]
