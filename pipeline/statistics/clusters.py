"""The variance of a mean over questions that share objects. All functions take many data sets at once.

Questions about one object are ordinary clusters. Two questions about pairs or triples depend on each other as soon as
they share one object, so that clusters overlap. Two estimates of the variance:

- `variance`, which the reports use, fits variance components by moments: sums of squares are set equal to what they are
  expected to be (Henderson 1953; Searle, Casella, McCulloch 1992). There is one for objects, one for sets of objects
  that questions come back to, and one for questions. It supposes that a question's objects add up. For questions about
  one object, as many about each, it is the ordinary cluster-robust variance with the factor G / (G - 1), unless that is
  below the variance of independent questions.
- `overlapping_variance` supposes nothing of the kind: every two questions that share an object count with the product
  of their residuals (Cameron, Gelbach, Miller 2011, by inclusion and exclusion over the objects shared; Aronow, Samii,
  Assenova 2015 for pairs). It is unbiased for designs in which each object is equally frequent, but falls below zero
  and scatters when few questions are disjoint: among seven objects a triple leaves only four that share nothing with
  it. It is there to check the first.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
TINY = 1e-12
"""Variances up to it are rounding."""
DISTINCT = 1e-3
"""Two factors are kept apart where no combination of their moments, scaled to 1, is smaller."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """Which objects each question is about, and what the questions' answers may have in common."""

    membership: Values
    """Questions x objects: 1 where the question is about the object."""
    factors: tuple[Values | None, ...]
    """Questions x groups, 0 or 1: by object, by question (None: each is a group of its own), by set of objects where
    sets come back; those that the design tells apart."""
    moments: Values
    """Factors x factors: the expected sum of squares of centred group sums that a unit of each variance brings."""
    totals: Values
    """Factors: by how much a unit of its variance adds to that of the sum over questions."""

    @property
    def objects(self) -> int:
        """How many there are."""
        return int(self.membership.shape[1])

    @property
    def questions(self) -> int:
        """How many there are."""
        return int(self.membership.shape[0])

    @property
    def estimable(self) -> bool:
        """Whether objects can be seen to differ at all: not with one object, nor if every question has every object."""
        return self.objects > 1 and bool(self.moments[0, 0] > TINY)


@lru_cache(maxsize=32)
def clusters_of(objects: tuple[tuple[str, ...], ...]) -> Clusters:
    """The clusters of questions, by the objects of each. Kept, since all variants answer the same questions.

    Raises:
        ValueError: if there is no question, or one is about no object.
    """
    if not objects or not all(objects):
        raise ValueError("there must be questions, each about some object")
    membership = _groups([[o] for o in row] for row in objects)
    by_set = _groups([sorted(set(row))] for row in objects)
    factors: list[Values | None] = []
    for factor in (membership, None, by_set):
        moments = _moments([*factors, factor], len(objects))
        scale = np.sqrt(np.maximum(np.diag(moments), TINY))
        if not factors or np.linalg.eigvalsh(moments / np.outer(scale, scale))[0] > DISTINCT:
            factors.append(factor)
    totals = np.array([len(objects) if f is None else float((f.sum(axis=0) ** 2).sum()) for f in factors])
    return Clusters(membership, tuple(factors), _moments(factors, len(objects)), totals)


def components(values: Values, clusters: Clusters) -> Values:
    """Variance components of the factors, none below 0.

    Args:
        values: (..., questions).

    Returns:
        (..., factors).
    """
    centred = values - values.mean(axis=-1, keepdims=True)
    groups = [centred if f is None else centred @ f for f in clusters.factors]
    sums = np.stack([(g**2).sum(axis=-1) for g in groups], axis=-1)
    # Through the first axes: solve takes right-hand sides in columns.
    found = np.linalg.solve(clusters.moments, np.moveaxis(sums, -1, 0).reshape(len(groups), -1))
    # The others are not fitted again without what is below 0: that would take what is too much from them as well, and
    # covers less in simulated designs.
    parts: Values = np.maximum(np.moveaxis(found.reshape(-1, *sums.shape[:-1]), 0, -1), 0.0)
    return parts


def variance(values: Values, clusters: Clusters) -> Values:
    """Variance of the mean over questions by variance components; at least that of independent questions.

    Simulated (`make bench SECTION=coverage`) it is right on average where objects differ. Where they do not it is too
    large, since a component that is estimated below 0 counts as 0: with seven objects by a quarter, for questions about
    two or three about twice.

    Args:
        values: (..., questions).

    Returns:
        (...).
    """
    questions = clusters.questions
    if questions < 2:
        return np.zeros(values.shape[:-1])
    clustered = components(values, clusters) @ clusters.totals / questions**2
    least = values.var(axis=-1, ddof=1) / questions
    larger: Values = np.maximum(clustered, least)
    return larger


def overlapping_variance(values: Values, clusters: Clusters) -> Values:
    """Variance of the mean over questions from all pairs of questions that share an object; may fall below 0.

    The factor makes up for residuals being taken from the mean: n^2 over the number of ordered pairs of questions
    that share nothing (for single objects, as many questions each, G / (G - 1)). NaN where every two questions share
    an object.

    Args:
        values: (..., questions).

    Returns:
        (...).
    """
    centred = values - values.mean(axis=-1, keepdims=True)
    total, sharing = np.zeros(values.shape[:-1]), 0.0
    for sign, groups in _subsets(clusters):
        total += sign * ((centred @ groups) ** 2).sum(axis=-1)
        sharing += sign * float((groups.sum(axis=0) ** 2).sum())
    disjoint = clusters.questions**2 - sharing
    return total / disjoint if disjoint > 0.5 else np.full_like(total, np.nan)


def _moments(factors: Sequence[Values | None], questions: int) -> Values:
    every = [np.eye(questions) if f is None else f for f in factors]
    centred = [f - f.mean(axis=0) for f in every]
    return np.array([[float(((a.T @ b) ** 2).sum()) for b in centred] for a in centred])


def _groups(rows: Iterable[Iterable[Iterable[str]]]) -> Values:
    """Questions x groups, from the groups that each question is in."""
    named = [[tuple(group) for group in row] for row in rows]
    place = {group: i for i, group in enumerate(sorted({group for row in named for group in row}))}
    matrix = np.zeros((len(named), len(place)))
    for i, row in enumerate(named):
        for group in row:
            matrix[i, place[group]] = 1
    return matrix


@lru_cache(maxsize=32)
def _subsets(clusters: Clusters) -> list[tuple[int, Values]]:
    """For each number of shared objects its sign in inclusion and exclusion, and which questions share which."""
    rows = [np.flatnonzero(row).tolist() for row in clusters.membership]
    found = []
    for size in range(1, max(map(len, rows)) + 1):
        counted = Counter(s for row in rows for s in itertools.combinations(row, size))
        place = {s: i for i, s in enumerate(counted)}
        matrix = np.zeros((len(rows), len(place)))
        for i, row in enumerate(rows):
            for s in itertools.combinations(row, size):
                matrix[i, place[s]] = 1
        found.append((1 if size % 2 else -1, matrix))
    return found
