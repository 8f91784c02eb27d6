"""Property heads read anew on a frozen encoder, from a handful of rated objects.

Few objects cannot tell hundreds of features apart, but they can say how a few logits are meant; many objects tell more
by features. The heads that the encoder has know other objects, and where properties are the same their evidence is
added. Which way it is, a cross-validation inside the rated objects decides.

Which ways there are, their penalties, and from how many objects on one is chosen, was decided by looking at real videos
of the 67 objects of PhysiCLeAR that are no test objects of the paper: figures on those are optimistic.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.core.runtime import derive_seed
from pipeline.encoder.frame_classifier import FOLDS, Clips, FittedHeads, Labels, deal, fit_frame_heads, log_dependence

Array = npt.NDArray[np.float64]
Linear = tuple[Array, Array]
"""Weights, classes of all properties x features, and biases: the logits of a frame's features."""

ON_LOGITS, ON_FEATURES = 0.1, 1e-3
"""Inverse weights of the penalty (scikit-learn's C). With few objects a choice among several was worse than one."""


class Way(StrEnum):
    """What heads are read from."""

    OLD = "the old heads, with the mean and deviation of these videos"
    LOGITS = "the old heads' logits"
    FEATURES = "features"
    BOTH = "features, beside the old heads"


class Rated(NamedTuple):
    """Videos of rated objects."""

    clips: Clips
    labels: Labels
    objects: npt.NDArray[np.str_]
    """Whose each video is."""

    def of(self, some: npt.NDArray[np.bool_]) -> Rated:
        """Some of the videos."""
        return Rated(self.clips[some], self.labels[some], self.objects[some])


class Known(NamedTuple):
    """The heads that the encoder has."""

    linear: Linear
    alike: bool
    """Whether their properties and classes are those that are rated."""


class Reading(NamedTuple):
    """Heads for new objects, and what heads that were fitted alike say of objects that they did not see."""

    heads: FittedHeads
    way: Way
    evidence: list[Array]
    """Log probabilities, videos x classes of each property."""
    predicted: Labels
    usual: Labels
    """The most frequent class of each property among the other objects, videos x properties."""
    halved: Labels
    """Predictions of heads of half as many objects."""


def read_anew(rated: Rated, classes: Sequence[int], known: Known, seed: int) -> Reading:
    """Fit heads of `classes` classes each to rated videos of two objects or more.

    Each object is tested by heads that were fitted without it, in a way that was chosen without it.
    """
    many = len({*rated.objects}) >= FOLDS
    way = choose(rated, classes, known, seed, many)
    evidence = [np.zeros((len(rated.clips), count)) for count in classes]
    predicted, usual, halved = (np.zeros_like(rated.labels) for _ in range(3))
    for tested in _held(rated.objects, seed, "tested"):
        others, clips = rated.of(~tested), rated.clips[tested]
        # By the same rule, also where fewer are left without the tested ones: what is tested is what is shipped.
        chosen = choose(others, classes, known, seed, many)
        heads = fit(others, classes, known, chosen)
        for whole, part in zip(evidence, heads.evidence(clips), strict=True):
            whole[tested] = part
        predicted[tested] = heads.predict(clips)
        _, first = np.unique(others.objects, return_index=True)
        usual[tested] = [np.bincount(column).argmax() for column in others.labels[first].T]
        half = sorted(deal(list(others.objects), 2, derive_seed(seed, "half"))[0])
        halved[tested] = fit(others.of(np.isin(others.objects, half)), classes, known, chosen).predict(clips)
    found = fit(rated, classes, known, way)
    return Reading(found, way, evidence, predicted, usual, halved)


def choose(rated: Rated, classes: Sequence[int], known: Known, seed: int, many: bool) -> Way:
    """The way by which objects that are held out have the likeliest classes, each object counted once.

    The share of right answers would be too coarse a measure with few objects. Without `many` (`FOLDS` or more) there
    are too few to choose by: the old heads stay where properties are alike, else their logits are read.
    """
    ways = [Way.LOGITS, Way.FEATURES, Way.BOTH][: 3 if known.alike else 2]
    _, place, counts = np.unique(rated.objects, return_inverse=True, return_counts=True)
    if not many:
        return Way.OLD if known.alike else Way.LOGITS
    missed = np.zeros(len(ways))
    for tested in _held(rated.objects, seed, "way"):
        others, labels = rated.of(~tested), rated.labels[tested]
        for number, way in enumerate(ways):
            for position, table in enumerate(fit(others, classes, known, way).evidence(rated.clips[tested])):
                likelihood = table[np.arange(len(labels)), labels[:, position]]
                missed[number] -= float(likelihood @ (1 / counts[place[tested]]))
    return ways[int(missed.argmin())]


def fit(rated: Rated, classes: Sequence[int], known: Known, way: Way) -> FittedHeads:
    """Heads on features, read in one way."""
    clips, labels, objects = rated.clips, rated.labels, list(rated.objects)
    old, bias = known.linear
    if way is Way.OLD:
        dependence = log_dependence(labels, objects, classes)
        return on_features(standardised(known.linear, clips), clips, classes, dependence)
    if way is Way.LOGITS:
        read = fit_frame_heads((clips @ old.T + bias).astype(np.float32), labels, objects, classes, ON_LOGITS)
        weights, biases = read.linear()
        weights, biases = weights @ old, weights @ bias + biases
    else:
        read = fit_frame_heads(clips, labels, objects, classes, ON_FEATURES)
        weights, biases = read.linear()
    if known.alike and way is not Way.FEATURES:
        # Evidence of two sources that err apart: their logits are added.
        more = standardised(known.linear, clips)
        weights, biases = weights + more[0], biases + more[1]
    return on_features((weights, biases), clips, classes, read.dependence)


def standardised(linear: Linear, clips: Clips) -> Linear:
    """Heads whose logits have mean 0 and deviation 1 over these clips' frames; where one is constant, it stays 0."""
    logits = (clips @ linear[0].T + linear[1]).reshape(-1, len(linear[1]))
    mean, deviation = logits.mean(axis=0), logits.std(axis=0)
    scale = np.where(deviation > 1e-6, deviation, np.inf)
    return linear[0] / scale[:, None], (linear[1] - mean) / scale


def on_features(linear: Linear, clips: Clips, classes: Sequence[int], dependence: Array) -> FittedHeads:
    """A linear map of features as heads on features that are standardised by these clips."""
    frames = clips.reshape(-1, clips.shape[2])
    centre, spread = frames.mean(axis=0), frames.std(axis=0)
    spread = np.where(spread > 1e-6, spread, 1).astype(np.float32)
    ends = np.cumsum(classes)[:-1]
    weights, biases = linear[0] * spread, linear[1] + linear[0] @ centre
    return FittedHeads(centre, spread, np.split(weights, ends), np.split(biases, ends), dependence)


def _held(objects: npt.NDArray[np.str_], seed: int, why: str) -> list[npt.NDArray[np.bool_]]:
    """Which videos are held out together, objects whole."""
    folds = deal(list(objects), min(FOLDS, len(np.unique(objects))), derive_seed(seed, why))
    return [np.isin(objects, sorted(held)) for held in folds]
