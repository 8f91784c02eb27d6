"""A cheap predictor of an object's properties: one ensemble of random trees a property, decoded jointly.

Sources: Geurts, Ernst, Wehenkel 2006 (extremely randomised trees). Trees see each property on its own; objects that
share one class often share others, so the combination of classes is chosen with the training objects' prior.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.runtime import cores, derive_seed

Features = npt.NDArray[np.float32]
"""Videos x features."""
Labels = npt.NDArray[np.int64]
"""Videos x properties: classes from 0."""
Probabilities = npt.NDArray[np.float64]

SMOOTHING = 1 / 6
"""Objects added to each combination of classes, so that none is impossible."""
MOST_COMBINATIONS = 100_000
"""More would be tables too large to decode with."""


class PropertyPredictor:
    """Predicts every property's class from a video's features.

    Args:
        classes: How many classes each property has.
        seed: Equal seeds, features and labels give equal predictions, on any number of cores.
        trees: Trees a property.
        jobs: Cores that grow trees; None takes all that this process may use.
    """

    def __init__(self, classes: Sequence[int], *, seed: int = 0, trees: int = 200, jobs: int | None = None) -> None:
        if not classes or min(classes) < 1 or math.prod(classes) > MOST_COMBINATIONS:
            raise ValueError(f"classes are 1 or more for each property, {MOST_COMBINATIONS} combinations at most")
        self.classes = tuple(classes)
        self.seed, self.trees, self.jobs = seed, trees, jobs or cores()
        self._forests: list[Any] = []
        self._prior = np.zeros(self.classes)

    def fit(self, features: Features, labels: Labels, objects: Sequence[str]) -> PropertyPredictor:
        """Grow the trees on videos and take the prior from their objects; every object counts once.

        Raises:
            ValueError: if lengths differ, a class is out of range, a feature is not finite, or an object's videos
                differ in a class.
        """
        from sklearn.ensemble import ExtraTreesClassifier

        check_labels(labels, objects, self.classes)
        self._prior = log_dependence(labels, objects, self.classes)
        self._forests = []
        for position in range(len(self.classes)):
            forest = ExtraTreesClassifier(
                self.trees,
                min_samples_leaf=2,
                n_jobs=self.jobs,
                random_state=derive_seed(self.seed, "property", position) % 2**32,
            )
            forest.fit(features, labels[:, position])
            # Several threads would add up votes in whatever order they end: not the same sum to the last bit.
            self._forests.append(forest.set_params(n_jobs=1))
        return self

    def probabilities(self, features: Features) -> list[Probabilities]:
        """Videos x classes for each property; rows sum to 1 and nothing is 0.

        One more tree that cannot tell the classes apart votes along: a class that training lacked stays possible.

        Raises:
            RuntimeError: before `fit`.
        """
        if not self._forests:
            raise RuntimeError("fit comes first")
        results = []
        for forest, count in zip(self._forests, self.classes, strict=True):
            votes = np.full((len(features), count), 1 / count)
            votes[:, forest.classes_] += self.trees * forest.predict_proba(features)
            results.append(votes / (self.trees + 1))
        return results

    def predict(self, features: Features) -> Labels:
        """The most probable combination of classes of each video, videos x properties."""
        return decode_jointly([np.log(table) for table in self.probabilities(features)], self._prior)


def check_labels(labels: Labels, objects: Sequence[str], classes: Sequence[int]) -> None:
    """Raise ValueError where labels do not fit: their shape, their range, or two videos of one object that differ."""
    if labels.shape != (len(objects), len(classes)) or not len(objects):
        raise ValueError(f"labels are {labels.shape} for {len(objects)} videos and {len(classes)} properties")
    if (labels < 0).any() or (labels >= np.array(classes)).any():
        raise ValueError(f"labels go from 0 to less than {tuple(classes)}")
    first = dict(zip(reversed(objects), reversed(labels.tolist()), strict=True))
    for name, row in zip(objects, labels.tolist(), strict=True):
        if row != first[name]:
            raise ValueError(f"the videos of {name} differ in their labels: {first[name]} and {row}")


def log_dependence(labels: Labels, objects: Sequence[str], classes: Sequence[int]) -> Probabilities:
    """log[P(a, b, ...) / (P(a) P(b) ...)] of each combination: an array with one axis a property.

    The joint distribution counts every object once, plus `SMOOTHING` a cell; the single ones are its margins.
    """
    joint = np.full(tuple(classes), SMOOTHING)
    for row in dict(zip(objects, map(tuple, labels.tolist()), strict=True)).values():
        joint[row] += 1
    joint /= joint.sum()
    result: Probabilities = np.log(joint)
    for axis in range(joint.ndim):
        others = tuple(a for a in range(joint.ndim) if a != axis)
        result = result - np.log(joint.sum(axis=others, keepdims=True))
    return result


def decode_jointly(evidence: Sequence[Probabilities], dependence: Probabilities) -> Labels:
    """The combination of each video that maximises the sum of log probabilities and the dependence.

    This is Bayes' rule where the properties' evidence is independent given the classes. Of equal combinations the
    one with the lower classes, read from the first property on, is taken.

    Args:
        evidence: Log probabilities, videos x classes for each property.
        dependence: From `log_dependence`.

    Returns:
        Videos x properties.
    """
    combinations = np.array(list(itertools.product(*map(range, dependence.shape))), dtype=np.int64)
    scores = np.broadcast_to(dependence.ravel(), (len(evidence[0]), dependence.size)).copy()
    for position, table in enumerate(evidence):
        scores += table[:, combinations[:, position]]
    best: Labels = combinations[scores.argmax(axis=1)]
    return best
