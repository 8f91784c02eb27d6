"""Grouped cross-validation: all videos of an object are in one fold, as videos of one object look alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.core.runtime import derive_seed

Labels = npt.NDArray[np.int64]
"""Videos x properties: classes from 0."""


def deal(objects: Sequence[str], folds: int, seed: int) -> list[frozenset[str]]:
    """Deal the distinct objects, shuffled, into folds whose numbers of objects differ by at most one."""
    names = sorted(set(objects))
    order = np.random.default_rng(seed).permutation(len(names))
    return [frozenset(names[i] for i in order[fold::folds]) for fold in range(folds)]


@dataclass(frozen=True)
class Fold:
    """Which videos a model may learn from, and which it is to predict."""

    trained: npt.NDArray[np.bool_]
    tested: npt.NDArray[np.bool_]
    repeat: int
    number: int


Predict = Callable[[Fold], Labels]
"""Learns from the trained videos of a fold and predicts the tested ones, in their order: tested x properties."""


def cross_validate(
    predict: Predict, objects: Sequence[str], classes: Sequence[int], *, folds: int, repeats: int, seed: int = 0
) -> Labels:
    """Predict every video once a repeat, by a model that saw no video of its object: videos x repeats x properties.

    Folds depend only on the objects' names and the seed: settings compared with one seed share them. Each repeat deals
    them anew; there must be at least as many objects as folds.
    """
    predicted = np.empty((len(objects), repeats, len(classes)), np.int64)
    for repeat in range(repeats):
        for number, held_out in enumerate(deal(objects, folds, derive_seed(seed, "folds", repeat))):
            tested = np.array([o in held_out for o in objects])
            predicted[tested, repeat] = predict(Fold(~tested, tested, repeat, number))
    return predicted
