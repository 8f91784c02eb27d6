"""The paper's tables about its data set: property counts, combinations, video lengths, annotator agreement."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import fmean, median

from pipeline.records import Part
from pipeline.reporting.inputs import Inputs, no_test_videos
from pipeline.reporting.table import Table, number
from pipeline.statistics import confusion, icc3k

OF_PAPER = (
    " The paper's printed counts do not follow from its own printed ratings.",
    "; the published ones are of the real videos",
    " that the paper prints",
)
"""What captions add (counts, lengths, ratings) where the paper's figures stand beside the measured ones."""
MOST_COMBINATIONS = 256
"""Up to so many combinations of classes the table lists all of them, beyond only those that an object has."""


@dataclass(frozen=True)
class CountRow:
    """Objects of one class of one property."""

    property: str
    level: str
    objects: int
    percent: float
    with_videos: int
    train: int
    validation: int
    test: int
    published: float | None
    published_percent: float | None

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Property": self.property,
            "Class": self.level,
            "Objects": str(self.objects),
            "%": number(self.percent),
            "With videos": str(self.with_videos),
            "Train": str(self.train),
            "Validation": str(self.validation),
            "Test": str(self.test),
            "Published": number(self.published, 0),
            "Published %": number(self.published_percent),
        }


@dataclass(frozen=True)
class CombinationRow:
    """Objects of one combination of classes."""

    combination: str
    objects: int
    with_videos: int
    published: float | None

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Combination": self.combination,
            "Objects": str(self.objects),
            "With videos": str(self.with_videos),
            "Published": number(self.published, 0),
        }


@dataclass(frozen=True)
class FigureRow:
    """One figure of the data set beside the paper's."""

    row: str
    value: float | None
    n: int
    unit: str
    published: float | None
    published_n: int | None
    note: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        digits = 3 if self.unit == "ICC(3,k)" else 2
        return {
            "": self.row,
            f"Measured ({self.unit})": number(self.value, digits),
            "n": str(self.n),
            "Published": number(self.published, digits),
            "Published n": "" if self.published_n is None else str(self.published_n),
            "Note": self.note,
        }


@dataclass(frozen=True)
class ConfusionRow:
    """How often the fine-tuned encoder's heads took one class for another."""

    property: str
    expected: str
    predicted: str
    videos: int | None
    note: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        count = "" if self.videos is None else str(self.videos)
        columns = {"Property": self.property, "Rated": self.expected, "Predicted": self.predicted, "Videos": count}
        return {**columns, "Note": self.note}


def dataset_tables(inputs: Inputs) -> list[Table]:
    """All tables of this module."""
    counts, lengths, ratings = OF_PAPER if inputs.of_paper else ("", "", " in objects.csv")
    return [
        Table(
            "property_counts",
            "Property categories",
            f"Objects a class: the rounded mean of the annotators' ratings, over the whole catalogue.{counts}",
            _counts(inputs),
        ),
        Table(
            "property_combinations",
            "Property combinations",
            "Objects a combination of classes, from the same ratings.",
            _combinations(inputs),
        ),
        Table(
            "video_lengths",
            "Video lengths",
            f"Frames that really decode, over the videos of this run{lengths}.",
            _lengths(inputs),
        ),
        Table(
            "annotator_agreement",
            "Annotator agreement",
            f"ICC(3,k), recomputed from the ratings{ratings}; n: objects.",
            _agreement(inputs),
        ),
        Table(
            "confusion_matrices",
            "Confusion of the fine-tuned encoder's heads",
            "The figures behind the picture: test videos by rated and predicted class, summed over seeds.",
            _confusions(inputs),
        ),
    ]


def confusion_counts(inputs: Inputs, name: str) -> tuple[tuple[int, ...], ...]:
    """Counts of one property over test videos and seeds: rated (rows) by predicted class."""
    index = inputs.catalogue.property_index(name)
    judged = [c for records in inputs.classifications.values() for c in records if c.property == name]
    classes = len(inputs.catalogue.properties[index].levels)
    return confusion([c.expected for c in judged], [c.predicted for c in judged], classes)


def _counts(inputs: Inputs) -> list[CountRow]:
    catalogue = inputs.catalogue
    present = {v.object_id for v in inputs.videos}
    parts = {a.object_id: a.part for a in inputs.assignments}
    rows = []
    for index, p in enumerate(catalogue.properties):
        for level, name in enumerate(p.levels):
            members = [o for o in catalogue.objects if catalogue.labels(o)[index] == level]
            of_part = Counter(parts.get(o) for o in members)
            count, percent = (inputs.published("property_counts", name, what) for what in ("count", "percent"))
            rows.append(
                CountRow(
                    property=p.name,
                    level=name,
                    objects=len(members),
                    percent=100 * len(members) / len(catalogue.objects),
                    with_videos=len(present.intersection(members)),
                    train=of_part[Part.TRAIN],
                    validation=of_part[Part.VALIDATION],
                    test=of_part[Part.TEST],
                    published=count.value if count else None,
                    published_percent=percent.value if percent else None,
                )
            )
    return rows


def _combinations(inputs: Inputs) -> list[CombinationRow]:
    catalogue = inputs.catalogue
    present = {v.object_id for v in inputs.videos}
    every = Counter(map(catalogue.labels, catalogue.objects))
    filmed = Counter(catalogue.labels(o) for o in catalogue.objects if o in present)
    rows = []
    # With many properties most combinations have no object, and a row each would bury the others.
    few = math.prod(len(p.levels) for p in catalogue.properties) <= MOST_COMBINATIONS
    possible = itertools.product(*(range(len(p.levels)) for p in catalogue.properties))
    for levels in possible if few else sorted(every):
        words = ", ".join(p.levels[level] for p, level in zip(catalogue.properties, levels, strict=True))
        printed = inputs.published("property_combinations", words, "count")
        rows.append(CombinationRow(words, every[levels], filmed[levels], printed.value if printed else None))
    return rows


def _lengths(inputs: Inputs) -> list[FigureRow]:
    lengths = [v.frames for v in inputs.videos]
    values = {
        "average": fmean(lengths),
        "median": float(median(lengths)),
        "minimum": float(min(lengths)),
        "maximum": float(max(lengths)),
    }
    return [
        _figure(inputs, "video_lengths", row, "frames", value, len(lengths), "frames") for row, value in values.items()
    ]


def _agreement(inputs: Inputs) -> list[FigureRow]:
    objects = inputs.catalogue.objects.values()
    rows = []
    for index, name in enumerate(inputs.catalogue.property_names):
        raters = {len(o.ratings[index]) for o in objects}
        # A mean over raters that are not the same for all objects has no two-way model.
        value = icc3k([o.ratings[index] for o in objects]) if len(raters) == 1 else None
        note = (
            "" if value is not None else "undefined: objects differ in their number of ratings, or not in their ratings"
        )
        rows.append(_figure(inputs, "annotator_agreement", name, "icc3k", value, len(objects), "ICC(3,k)", note))
    return rows


def _confusions(inputs: Inputs) -> list[ConfusionRow]:
    judged = any(inputs.classifications.values())
    note = "" if judged else no_test_videos(inputs) if not inputs.test_objects else "no encoder was fine-tuned"
    return [
        ConfusionRow(p.name, rated, predicted, count if judged else None, note)
        for p in inputs.catalogue.properties
        for rated, counts in zip(p.levels, confusion_counts(inputs, p.name), strict=True)
        for predicted, count in zip(p.levels, counts, strict=True)
    ]


def _figure(
    inputs: Inputs, table: str, row: str, system: str, value: float | None, n: int, unit: str, note: str = ""
) -> FigureRow:
    printed = inputs.published(table, row, system)
    return FigureRow(row, value, n, unit, printed.value if printed else None, printed.n if printed else None, note)
