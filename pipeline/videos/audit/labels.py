"""Checks of the labels: recomputed from the ratings, beside what the publishers state, print and write of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from statistics import fmean

from pipeline.records import Finding, Part, Severity
from pipeline.statistics import icc3k, icc3k_interval
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.wording import contradiction


def check_labels(catalogue: Catalogue) -> Iterator[Finding]:
    """All checks of this module; none needs a video."""
    yield from _agreement(catalogue)
    yield from _counts(catalogue)
    yield from _stated(catalogue)
    yield from _descriptions(catalogue)
    yield from _splits(catalogue)


def similar_names(unknown: Sequence[str], catalogue: Catalogue) -> Iterator[Finding]:
    """Objects of the folder that the catalogue lacks, but nearly has."""
    for name in unknown:
        close = get_close_matches(name, catalogue.objects, n=1, cutoff=0.9)
        if close:
            yield _warning("spelling", name, "not in the catalogue", f"{close[0]}?")


def _agreement(catalogue: Catalogue) -> Iterator[Finding]:
    for place, prop in enumerate(catalogue.properties):
        ratings = [o.ratings[place] for o in catalogue.objects.values()]
        if len({len(r) for r in ratings}) > 1:
            measured = "undefined: objects have different numbers of ratings"
            yield _info("agreement, ICC(3,k)", prop.name, measured)
            continue
        value, interval = icc3k(ratings), icc3k_interval(ratings)
        if value is None or interval is None:
            yield _info("agreement, ICC(3,k)", prop.name, "undefined: one rating, or no variance")
            continue
        measured = f"{value:.3f} ({interval.low:.3f} to {interval.high:.3f})"
        yield _info("agreement, ICC(3,k)", prop.name, measured)
        disputed = sum(len(set(r)) > 1 for r in ratings)
        yield _info("disputed ratings", prop.name, f"{disputed} of {len(ratings)} objects")


def _counts(catalogue: Catalogue) -> Iterator[Finding]:
    for place, prop in enumerate(catalogue.properties):
        counts = Counter(o.labels[place] for o in catalogue.objects.values())
        for level, name in enumerate(prop.levels):
            tell = _info if counts[level] else _warning
            yield tell("objects of a class", f"{prop.name}: {name}", str(counts[level]))


def _stated(catalogue: Catalogue) -> Iterator[Finding]:
    for o in catalogue.objects.values():
        for place, stated in enumerate(o.stated):
            if stated is not None and stated != o.labels[place]:
                prop, ratings = catalogue.properties[place], o.ratings[place]
                measured = f"{prop.levels[o.labels[place]]} (mean rating {fmean(ratings):.2f})"
                yield _warning("stated label", f"{o.object_id}: {prop.name}", measured, prop.levels[stated])


def _descriptions(catalogue: Catalogue) -> Iterator[Finding]:
    for o in catalogue.objects.values():
        for prop, label, ratings in zip(catalogue.properties, o.labels, o.ratings, strict=True):
            named = contradiction(o.description, prop, label)
            if named:
                words = " or ".join(prop.levels[level] for level in sorted(named))
                measured = f"rated {prop.levels[label]} ({' '.join(map(str, ratings))})"
                yield _warning("description", f"{o.object_id}: {prop.name}", measured, f"described as {words}")


def _splits(catalogue: Catalogue) -> Iterator[Finding]:
    """Where the catalogue's splits disagree, and parts that lack a class."""
    names = list(dict.fromkeys(name for o in catalogue.objects.values() for name in o.splits))
    for name in names[1:]:
        for o in catalogue.objects.values():
            one, other = o.splits[names[0]], o.splits[name]
            if one != other:
                yield _info("splits differ", o.object_id, f"{one} in {names[0]}", f"{other} in {name}")
    for name in names:
        for part in (Part.TRAIN, Part.VALIDATION, Part.TEST):
            members = [o for o in catalogue.objects.values() if o.splits[name] == part]
            for place, prop in enumerate(catalogue.properties):
                there = {o.labels[place] for o in members}
                lacking = [word for level, word in enumerate(prop.levels) if level not in there]
                if members and lacking:
                    yield _warning(
                        "classes of a part", f"{name}, {part}: {prop.name}", f"no {' or '.join(lacking)}", "all"
                    )


def _info(check: str, item: str, measured: str, expected: str = "") -> Finding:
    return Finding(check=check, item=item, measured=measured, expected=expected, severity=Severity.INFO)


def _warning(check: str, item: str, measured: str, expected: str = "") -> Finding:
    return Finding(check=check, item=item, measured=measured, expected=expected, severity=Severity.WARNING)
