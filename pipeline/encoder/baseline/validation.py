"""How good the baseline is on objects that it has never touched: grouped cross-validation and what it shows.

All videos of an object are in one fold, as videos of one object look alike. Intervals are clustered by object: they
hold the chance of which objects were measured, not that of how folds and trees fell. The spread over repeats shows the
latter; more repeats average it out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np
import numpy.typing as npt

from pipeline.encoder.baseline.predictor import Features, Labels, PropertyPredictor, check_labels
from pipeline.records import OutOfFold
from pipeline.runtime import derive_seed
from pipeline.statistics import Difference, Interval, Outcome, Spread, clustered, paired, quadratic_kappa


@dataclass(frozen=True)
class Verdict:
    """What was predicted of one video by models that had seen no video of its object."""

    object_id: str
    expected: tuple[int, ...]
    """A class for each property."""
    predicted: tuple[tuple[int, ...], ...]
    """Repeats x properties."""

    def correct(self, position: int | None) -> float:
        """The share of the repeats in which one property, or with None every property, is right."""
        if position is None:
            return fmean(p == self.expected for p in self.predicted)
        return fmean(p[position] == self.expected[position] for p in self.predicted)


def collect(records: Iterable[OutOfFold]) -> list[Verdict]:
    """The verdicts that a stage has written down, in the order of the videos' names."""
    videos: dict[str, list[OutOfFold]] = {}
    for record in sorted(records, key=lambda r: (r.video_id, r.repeat)):
        videos.setdefault(record.video_id, []).append(record)
    return [Verdict(v[0].object_id, v[0].expected, tuple(r.predicted for r in v)) for v in videos.values()]


@dataclass(frozen=True)
class Accuracy:
    """How often something was right, each repeat counting alike; all but the spread's deviation from 0 to 1."""

    spread: Spread
    """One accuracy a repeat; its mean is the figure."""
    interval: Interval | None
    """Object-clustered, 95 %; None for fewer than two objects."""
    majority: float
    """The share of the most frequent answer among the same videos: what the best constant answer reaches."""
    chance: float
    """What guessing evenly reaches."""

    @property
    def value(self) -> float:
        """The mean over the repeats."""
        return self.spread.mean


@dataclass(frozen=True)
class PropertySummary:
    """How well one property is told."""

    accuracy: Accuracy
    absolute_error: float
    """Mean distance of the predicted from the expected class, in classes."""
    kappa: float | None
    """Quadratically weighted, pooled over the repeats; None where all is expected and predicted as one class."""


@dataclass(frozen=True)
class Summary:
    """What a cross-validation shows."""

    combined: Accuracy
    """Every property of a video right at once."""
    properties: tuple[PropertySummary, ...]
    videos: int
    objects: int


def deal(objects: Sequence[str], folds: int, seed: int) -> list[frozenset[str]]:
    """Deal the distinct objects, shuffled, into folds whose numbers of objects differ by at most one.

    Raises:
        ValueError: for fewer than two folds, or fewer objects than folds.
    """
    names = sorted(set(objects))
    if not 2 <= folds <= len(names):
        raise ValueError(f"{len(names)} objects cannot be dealt into {folds} folds; 2 to {len(names)} can")
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


def forest(
    features: Features,
    labels: Labels,
    objects: Sequence[str],
    classes: Sequence[int],
    *,
    seed: int = 0,
    jobs: int | None = None,
) -> Predict:
    """What cross-validates the baseline predictor.

    Args:
        features: Videos x features, finite.
        labels: Videos x properties, equal for all videos of an object.
        objects: Each video's object.
        classes: How many classes each property has.
        seed: Of the trees.
        jobs: Cores that grow trees; None takes all that this process may use.

    Raises:
        ValueError: if the arguments do not fit each other.
    """
    if len(features) != len(objects):
        raise ValueError(f"{len(features)} rows of features for {len(objects)} videos")

    def predict(fold: Fold) -> Labels:
        model = PropertyPredictor(classes, seed=derive_seed(seed, "trees", fold.repeat, fold.number), jobs=jobs)
        model.fit(features[fold.trained], labels[fold.trained], np.asarray(objects)[fold.trained].tolist())
        return model.predict(features[fold.tested])

    return predict


def cross_validate(
    predict: Predict,
    labels: Labels,
    objects: Sequence[str],
    classes: Sequence[int],
    *,
    folds: int = 5,
    repeats: int = 3,
    seed: int = 0,
) -> tuple[Verdict, ...]:
    """Predict every video once a repeat, by a model that saw no video of its object.

    Folds depend only on the objects' names and the seed: settings compared with one seed share them.

    Args:
        predict: Called once a fold.
        labels: Videos x properties, equal for all videos of an object.
        objects: Each video's object.
        classes: How many classes each property has.
        folds: Groups of objects, each predicted from all others.
        repeats: How often the folds are dealt anew.
        seed: Of the folds.

    Returns:
        A verdict a video, in the order of `labels`.

    Raises:
        ValueError: if the arguments do not fit each other.
    """
    check_labels(labels, objects, classes)
    if repeats < 1:
        raise ValueError(f"{repeats} repeats")
    predicted = np.empty((len(objects), repeats, len(classes)), np.int64)
    for repeat in range(repeats):
        for number, held_out in enumerate(deal(objects, folds, derive_seed(seed, "folds", repeat))):
            tested = np.array([o in held_out for o in objects])
            predicted[tested, repeat] = predict(Fold(~tested, tested, repeat, number))
    return tuple(
        Verdict(name, tuple(expected), tuple(map(tuple, answers)))
        for name, expected, answers in zip(objects, labels.tolist(), predicted.tolist(), strict=True)
    )


def summarise(verdicts: Sequence[Verdict], classes: Sequence[int]) -> Summary:
    """All figures of a cross-validation.

    Raises:
        ValueError: without any verdict.
    """
    if not verdicts:
        raise ValueError("a summary needs at least one verdict")
    return Summary(
        combined=_accuracy(verdicts, None, math.prod(classes)),
        properties=tuple(_property(verdicts, position, count) for position, count in enumerate(classes)),
        videos=len(verdicts),
        objects=len({v.object_id for v in verdicts}),
    )


def compare(first: Sequence[Verdict], second: Sequence[Verdict], seed: int = 0) -> Difference:
    """The second setting's combined accuracy less the first's, on the same videos in the same order.

    The interval holds nothing of how folds and trees fell: with few repeats a small difference may be just that.

    Raises:
        ValueError: if the verdicts are not about the same videos, or there are none.
    """
    if not first or [(v.object_id, v.expected) for v in first] != [(v.object_id, v.expected) for v in second]:
        raise ValueError("only verdicts on the same videos in the same order can be compared")
    gains = [Outcome(b.correct(None) - a.correct(None), (a.object_id,)) for a, b in zip(first, second, strict=True)]
    return paired(gains, seed)


def _property(verdicts: Sequence[Verdict], position: int, count: int) -> PropertySummary:
    expected = [v.expected[position] for v in verdicts for _ in v.predicted]
    predicted = [p[position] for v in verdicts for p in v.predicted]
    return PropertySummary(
        accuracy=_accuracy(verdicts, position, count),
        absolute_error=fmean(abs(e - p) for e, p in zip(expected, predicted, strict=True)),
        kappa=quadratic_kappa(expected, predicted, count),
    )


def _accuracy(verdicts: Sequence[Verdict], position: int | None, answers: int) -> Accuracy:
    def part(labels: tuple[int, ...]) -> tuple[int, ...]:
        return labels if position is None else labels[position : position + 1]

    repeats = range(len(verdicts[0].predicted))
    common = Counter(part(v.expected) for v in verdicts).most_common(1)[0][1]
    return Accuracy(
        spread=Spread(tuple(fmean(part(v.predicted[r]) == part(v.expected) for v in verdicts) for r in repeats)),
        interval=clustered([Outcome(v.correct(position), (v.object_id,)) for v in verdicts]),
        majority=common / len(verdicts),
        chance=1 / answers,
    )
