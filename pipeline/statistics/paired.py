"""Two settings on the same questions: difference, interval, tests. scipy and NumPy are imported where they are used.

Sources: Bonett and Price 2012 (the interval, here with an effective n); McNemar 1947, as an exact test Agresti 2013;
Holm 1979.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.statistics.design import smallest_effect
from pipeline.statistics.figures import Answer, Interval, Outcome
from pipeline.statistics.seeds import answer_table, crossed


@dataclass(frozen=True)
class Difference:
    """How much more often one setting is right than another, on the same questions, from -1 to 1."""

    value: float
    interval: Interval | None
    """For new objects and, with several seeds, new seeds; None where the questions cannot show that objects differ."""
    p: float | None
    """Of the sign-flip test over objects, on means over seeds; None likewise. It is not the interval's: it takes few
    values and is about these runs alone, and may doubt what the interval excludes, or the other way round."""
    least: float | None = None
    """The smallest p that so few objects can give."""
    mcnemar: float | None = None
    """Exact, as if questions were independent: only to be read beside `p`. None where differences are not whole. With
    several seeds each is tested on its own, and this is the smallest p times their number (Bonferroni)."""
    detectable: float | None = None
    """The smallest true difference that a t test with the interval's standard error and degrees of freedom would find
    in four of five repetitions."""


def paired(gains: Sequence[Outcome], seed: int = 0) -> Difference:
    """The mean of paired differences with all that belongs to it; `seed` is that of signs drawn for many objects.

    Simulated (reports/bench/coverage.md), the interval (`bounds.difference_bounds`) covers 93 % and more; with seven
    objects 97 to 100 % for most questions about one. It falls short, 88 to 91 %, with seven objects for questions about
    two or three that correlate within objects, where a setting is nearly always right. It holds nothing of seeds:
    `paired_over_seeds` does.

    Raises:
        ValueError: without any question.
    """
    if not gains:
        raise ValueError("a comparison needs at least one question")
    # Sums of floats depend on their order; questions' must not matter.
    ordered = sorted((gain.objects, gain.correct) for gain in gains)
    return difference([[value for _, value in ordered]], tuple(objects for objects, _ in ordered), seed)


def paired_over_seeds(gains: Sequence[Answer], seed: int = 0) -> Difference:
    """As `paired`, where both settings were run under several seeds: the interval is for new objects and new seeds.

    Simulated (`make bench SECTION=coverage`) with five seeds, it covers 93 to 100 %, but about 92 % with seven objects
    for questions about two or three that depend much on them, where a setting is nearly always right. What leaves the
    seeds out covers as little as 63 % with sixty objects.

    Args:
        gains: One a question and seed; `correct` is the difference, from -1 to 1.
        seed: Of signs drawn for many objects.

    Raises:
        ValueError: as `over_seeds`.
    """
    _, objects, rows = answer_table(gains)
    return difference(rows, objects, seed)


def difference(rows: Sequence[Sequence[float]], objects: tuple[tuple[str, ...], ...], seed: int = 0) -> Difference:
    """The mean of paired differences with all that belongs to it.

    Args:
        rows: Seeds x questions, from -1 to 1; at least one of both.
        objects: Each question's.
        seed: Of signs drawn for many objects.
    """
    mean = math.fsum(value for row in rows for value in row) / (len(rows) * len(objects))
    exact = _mcnemar_a_seed(rows)
    import numpy as np

    from pipeline.statistics.bounds import difference_bounds, difference_error
    from pipeline.statistics.clusters import clusters_of
    from pipeline.statistics.flips import flip_units, least_p, sign_flip

    clusters = clusters_of(objects)
    if not clusters.estimable:
        return Difference(mean, None, None, mcnemar=exact)
    table = np.array(rows)
    found = crossed(table, clusters)
    low, high = difference_bounds(found, clusters)
    error = float(difference_error(found, clusters))
    return Difference(
        value=mean,
        # The estimate is summed in another way than the mean.
        interval=Interval(min(float(low), mean), max(float(high), mean)),
        p=float(sign_flip(table.mean(axis=0), clusters, seed)),
        least=least_p(len(flip_units(clusters))),
        mcnemar=exact,
        detectable=smallest_effect(error, clusters.objects, freedom=float(found.freedom)),
    )


def mcnemar(gains: Sequence[float]) -> float | None:
    """Two-sided exact McNemar test: of the questions that one setting alone gets right, is it half each?

    It takes questions to be independent. Where they share objects it finds differences where there are none:
    simulated, in up to half of the comparisons where 5 % are meant.

    Args:
        gains: 1 where the first setting alone is right, -1 where the second alone is, 0 otherwise.

    Returns:
        1 where no question is discordant; None where a gain is not whole, as a mean over seeds is not.
    """
    from scipy.stats import binomtest

    if any(gain not in (-1, 0, 1) for gain in gains):
        return None
    better, worse = sum(gain > 0 for gain in gains), sum(gain < 0 for gain in gains)
    return float(binomtest(better, better + worse).pvalue) if better + worse else 1.0


def holm(ps: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment: what each p of a family is worth when all of them were looked at (Holm 1979)."""
    order = sorted(range(len(ps)), key=ps.__getitem__)
    adjusted, worst = [0.0] * len(ps), 0.0
    for rank, i in enumerate(order):
        worst = max(worst, min(1.0, (len(ps) - rank) * ps[i]))
        adjusted[i] = worst
    return adjusted


def _mcnemar_a_seed(rows: Sequence[Sequence[float]]) -> float | None:
    tested = [p for row in rows if (p := mcnemar(row)) is not None]
    return min(1.0, len(rows) * min(tested)) if len(tested) == len(rows) else None
