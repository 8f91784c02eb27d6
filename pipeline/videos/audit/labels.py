"""Checks of the labels: the ratings against what the publishers state, print and describe; classes of the splits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from statistics import fmean

from pipeline.core.records import Part
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.catalogue.wording import levels_named
from pipeline.videos.records import Finding, Severity, finding

TINY = 1e-12
"""Variances up to it are rounding."""


def check_labels(catalogue: Catalogue) -> Iterator[Finding]:
    """All checks of this module; none needs a video."""
    objects = catalogue.objects.values()
    for place, prop in enumerate(catalogue.properties):
        ratings = [o.ratings[place] for o in objects]
        as_many = len({len(r) for r in ratings}) == 1
        found = icc3k(ratings) if as_many else None
        if found is None:
            why = "one rating, or no variance" if as_many else "objects have different numbers of ratings"
            yield finding("agreement, ICC(3,k)", prop.name, f"undefined: {why}")
            continue
        value, low, high = found
        yield finding("agreement, ICC(3,k)", prop.name, f"{value:.3f} ({low:.3f} to {high:.3f})")
        disputed = sum(len(set(r)) > 1 for r in ratings)
        yield finding("disputed ratings", prop.name, f"{disputed} of {len(ratings)} objects")
    for place, prop in enumerate(catalogue.properties):
        counts = Counter(o.labels[place] for o in objects)
        for level, name in enumerate(prop.levels):
            severity = Severity.INFO if counts[level] else Severity.WARNING
            yield finding("objects of a class", f"{prop.name}: {name}", str(counts[level]), "", severity)
    differing, contradicting = [], []
    for o in objects:
        for prop, stated, label, rated in zip(catalogue.properties, o.stated, o.labels, o.ratings, strict=True):
            where, name = f"{o.object_id}: {prop.name}", prop.levels[label]
            if stated not in (None, label):
                measured = f"{name} (mean rating {fmean(rated):.2f})"
                differing.append(finding("stated label", where, measured, prop.levels[stated], Severity.WARNING))
            named = levels_named(o.description, prop)
            if named and label not in named:
                measured = f"rated {name} ({' '.join(map(str, rated))})"
                expected = "described as " + " or ".join(prop.levels[level] for level in sorted(named))
                contradicting.append(finding("description", where, measured, expected, Severity.WARNING))
    yield from (*differing, *contradicting)
    yield from _splits(catalogue)


def icc3k(ratings: Sequence[Sequence[float]]) -> tuple[float, float, float] | None:
    """Agreement of the mean of k raters and its 95 % interval: two-way mixed, consistency (Shrout and Fleiss 1979).

    Written out: pingouin's `intraclass_corr` rounds the interval to two places, and importing it takes longer than the
    whole audit of the labels.

    Args:
        ratings: Targets x raters, all rows of equal length.

    Returns:
        Value, low and high, each at most 1; None for fewer than two targets or raters, or targets that do not differ.
    """
    import numpy as np
    from scipy.stats import f

    table = np.array(ratings, dtype=np.float64)
    if table.ndim != 2 or min(table.shape) < 2:
        return None
    targets, raters = table.shape
    free = (targets - 1, (targets - 1) * (raters - 1))
    between = float(raters * table.mean(axis=1).var(ddof=1))
    rest = table - table.mean(axis=1, keepdims=True) - table.mean(axis=0) + table.mean()
    if between <= TINY:
        return None
    unlike = float((rest**2).sum()) / free[1] / between
    low, high = (1 - unlike * float(f.ppf(tail, *free)) for tail in (0.975, 0.025))
    return 1 - unlike, low, high


def _splits(catalogue: Catalogue) -> Iterator[Finding]:
    """Where the catalogue's splits disagree, and parts that lack a class."""
    names, objects = catalogue.split_names, catalogue.objects.values()
    for name, o in product(names[1:], objects):
        one, other = o.splits[names[0]], o.splits[name]
        if one != other:
            yield finding("splits differ", o.object_id, f"{one} in {names[0]}", f"{other} in {name}")
    for name, part in product(names, (Part.TRAIN, Part.VALIDATION, Part.TEST)):
        members = [o for o in objects if o.splits[name] == part]
        for place, prop in enumerate(catalogue.properties):
            there = {o.labels[place] for o in members}
            lacking = " or ".join(word for level, word in enumerate(prop.levels) if level not in there)
            if members and lacking:
                where = f"{name}, {part}: {prop.name}"
                yield finding("classes of a part", where, f"no {lacking}", "all", Severity.WARNING)
