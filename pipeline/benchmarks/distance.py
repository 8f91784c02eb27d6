"""How far two sets of videos lie from each other, in the features of the baseline predictor.

Rows are videos. Every feature is measured in its deviation over the real videos (`scale`); one that does not vary there
says nothing and is left out by the caller.

Sources: Ramdas, Garcia, Cuturi 2017 (Wasserstein distance as a two-sample statistic); Dowson and Landau 1982 (Frechet
distance of two Gaussians; Heusel et al. 2017 use its square as FID); Lopez-Paz and Oquab 2017 (classifier two-sample
test).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean

import numpy as np
import numpy.typing as npt

from pipeline.encoder.baseline.predictor import Features
from pipeline.encoder.baseline.validation import deal
from pipeline.runtime import cores, derive_seed

Values = npt.NDArray[np.float64]

COMPONENTS = 10
"""Principal components that the Frechet distance is taken in: covariances of more would be noise at a few hundred
videos."""
TREES = 100
FOLDS = 5


def mean_differences(first: Features, second: Features, scale: Values) -> Values:
    """|mean - mean| of each feature over its scale."""
    gaps: Values = np.abs(first.mean(axis=0, dtype=np.float64) - second.mean(axis=0, dtype=np.float64)) / scale
    return gaps


def wasserstein(first: Features, second: Features, scale: Values) -> Values:
    """The 1-Wasserstein distance of each feature over its scale: at least the difference of the means."""
    from scipy.stats import wasserstein_distance

    pairs = zip(first.T.astype(np.float64), second.T.astype(np.float64), scale, strict=True)
    return np.array([wasserstein_distance(a, b) / s for a, b, s in pairs])


def principal_axes(features: Features, scale: Values, components: int = COMPONENTS) -> Values:
    """Features x components: turns features into their strongest principal components, in units of `scale`."""
    scaled = features / scale
    scaled = scaled - scaled.mean(axis=0)
    _, _, directions = np.linalg.svd(scaled, full_matrices=False)
    axes: Values = (directions[:components] / scale).T
    return axes


def frechet(first: Features, second: Features, axes: Values) -> float:
    """sqrt(|m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2))) of the two sets along the axes, as if they were Gaussians.

    Small sets add to it: compare only with sets as large.
    """
    a, b = first @ axes, second @ axes
    one, two = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    # tr (S1 S2)^(1/2) is the sum of the singular values of S1^(1/2) S2^(1/2).
    overlap = float(np.linalg.svd(_root(one) @ _root(two), compute_uv=False).sum())
    squared = float(np.sum((a.mean(axis=0) - b.mean(axis=0)) ** 2) + np.trace(one) + np.trace(two) - 2 * overlap)
    return math.sqrt(max(0.0, squared))


def told_apart(
    first: Features, second: Features, objects: tuple[Sequence[str], Sequence[str]], seed: int, jobs: int | None = None
) -> float:
    """How often trees tell which set a video of an unseen object is from: 1 always, .5 no better than a coin.

    The mean of both sets' shares, cross-validated over folds of objects.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    features = np.concatenate([first, second])
    side = np.repeat([0, 1], [len(first), len(second)])
    names = [*objects[0], *objects[1]]
    told = np.empty(len(names), bool)
    # Each set's objects are dealt for themselves, so that every fold has some of both.
    halves = [deal(o, FOLDS, derive_seed(seed, "told apart", i)) for i, o in enumerate(objects)]
    for number, (one, two) in enumerate(zip(*halves, strict=True)):
        tested = np.array([n in (two if s else one) for n, s in zip(names, side, strict=True)])
        # An object that both sets have must not be trained on by way of the other set.
        trained = np.array([n not in one | two for n in names])
        forest = ExtraTreesClassifier(
            TREES,
            min_samples_leaf=2,
            class_weight="balanced",
            n_jobs=jobs or cores(),
            random_state=derive_seed(seed, "trees", number) % 2**32,
        )
        forest.fit(features[trained], side[trained])
        told[tested] = forest.predict(features[tested]) == side[tested]
    return fmean(float(told[side == s].mean()) for s in (0, 1))


def _root(matrix: Values) -> Values:
    """The symmetric square root of a covariance."""
    values, vectors = np.linalg.eigh(np.atleast_2d(matrix))
    root: Values = vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
    return root
