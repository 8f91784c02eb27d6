"""How far off encoders are: classes of a property have an order, and one class off is less wrong than two."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from pipeline.core.records import Optional, OutOfFold, Record, Share
from pipeline.videos.catalogue import Catalogue


class ErrorRow(Record):
    """How far one encoder is off in one property, pooled over the repeats of a cross-validation."""

    encoder: str
    property: str
    absolute_error: Share
    """Mean distance of the predicted from the expected class, in classes."""
    kappa: Optional = None
    """Quadratically weighted (Cohen 1968); None where all is expected and predicted as one class."""
    n: int
    """Videos."""


def error_rows(out_of_fold: Mapping[str, Iterable[OutOfFold]], catalogue: Catalogue) -> list[ErrorRow]:
    """A row for each candidate and property."""
    rows = []
    for name, records in out_of_fold.items():
        found = list(records)
        for place, prop in enumerate(catalogue.properties):
            expected, predicted = ([getattr(r, side)[place] for r in found] for side in ("expected", "predicted"))
            rows.append(
                ErrorRow(
                    encoder=name,
                    property=prop.name,
                    absolute_error=float(np.abs(np.subtract(expected, predicted)).mean()),
                    kappa=quadratic_kappa(expected, predicted, len(prop.levels)),
                    n=len({r.video_id for r in found}),
                )
            )
    return rows


def quadratic_kappa(expected: Sequence[int], predicted: Sequence[int], classes: int) -> float | None:
    """1 - (mean squared distance) / (the same if both were paired at random); None where the latter is 0."""
    if len({*expected, *predicted}) < 2:
        return None
    from sklearn.metrics import cohen_kappa_score

    return float(cohen_kappa_score(expected, predicted, weights="quadratic", labels=range(classes)))
