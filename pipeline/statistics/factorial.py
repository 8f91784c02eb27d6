"""What each factor of a factorial design does, and whether factors depend on each other.

A main effect is the mean, over all settings of the other factors, of the difference between two levels; an interaction
of two factors is by how much the effect of the one differs between two levels of the other (Fisher 1935; Box, Hunter,
Hunter 2005). Both are contrasts of cell means on the same questions, so they are paired differences, and everything
holds for them that holds for those.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.statistics.figures import Answer, Interval
from pipeline.statistics.paired import Difference, difference

Levels = tuple[str, ...]
Signs = Mapping[Levels, int]
"""Cells of a contrast and how they count, 1 or -1."""
Cell = Mapping[tuple[int, str], Answer]
"""The answers of one cell by seed and question."""


@dataclass(frozen=True)
class Factor:
    """What is varied, and its levels; of every two the later is compared with the earlier."""

    name: str
    levels: Levels


@dataclass(frozen=True)
class FactorialEffect:
    """One contrast of cell means."""

    factors: tuple[str, ...]
    """One for a main effect, two for an interaction."""
    changes: tuple[str, ...]
    """As "with minus without", one a factor."""
    value: float
    """Difference of accuracies, -1 to 1; of an interaction a difference of differences, -2 to 2."""
    interval: Interval | None
    """95 %, for new objects and new seeds; None where the questions cannot show that objects differ."""
    p: float | None
    """Of the sign-flip test over objects, on means over seeds; None likewise. Several are looked at: see `holm`."""
    detectable: float | None
    """The smallest true effect that the design would find, as of every paired difference; None likewise."""
    questions: int
    seeds: int
    cells: int
    """Settings whose answers are compared."""


@dataclass(frozen=True)
class _Contrast:
    found: Difference
    questions: int
    seeds: int
    cells: int


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
            contrast = _contrast(cells, _signs(cells, places, pairs), seed)
            if contrast:
                names = tuple(factors[i].name for i in places)
                effects.append(_effect(contrast, names, tuple(f"{b} minus {a}" for a, b in pairs)))
    return effects


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


def _contrast(cells: Mapping[Levels, Cell], signs: Signs, seed: int) -> _Contrast | None:
    """The contrast scaled to -1 to 1; None where its cells have no seed or question in common."""
    seeds = sorted(set.intersection(*({s for s, _ in cells[c]} for c in signs))) if signs else []
    asked = [{q for s, q in cells[c] if s == one} for c in signs for one in seeds]
    about = {q: a.objects for c in signs for (_, q), a in cells[c].items()}
    questions = sorted(set.intersection(*asked), key=lambda q: (about[q], q)) if asked else []
    if not questions:
        return None
    # Half of the cells count 1, half -1: divided by half their number even an interaction lies from -1 to 1, as every
    # paired difference does.
    half = len(signs) / 2
    rows = [[sum(n * cells[c][s, q].correct for c, n in signs.items()) / half for q in questions] for s in seeds]
    found = difference(rows, tuple(about[q] for q in questions), seed)
    return _Contrast(found, len(questions), len(seeds), len(signs))


def _effect(contrast: _Contrast, factors: tuple[str, ...], changes: tuple[str, ...]) -> FactorialEffect:
    found, scale = contrast.found, len(factors)
    ends = found.interval
    return FactorialEffect(
        factors=factors,
        changes=changes,
        value=scale * found.value,
        interval=Interval(scale * ends.low, scale * ends.high) if ends else None,
        p=found.p,
        detectable=None if found.detectable is None else scale * found.detectable,
        questions=contrast.questions,
        seeds=contrast.seeds,
        cells=contrast.cells,
    )
