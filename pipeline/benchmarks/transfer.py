"""What carries over between real videos and scenes: the baseline predictor trained on one kind and tested on the other.

Folds are of objects and shared by all four ways: a model has seen no video and no scene of an object that it is tested
on, so that what it knows it knows of other objects.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.encoder.baseline.predictor import Features, Labels, PropertyPredictor
from pipeline.encoder.baseline.validation import Accuracy, Summary, Verdict, deal, summarise
from pipeline.benchmarks import BenchRow
from pipeline.runtime import derive_seed

REPEATS = 3
FOLDS = 5


class TransferRow(BenchRow):
    """A share of wrong answers, with its object-clustered interval; `ratio` is to training on the tested kind."""

    majority: float
    """What the best constant answer has wrong."""
    chance: float
    """What guessing evenly has wrong."""


@dataclass(frozen=True)
class Kind:
    """The videos of one kind: a row of features each, their objects and labels."""

    features: Features
    objects: tuple[str, ...]
    labels: Labels

    def of(self, objects: frozenset[str]) -> np.ndarray:
        """Which videos are of these objects."""
        return np.array([o in objects for o in self.objects])

    def take(self, chosen: np.ndarray) -> Kind:
        """Some of the videos."""
        return Kind(self.features[chosen], tuple(itertools.compress(self.objects, chosen)), self.labels[chosen])


def transfer(
    kinds: dict[str, Kind], classes: Sequence[int], names: Sequence[str], repeats: int = REPEATS
) -> list[TransferRow]:
    """From every kind to every kind, for each property (of `names`) and for all at once.

    Args:
        kinds: By name; all have videos of the same ten or more objects.
        classes: How many classes each property has.
        names: Of the properties.
        repeats: How often folds are dealt anew.
    """
    summaries = _summaries(kinds, classes, repeats)
    rows = []
    for place, name in enumerate((*names, "all properties")):
        for (source, target), summary in summaries.items():
            accuracy = _accuracies(summary)[place]
            own = _accuracies(summaries[target, target])[place]
            assert accuracy.interval is not None, "there are several objects"
            wrong = 1 - accuracy.value
            rows.append(
                TransferRow(
                    case=f"{name}, {source} to {target}",
                    cost=round(wrong, 4),
                    unit="share wrong",
                    baseline=f"{name}, {target} to {target}",
                    ratio=round(wrong / max(1 - own.value, 1e-9), 3),
                    error=round(wrong, 4),
                    low=round(1 - accuracy.interval.high, 4),
                    high=round(1 - accuracy.interval.low, 4),
                    majority=round(1 - accuracy.majority, 4),
                    chance=round(1 - accuracy.chance, 4),
                )
            )
    return rows


def _summaries(kinds: dict[str, Kind], classes: Sequence[int], repeats: int) -> dict[tuple[str, str], Summary]:
    """How each way went, by the names of the kinds trained on and tested on."""
    ways = list(itertools.product(kinds, kinds))
    predicted = {way: np.empty((len(kinds[way[1]].objects), repeats, len(classes)), np.int64) for way in ways}
    objects = next(iter(kinds.values())).objects
    for repeat in range(repeats):
        for number, held_out in enumerate(deal(objects, FOLDS, derive_seed(0, "folds", repeat))):
            for source, kind in kinds.items():
                known = kind.take(~kind.of(held_out))
                model = PropertyPredictor(classes, seed=derive_seed(0, "trees", repeat, number))
                model.fit(known.features, known.labels, known.objects)
                for target, other in kinds.items():
                    tested = other.of(held_out)
                    predicted[source, target][tested, repeat] = model.predict(other.features[tested])
    return {way: summarise(_verdicts(kinds[way[1]], answers), classes) for way, answers in predicted.items()}


def _verdicts(kind: Kind, answers: np.ndarray) -> list[Verdict]:
    return [
        Verdict(name, tuple(expected), tuple(map(tuple, given)))
        for name, expected, given in zip(kind.objects, kind.labels.tolist(), answers.tolist(), strict=True)
    ]


def _accuracies(summary: Summary) -> list[Accuracy]:
    return [*(p.accuracy for p in summary.properties), summary.combined]
