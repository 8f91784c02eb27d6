"""Did accuracies change, or only answers? Each variant against itself, on the questions that both states asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.comparison.cached import (
    Cache,
    Graded,
    NotCachedError,
    questions_hash,
    read_questions,
    read_scores,
    score_hashes,
)
from pipeline.comparison.locked import Locked
from pipeline.records import WHOLE
from pipeline.statistics import Outcome, holm, paired


@dataclass(frozen=True)
class Accuracy:
    """One task of one variant in both states; shares from 0 to 1, on the same questions."""

    variant: str
    task: str
    old: float
    new: float
    difference: float
    """How much the accuracy rose."""
    n: int
    """Questions that both answered."""
    left_out: int
    """Questions that only one of the two has, or that mean another video or answer by the same id."""
    changed: int
    """Questions that one of the two alone got right."""
    low: float | None
    """Of the 95 % interval of the difference, clustered by object; None where questions cannot show it."""
    high: float | None
    p: float | None
    """Sign flip over objects."""
    p_holm: float | None
    """Holm's adjustment over all tests of the comparison."""
    mcnemar: float | None
    """Exact, as if questions were independent: to be read beside `p` only."""
    detectable: float | None
    """The smallest true difference that such a comparison finds in four of five."""


@dataclass(frozen=True)
class Tested:
    """What the scores say."""

    accuracies: tuple[Accuracy, ...]
    same: tuple[str, ...]
    """Variants whose scores have the same hash: every question went as before."""
    notes: tuple[str, ...]
    """What could not be compared, a line each."""


def tested_accuracies(
    old: Mapping[str, Locked], new: Mapping[str, Locked], names: tuple[str, str], cache: Cache
) -> Tested:
    """Compare the accuracies of all variants that both states have and whose scores differ.

    The family of tests is these variants by tasks. Where a hash is the same there is nothing to test.

    Raises:
        UserError: where scores or questions in the cache are broken.
    """
    before, after = score_hashes(old), score_hashes(new)
    both = [variant for variant in after if variant in before]
    moved = [variant for variant in both if before[variant] != after[variant]]
    reader = _Reader(cache, names, [])
    asked = reader.same_questions(questions_hash(old), questions_hash(new)) if moved else None
    rows: list[Accuracy] = []
    for variant in moved:
        one, other = reader.scores(before[variant], variant, 0), reader.scores(after[variant], variant, 1)
        if one is not None and other is not None:
            rows += _accuracies(variant, one, other, asked)
    tested = [row for row in rows if row.p is not None]
    adjusted = dict(zip(map(id, tested), holm([row.p for row in tested if row.p is not None]), strict=True))
    return Tested(
        tuple(replace(row, p_holm=adjusted.get(id(row))) for row in rows),
        tuple(variant for variant in both if variant not in moved),
        (*reader.notes, *reader.missing()),
    )


@dataclass
class _Reader:
    cache: Cache
    names: tuple[str, str]
    notes: list[str]

    def __post_init__(self) -> None:
        self._lacks: tuple[list[str], list[str]] = ([], [])

    def scores(self, oid: str, variant: str, side: int) -> list[Graded] | None:
        try:
            return read_scores(self.cache, oid, f"{variant} of {self.names[side]}")
        except NotCachedError:
            self._lacks[side].append(variant)
            return None

    def same_questions(self, old: str, new: str) -> frozenset[str] | None:
        """The ids that mean the same question in both; None where all do, or where scores alone must tell."""
        if old == new:
            return None
        try:
            one, other = (
                read_questions(self.cache, oid, name) for oid, name in zip((old, new), self.names, strict=True)
            )
        except NotCachedError:
            self.notes.append(
                "the questions differ and DVC's cache lacks them: ids whose objects and right answer agree are compared"
            )
            return None
        same = frozenset(id for id in one.keys() & other.keys() if one[id] == other[id])
        self.notes.append(
            f"the questions differ: {len(one)} before, {len(other)} now; the {len(same)} that are the same are compared"
        )
        return same

    def missing(self) -> list[str]:
        return [
            f"DVC's cache lacks the scores of {len(lacks)} variants of {name} ({lacks[0]} first): "
            "the paired test needs `dvc pull`, or `dvc repro` at that revision"
            for name, lacks in zip(self.names, self._lacks, strict=True)
            if lacks
        ]


def _accuracies(
    variant: str, old: Sequence[Graded], new: Sequence[Graded], asked: frozenset[str] | None
) -> list[Accuracy]:
    found = []
    for task in dict.fromkeys(score.task for score in new):
        before, after = _by_question(old, task), _by_question(new, task)
        common = [
            id
            for id in sorted(before.keys() & after.keys())
            if (asked is None or id in asked)
            and (before[id].expected, before[id].objects) == (after[id].expected, after[id].objects)
        ]
        if common:
            every = len(before.keys() | after.keys())
            found.append(_accuracy(variant, task, [(before[id], after[id]) for id in common], every - len(common)))
    return found


def _accuracy(variant: str, task: str, pairs: Sequence[tuple[Graded, Graded]], left_out: int) -> Accuracy:
    gap = paired([Outcome(after.correct - before.correct, after.objects) for before, after in pairs])
    return Accuracy(
        variant=variant,
        task=task,
        old=sum(before.correct for before, _ in pairs) / len(pairs),
        new=sum(after.correct for _, after in pairs) / len(pairs),
        difference=gap.value,
        n=len(pairs),
        left_out=left_out,
        changed=sum(before.correct != after.correct for before, after in pairs),
        low=gap.interval.low if gap.interval else None,
        high=gap.interval.high if gap.interval else None,
        p=gap.p,
        p_holm=None,
        mcnemar=gap.mcnemar,
        detectable=gap.detectable,
    )


def _by_question(scores: Sequence[Graded], task: str) -> dict[str, Graded]:
    return {score.question: score for score in scores if score.task == task and score.measure in WHOLE}
