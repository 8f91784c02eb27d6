"""The report's tables about encoders and their rivals, cross-validated over all objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.encoder.baseline.validation import Summary, Verdict, collect, compare, summarise
from pipeline.encoder.candidates import CONTESTANTS
from pipeline.videos.catalogue import Catalogue
from pipeline.records import Judged
from pipeline.reporting.table import Table, number, share_span
from pipeline.statistics import Interval

FOLDER = "encoder"
"""Of these tables, below the report's."""
RIVAL = "trees"
"""What every model that is no variation of another is compared with."""


@dataclass(frozen=True)
class AccuracyRow:
    """How often one model is right about objects that it has never touched. Shares, from 0 to 1."""

    model: str
    property: str
    """`combined`: all properties of a video right."""
    accuracy: float
    low: float | None
    """Of the object-clustered 95 % interval."""
    high: float | None
    n: int
    """Videos, each of which counts with the share of the repeats in which the model is right."""
    ms_per_video: float | None
    """Measured by `make bench SECTION=encoder`, decoding included, on one core."""

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Model": self.model,
            "What it is": CONTESTANTS[self.model].title if self.property == COMBINED else "",
            "Property": self.property,
            "Accuracy %": number(100 * self.accuracy, 1),
            "95 % over objects": share_span(self.low, self.high),
            "n": str(self.n),
            "ms a video": number(self.ms_per_video, 1),
        }


@dataclass(frozen=True)
class ErrorRow:
    """How far off one model is, where classes have an order."""

    model: str
    property: str
    absolute_error: float
    kappa: float | None
    majority: float
    chance: float
    repeats: int
    spread: float | None
    """Standard deviation of the accuracy over the repeats."""

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Model": self.model,
            "Property": self.property,
            "Mean absolute error": number(self.absolute_error, 3),
            "Kappa": number(self.kappa, 3),
            "Best constant %": number(100 * self.majority, 1),
            "Chance %": number(100 * self.chance, 1),
            "Over repeats": "" if self.spread is None else f"± {100 * self.spread:.1f}",
        }


@dataclass(frozen=True)
class DifferenceRow:
    """Combined accuracy of a model less that of another, on the same videos and folds."""

    model: str
    what: str
    against: str
    difference: float
    low: float | None
    high: float | None

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Model": self.model,
            "What it is": self.what,
            "Against": self.against,
            "Difference": f"{100 * self.difference:+.1f}",
            "95 % over objects": share_span(self.low, self.high),
        }


@dataclass(frozen=True)
class AgreementRow:
    """Accuracy among the videos whose object the annotators rated alike in all properties, or not."""

    model: str
    ratings: str
    accuracy: float
    low: float | None
    high: float | None
    videos: int
    objects: int

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Model": self.model,
            "Ratings": self.ratings,
            "Accuracy %": number(100 * self.accuracy, 1),
            "95 % over objects": share_span(self.low, self.high),
            "Videos": str(self.videos),
            "Objects": str(self.objects),
        }


@dataclass(frozen=True)
class CurveRow:
    """Combined accuracy after learning from so many objects."""

    model: str
    objects: float
    """Training objects, on average over folds."""
    accuracy: float
    low: float | None
    high: float | None

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Model": self.model,
            "Training objects": number(self.objects, 0),
            "Accuracy %": number(100 * self.accuracy, 1),
            "95 % over objects": share_span(self.low, self.high),
        }


def encoder_tables(
    judged: Mapping[str, Sequence[Judged]], catalogue: Catalogue, costs: Mapping[str, float], folds: int
) -> list[Table]:
    """All tables; none where nothing was cross-validated.

    Args:
        judged: By model.
        costs: Milliseconds a video by model, where they were measured.
        folds: Of the cross-validation.
    """
    if not judged:
        return []
    classes = [len(p.levels) for p in catalogue.properties]
    verdicts = {name: collect(records) for name, records in judged.items()}
    summaries = {name: summarise(v, classes) for name, v in verdicts.items()}
    some = next(iter(summaries.values()))
    repeats = len(some.combined.spread.values)
    setting = (
        f"{some.videos} videos of {some.objects} objects, {folds} folds of objects, dealt {repeats} time"
        f"{'s' * (repeats > 1)}; settings are chosen inside the training folds."
    )
    accuracies = [row for name, s in summaries.items() for row in _accuracies(name, s, catalogue, costs.get(name))]
    agreement = [row for name in verdicts for row in _agreement(name, verdicts[name], catalogue, classes)]
    tables = [
        Table(
            "cross_validation",
            "Encoders over all objects",
            f"Grouped cross-validation: {setting}",
            accuracies,
            [row for row in accuracies if row.property == COMBINED or row.model in HEADLINE],
            folder="",
        ),
        Table(
            "differences",
            "Encoders compared",
            "Combined accuracy on the same videos by the same folds, in percentage points. Parts of a model are "
            "compared with it, models of their own with the baseline.",
            _differences(verdicts),
            folder="",
        ),
        Table(
            "errors",
            "How far off encoders are",
            "Mean distance between predicted and rated class, quadratically weighted kappa, and what the best constant "
            "answer and even guessing reach.",
            [row for name, s in summaries.items() for row in _errors(name, s, catalogue)],
            [row for name, s in summaries.items() if name in HEADLINE for row in _errors(name, s, catalogue)],
            folder="",
        ),
        Table(
            "agreement",
            "Where annotators agree and where they do not",
            "Combined accuracy among videos of objects on which all annotators gave the same rating in every property, "
            "and among the others.",
            agreement,
            [row for row in agreement if row.model in HEADLINE],
            folder="",
        ),
    ]
    curve = _curve(summaries, folds)
    if len(curve) > 1:
        tables.append(
            Table(
                "learning_curve",
                "What more objects would bring",
                "The strong recipe after learning from only some of the training objects of each fold.",
                curve,
                folder="",
            )
        )
    return [table for table in tables if table.rows]


COMBINED = "combined"
HEADLINE = tuple(name for name, contestant in CONTESTANTS.items() if not contestant.parent)
"""Models of their own: the page shows every property of them, and of others only the combined accuracy."""


def _accuracies(name: str, summary: Summary, catalogue: Catalogue, cost: float | None) -> list[AccuracyRow]:
    measured = {COMBINED: summary.combined} | {
        p.name: s.accuracy for p, s in zip(catalogue.properties, summary.properties, strict=True)
    }
    return [AccuracyRow(name, what, a.value, *_ends(a.interval), summary.videos, cost) for what, a in measured.items()]


def _errors(name: str, summary: Summary, catalogue: Catalogue) -> list[ErrorRow]:
    return [
        ErrorRow(
            model=name,
            property=p.name,
            absolute_error=s.absolute_error,
            kappa=s.kappa,
            majority=s.accuracy.majority,
            chance=s.accuracy.chance,
            repeats=len(s.accuracy.spread.values),
            spread=s.accuracy.spread.deviation,
        )
        for p, s in zip(catalogue.properties, summary.properties, strict=True)
    ]


def _differences(verdicts: Mapping[str, Sequence[Verdict]]) -> list[DifferenceRow]:
    rows = []
    for name, own in verdicts.items():
        against = CONTESTANTS[name].parent or RIVAL
        if against in verdicts and against != name:
            gap = compare(verdicts[against], own)
            rows.append(DifferenceRow(name, CONTESTANTS[name].title, against, gap.value, *_ends(gap.interval)))
    return rows


def _agreement(
    name: str, verdicts: Sequence[Verdict], catalogue: Catalogue, classes: Sequence[int]
) -> list[AgreementRow]:
    rows = []
    for ratings, wanted in (("unanimous", True), ("disputed", False)):
        some = [v for v in verdicts if _unanimous(catalogue, v.object_id) == wanted]
        if some:
            summary = summarise(some, classes)
            combined = summary.combined
            rows.append(
                AgreementRow(name, ratings, combined.value, *_ends(combined.interval), summary.videos, summary.objects)
            )
    return rows


def _unanimous(catalogue: Catalogue, object_id: str) -> bool:
    return all(len(set(ratings)) == 1 for ratings in catalogue.objects[object_id].ratings)


def _curve(summaries: Mapping[str, Summary], folds: int) -> list[CurveRow]:
    rows = []
    for name, summary in summaries.items():
        contestant, all_of_them = CONTESTANTS[name], summary.objects * (folds - 1) / folds
        if name == "strong" or contestant.objects:
            combined = summary.combined
            rows.append(
                CurveRow(
                    name, min(contestant.objects or all_of_them, all_of_them), combined.value, *_ends(combined.interval)
                )
            )
    return sorted(rows, key=lambda row: row.objects)


def _ends(interval: Interval | None) -> tuple[float | None, float | None]:
    return (interval.low, interval.high) if interval else (None, None)
