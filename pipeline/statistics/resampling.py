"""Objects drawn anew: the bootstrap over clusters, enumerated where they are few. NumPy is imported where it is used.

Sources: Owen 2007, "The pigeonhole bootstrap", and Owen and Eckles 2012 (crossed factors drawn apart, their weights
multiplied); Davezies, D'Haultfoeuille, Guyonvarch 2021 (pairs of objects of one kind, drawn once for both places);
Cameron, Gelbach, Miller 2008 (few clusters).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

from pipeline.statistics.figures import LEVEL, Interval, Outcome

if TYPE_CHECKING:
    from pipeline.statistics.clusters import Values

MOST_ENUMERATED = 8
"""Up to so many clusters every resample is enumerated (8: 6435 of them); beyond, resamples are drawn."""
DRAWS = 10_000


def resampled(outcomes: Sequence[Outcome], seed: int = 0) -> Interval | None:
    """Percentile interval of a mean over questions when objects, not questions, are drawn anew with replacement.

    A question's weight in a resample is the product over its objects of how often each was drawn: for questions about
    one object this is the ordinary cluster bootstrap, for pairs and triples the pigeonhole bootstrap with one draw of
    objects for all places. Resamples in
    which no question has any weight (all draws on too few objects) have no mean and are left out. With up to
    `MOST_ENUMERATED` objects the distribution is exact, beyond it is drawn with `seed`.

    It is optimistic where objects are few: simulated (reports/bench/coverage.md) with seven and questions about one, it
    covers 85 to 88 % of accuracies from .3 to .8 and 46 to 82 % of .05 or .97. For questions about two or three it
    covers up to 100 % where objects do not differ, as the product of the weights counts each question's own chance
    several times, and 49 to 89 % where they differ much. With sixty objects and questions about one it is fair.
    `clustered` is closer to 95 % nearly throughout; this one is for whoever wants no model.

    Returns:
        None for fewer than two objects, or where every question is about every object.
    """
    objects = sorted({o for outcome in outcomes for o in outcome.objects})
    sets = [frozenset(outcome.objects) for outcome in outcomes]
    if len(objects) < 2 or all(len(s) == len(objects) for s in sets):
        return None
    import numpy as np

    place = {o: i for i, o in enumerate(objects)}
    # Sums of floats depend on their order; questions' must not matter.
    ordered = sorted((tuple(sorted({place[o] for o in o_.objects})), o_.correct) for o_ in outcomes)
    distinct = {s: i for i, s in enumerate(dict.fromkeys(s for s, _ in ordered))}
    weights, probabilities = set_weights(len(objects), tuple(distinct), seed)
    right, total = np.zeros(len(distinct)), np.zeros(len(distinct))
    for s, correct in ordered:
        right[distinct[s]] += correct
        total[distinct[s]] += 1
    low, high = percentiles((weights @ right) / (weights @ total), probabilities)
    return Interval(float(low), float(high))


@lru_cache(maxsize=8)
def set_weights(
    objects: int, sets: tuple[tuple[int, ...], ...], seed: int = 0, draws: int = DRAWS
) -> tuple[Values, Values]:
    """What a question about each set of objects counts in each resample, and the resamples' probabilities.

    Kept, since all variants answer the same questions.

    Args:
        objects: How many there are.
        sets: Different sets of them, by number.
        seed: Of the resamples, where they are drawn.
        draws: How many, there.

    Returns:
        Resamples x sets, and resamples; those in which no set counts are left out.
    """
    import numpy as np

    counts, probabilities = _resamples(objects, seed, draws)
    weights = np.stack([counts[:, list(s)].prod(axis=1) for s in sets], axis=1)
    defined = weights.any(axis=1)
    return weights[defined], probabilities[defined] / probabilities[defined].sum()


def percentiles(values: Values, probabilities: Values) -> tuple[Values, Values]:
    """The central 95 % of discrete distributions: the smallest values that reach each tail's share.

    Args:
        values: (..., resamples).
        probabilities: Of the resamples.

    Returns:
        Both ends, (...).
    """
    import numpy as np

    order = np.argsort(values, axis=-1, kind="stable")
    reached = np.cumsum(probabilities[order], axis=-1) / probabilities.sum()
    ends = []
    for share in ((1 - LEVEL) / 2, (1 + LEVEL) / 2):
        # A tail that is met exactly, up to rounding, counts as met.
        first = np.minimum((reached < share - 1e-12).sum(axis=-1, keepdims=True), values.shape[-1] - 1)
        ends.append(np.take_along_axis(values, np.take_along_axis(order, first, -1), -1)[..., 0])
    return ends[0], ends[1]


def compositions(total: int, parts: int) -> Iterator[tuple[int, ...]]:
    """All ways to write `total` as an ordered sum of `parts` whole numbers from 0: C(total + parts - 1, parts - 1)."""
    for bars in itertools.combinations(range(total + parts - 1), parts - 1):
        edges = (-1, *bars, total + parts - 1)
        yield tuple(b - a - 1 for a, b in itertools.pairwise(edges))


def _resamples(clusters: int, seed: int, draws: int) -> tuple[Values, Values]:
    """How often each cluster is drawn (resamples x clusters), and each resample's probability."""
    import numpy as np

    if clusters > MOST_ENUMERATED:
        drawn = np.random.default_rng(seed).multinomial(clusters, [1 / clusters] * clusters, size=draws)
        return drawn.astype(np.float64), np.full(draws, 1 / draws)
    every = list(compositions(clusters, clusters))
    ways = [math.factorial(clusters) / math.prod(map(math.factorial, counts)) for counts in every]
    return np.array(every, dtype=np.float64), np.array(ways) / clusters**clusters
