"""Why results differ from run to run: what seeds, objects, questions and single answers each contribute.

Every question is answered under every seed. The variance of the mean over both is taken as for clusters that cross
(Cameron, Gelbach, Miller 2011): that of the questions' means by objects, plus that of the seeds' means, less what both
contain. Degrees of freedom are those of a sum of two variances (Satterthwaite 1946): objects less one, seeds less one.
A bootstrap over objects and seeds would ask for more seeds than anybody trains: two or three drawn anew from three
have hardly any spread.

Simulated (reports/bench/coverage.md) with five seeds, the interval covers 93 to 100 % of accuracies over all runs, but
88 to 93 % with seven objects and questions about two or three that depend on them. A single run says nothing of others:
where they deviate by five points, its interval covers nine tenths and, with many objects, half.

NumPy is imported only where it is used.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.statistics.figures import Answer, Interval, Spread

if TYPE_CHECKING:
    from pipeline.statistics.bounds import Estimate
    from pipeline.statistics.clusters import Clusters, Values


@dataclass(frozen=True)
class SeedParts:
    """What the variance of a single answer is made of; components that are estimated below 0 count as 0."""

    seeds: float
    """Whole runs are better or worse."""
    objects: float
    """Objects are easier or harder, under all seeds."""
    questions: float
    """Questions about the same objects are easier or harder, under all seeds."""
    answers: float
    """The same question is answered differently in another run, beyond how good that run is."""


@dataclass(frozen=True)
class OverSeeds:
    """An accuracy over several runs."""

    spread: Spread
    """The accuracy under each seed, in the order of `seeds`."""
    seeds: tuple[int, ...]
    questions: int
    parts: SeedParts | None
    """None for a single seed."""
    expected: float | None
    """The deviation over seeds that single answers alone would make, were all runs equally good; None likewise."""
    most: float
    """What that would be if every question were equally hard, sqrt(p (1 - p) / n): for one seed all that is known of
    it. Where questions differ it is less, though with few seeds `expected` may be estimated higher."""
    interval: Interval | None
    """95 %, for the accuracy over new objects and new runs; for a single seed, new objects alone. None where the
    questions cannot show that objects differ."""


def over_seeds(answers: Sequence[Answer]) -> OverSeeds:
    """The mean over seeds, what it is made of, and its interval for other objects and other seeds.

    Raises:
        ValueError: without answers, or where not every question has one answer under every seed.
    """
    import numpy as np

    from pipeline.statistics.bounds import accuracy_bounds
    from pipeline.statistics.clusters import clusters_of

    seeds, objects, rows = answer_table(answers)
    table, clusters = np.array(rows), clusters_of(objects)
    interval = None
    if clusters.estimable:
        low, high = accuracy_bounds(crossed(table, clusters), clusters)
        interval = Interval(float(low), float(high))
    parts = _parts(table, clusters) if len(seeds) > 1 and clusters.estimable else None
    alone = _residual(table) if len(seeds) > 1 else None
    mean = float(table.mean())
    return OverSeeds(
        spread=Spread(tuple(map(float, table.mean(axis=1)))),
        seeds=seeds,
        questions=len(objects),
        parts=parts,
        expected=None if alone is None else math.sqrt(alone / len(objects)),
        most=math.sqrt(max(0.0, mean * (1 - mean)) / len(objects)),
        interval=interval,
    )


def answer_table(
    answers: Sequence[Answer],
) -> tuple[tuple[int, ...], tuple[tuple[str, ...], ...], list[list[float]]]:
    """Seeds in order, each question's objects, and seeds x questions: how right.

    Questions are in the order of their objects and names.

    Raises:
        ValueError: as `over_seeds`.
    """
    if not answers:
        raise ValueError("an accuracy needs at least one answer")
    about = {a.question: a.objects for a in answers}
    seeds = tuple(sorted({a.seed for a in answers}))
    given = {(a.seed, a.question): a.correct for a in answers}
    if len(given) != len(answers):
        (seed, question), _ = Counter((a.seed, a.question) for a in answers).most_common(1)[0]
        raise ValueError(f"question {question} has several answers under seed {seed}")
    names = sorted(about, key=lambda q: (about[q], q))
    missing = next(((s, q) for s in seeds for q in names if (s, q) not in given), None)
    if missing:
        raise ValueError(f"question {missing[1]} has no answer under seed {missing[0]}")
    return seeds, tuple(about[q] for q in names), [[given[s, q] for q in names] for s in seeds]


def crossed(table: Values, clusters: Clusters) -> Estimate:
    """The mean over seeds and questions and its variance for other seeds and other objects.

    Args:
        table: (..., seeds, questions).
        clusters: The questions' objects.

    Returns:
        Arrays (...). With one seed, that of the questions alone. `square` is of the questions' means over seeds.
    """
    from pipeline.statistics.bounds import Estimate, estimate
    from pipeline.statistics.clusters import variance

    found = estimate(table.mean(axis=-2), clusters)
    runs = table.shape[-2]
    if runs < 2:
        return found
    import numpy as np

    means = table.mean(axis=-1)
    # Both variances hold what single answers do by chance and what objects do in one run alone.
    both = variance(table - table.mean(axis=-2, keepdims=True), clusters).mean(axis=-1) * runs / (runs - 1)
    of_seeds = np.maximum(0.0, means.var(axis=-1, ddof=1) - both) / runs
    total = found.variance + of_seeds
    known = np.where(total > 0, total, 1.0)
    inverse = (found.variance / known) ** 2 / found.freedom + (of_seeds / known) ** 2 / (runs - 1)
    freedom = np.where(total > 0, 1 / np.where(inverse > 0, inverse, 1.0), found.freedom)
    return Estimate(found.mean, found.square, total, freedom)


def _residual(table: Values) -> float:
    """Variance of answers that neither the question nor the seed explains (two-way analysis of variance)."""
    seeds, questions = table.shape
    left = table - table.mean(axis=0) - table.mean(axis=1, keepdims=True) + table.mean()
    return float((left**2).sum()) / float(max(1, (seeds - 1) * (questions - 1)))


def _parts(table: Values, clusters: Clusters) -> SeedParts:
    from pipeline.statistics.clusters import components

    seeds, questions = table.shape
    alone = _residual(table)
    mean = components(table.mean(axis=0), clusters)
    about = float(clusters.membership.sum(axis=1).mean())
    return SeedParts(
        seeds=max(0.0, float(table.mean(axis=1).var(ddof=1)) - alone / questions),
        objects=float(mean[0]) * about,
        # A question's mean holds a share of what its answers do by chance.
        questions=max(0.0, float(mean[1:].sum()) - alone / seeds),
        answers=alone,
    )
