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

from pipeline.errors import UserError
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
TREES = 200
"""A property."""


class PropertyPredictor:
    """Predicts every property's class from a video's features.

    Equal seeds, features and labels give equal predictions, on any number of cores.
    """

    def __init__(self, classes: Sequence[int], *, seed: int = 0) -> None:
        self.classes, self.seed = tuple(classes), seed
        self._forests: list[Any] = []
        self._prior = np.zeros(self.classes)

    def fit(self, features: Features, labels: Labels, objects: Sequence[str]) -> PropertyPredictor:
        """Grow the trees on videos and take the prior from their objects; every object counts once."""
        from sklearn.ensemble import ExtraTreesClassifier

        self._prior = log_dependence(labels, objects, self.classes)
        self._forests = []
        for position in range(len(self.classes)):
            forest = ExtraTreesClassifier(
                TREES,
                min_samples_leaf=2,
                n_jobs=cores(),
                random_state=derive_seed(self.seed, "property", position) % 2**32,
            )
            forest.fit(features, labels[:, position])
            # Several threads would add up votes in whatever order they end: not the same sum to the last bit.
            self._forests.append(forest.set_params(n_jobs=1))
        return self

    def probabilities(self, features: Features) -> list[Probabilities]:
        """Videos x classes for each property; rows sum to 1 and nothing is 0.

        One more tree that cannot tell the classes apart votes along: a class that training lacked stays possible.
        """
        results = []
        for forest, count in zip(self._forests, self.classes, strict=True):
            trees = len(forest.estimators_)
            votes = np.full((len(features), count), 1 / count)
            votes[:, forest.classes_] += trees * forest.predict_proba(features)
            results.append(votes / (trees + 1))
        return results

    def predict(self, features: Features) -> Labels:
        """The most probable combination of classes of each video, videos x properties."""
        return decode_jointly([np.log(table) for table in self.probabilities(features)], self._prior)


def log_dependence(labels: Labels, objects: Sequence[str], classes: Sequence[int]) -> Probabilities:
    """log[P(a, b, ...) / (P(a) P(b) ...)] of each combination: an array with one axis a property.

    The joint distribution counts every object once, plus `SMOOTHING` a cell; the single ones are its margins.

    Raises:
        UserError: for more than `MOST_COMBINATIONS`.
    """
    if (number := math.prod(classes)) > MOST_COMBINATIONS:
        raise UserError(
            f"{number} combinations of classes are too many to decide jointly ({MOST_COMBINATIONS} at most); name "
            "fewer properties in properties.yaml, or set encoder.recipe=paper and cross_validation.models=[constant]"
        )
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
    """
    combinations = np.array(list(itertools.product(*map(range, dependence.shape))), dtype=np.int64)
    scores = np.broadcast_to(dependence.ravel(), (len(evidence[0]), dependence.size)).copy()
    for position, table in enumerate(evidence):
        scores += table[:, combinations[:, position]]
    best: Labels = combinations[scores.argmax(axis=1)]
    return best
