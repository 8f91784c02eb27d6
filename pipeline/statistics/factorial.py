"""What each factor of a factorial design does, and whether factors depend on each other.

A main effect is the mean, over all settings of the other factors, of the difference between two levels; an interaction
of two factors is by how much the effect of the one differs between two levels of the other (Fisher 1935; Box, Hunter,
Hunter 2005, chapter 5). Both are contrasts of cell means on the same questions, so they are paired differences, and
everything holds for them that holds for those. NumPy is imported only where it is used.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.statistics.figures import Answer, Interval
from pipeline.statistics.paired import holm

Levels = tuple[str, ...]
Signs = Mapping[Levels, int]
"""Cells of a contrast and how they count, 1 or -1."""
Cell = Mapping[tuple[int, str], Answer]
"""The answers of one cell by seed and question."""


@dataclass(frozen=True)
class Factor:
    """What is varied, and its levels from the simplest on."""

    name: str
    levels: Levels


@dataclass(frozen=True)
class FactorialEffect:
    """One contrast of cell means."""

    factors: tuple[str, ...]
    """One for a main effect, two for an interaction."""
    change: str
    value: float
    """Difference of accuracies, -1 to 1; of an interaction a difference of differences, -2 to 2."""
    interval: Interval | None
    """95 %, for new objects and new seeds; None where the questions cannot show that objects differ."""
    p: float | None
    """Of the sign-flip test over objects, on means over seeds; None likewise."""
    p_holm: float | None
    """Adjusted for all effects of the same kind that were asked for together."""
    questions: int
    seeds: int
    cells: int
    """Settings whose answers are compared."""


def factorial_effects(answers: Sequence[Answer], factors: Sequence[Factor], seed: int = 0) -> list[FactorialEffect]:
    """All main effects and interactions of two factors, between every two levels.

    A contrast takes the settings of the other factors in which all of its levels were run, the seeds that all these
    share, and the questions that all these have answered. What has none is left out.

    Args:
        answers: With their levels in the order of `factors`.
        factors: What was varied.
        seed: Of signs drawn for many objects.

    Raises:
        ValueError: if an answer's levels are not those of the factors, or it is there twice.
    """
    cells = _cells(answers, factors)
    effects = []
    for places in [(i,) for i in range(len(factors))] + list(itertools.combinations(range(len(factors)), 2)):
        changes = [itertools.combinations(factors[i].levels, 2) for i in places]
        for pairs in itertools.product(*changes):
            change = " x ".join(f"{factors[i].name}: {b} minus {a}" for i, (a, b) in zip(places, pairs, strict=True))
            names = tuple(factors[i].name for i in places)
            effect = _effect(cells, _signs(cells, places, pairs), len(places), seed)
            if effect:
                effects.append(replace(effect, factors=names, change=change))
    return [e for size in (1, 2) for e in _adjusted([e for e in effects if len(e.factors) == size])]


def _cells(answers: Sequence[Answer], factors: Sequence[Factor]) -> dict[Levels, dict[tuple[int, str], Answer]]:
    cells: defaultdict[Levels, dict[tuple[int, str], Answer]] = defaultdict(dict)
    for answer in answers:
        known = len(answer.levels) == len(factors)
        if not known or any(v not in f.levels for v, f in zip(answer.levels, factors, strict=True)):
            raise ValueError(f"question {answer.question}: {answer.levels} are no levels of the factors")
        if (answer.seed, answer.question) in cells[answer.levels]:
            raise ValueError(f"question {answer.question} has several answers at {answer.levels}, seed {answer.seed}")
        cells[answer.levels][answer.seed, answer.question] = answer
    return dict(cells)


def _signs(cells: Mapping[Levels, Cell], places: Sequence[int], pairs: Sequence[tuple[str, str]]) -> Signs:
    """The contrast's cells, in settings of the other factors in which all of them are there."""
    signs: dict[Levels, int] = {}
    for base in cells:
        corner = {}
        for sides in itertools.product((0, 1), repeat=len(places)):
            levels = list(base)
            for place, pair, side in zip(places, pairs, sides, strict=True):
                levels[place] = pair[side]
            corner[tuple(levels)] = -1 if (len(sides) - sum(sides)) % 2 else 1
        if corner.keys() <= cells.keys():
            signs |= corner
    return signs


def _effect(cells: Mapping[Levels, Cell], signs: Signs, scale: int, seed: int) -> FactorialEffect | None:
    """The contrast, times `scale`, without its name; None where its cells have no seed or question in common."""
    seeds = sorted(set.intersection(*({s for s, _ in cells[c]} for c in signs))) if signs else []
    asked = [{q for s, q in cells[c] if s == one} for c in signs for one in seeds]
    about = {q: a.objects for c in signs for (_, q), a in cells[c].items()}
    questions = sorted(set.intersection(*asked), key=lambda q: (about[q], q)) if asked else []
    if not questions:
        return None
    import numpy as np

    from pipeline.statistics.bounds import difference_bounds
    from pipeline.statistics.clusters import clusters_of
    from pipeline.statistics.flips import sign_flip
    from pipeline.statistics.seeds import crossed

    # Half of the cells count 1, half -1: divided by half their number even an interaction lies from -1 to 1, as every
    # paired difference does.
    sums = [[sum(n * cells[c][s, q].correct for c, n in signs.items()) for q in questions] for s in seeds]
    table = np.array(sums) / (len(signs) / 2)
    clusters = clusters_of(tuple(about[q] for q in questions))
    interval = p = None
    if clusters.estimable:
        low, high = difference_bounds(crossed(table, clusters), clusters)
        interval = Interval(scale * float(low), scale * float(high))
        p = float(sign_flip(table.mean(axis=0), clusters, seed))
    return FactorialEffect(
        (), "", scale * float(table.mean()), interval, p, None, len(questions), len(seeds), len(signs)
    )


def _adjusted(effects: Sequence[FactorialEffect]) -> list[FactorialEffect]:
    tested = [e.p for e in effects if e.p is not None]
    worth = iter(holm(tested))
    return [e if e.p is None else replace(e, p_holm=next(worth)) for e in effects]
