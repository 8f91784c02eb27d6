"""Calibration of the property heads' probabilities: temperature scaling, reliability, expected calibration error.

Guo et al. 2017, "On Calibration of Modern Neural Networks" (arXiv 1706.04599).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from pipeline.core.records import Classification, Optional, Part, Record, Share
from pipeline.core.runtime import derive_seed

Floats = npt.NDArray[np.float64]

BINS = 10
RANGE = (0.05, 20.0)
"""Temperatures to search: beyond them probabilities are all but one-hot, or uniform."""
PRIOR = 2.0
"""Standard deviation of the prior on the temperature, as a factor."""
SMALLEST = 1e-12
"""Lower bound of a probability before its logarithm is taken."""
DRAWS = 1000
"""Bootstrap samples."""


class CalibrationRow(Record):
    """Calibration of one property's probabilities: of all answers, or of those in one bin of confidence."""

    property: str
    probability: str
    """The bin of the likeliest class's probability, or "all"."""
    n: int
    mean_probability: Share
    right: Share
    """Share of answers whose likeliest class is the rated one."""
    error: Share
    """|right - mean probability| of a bin; of all, the expected calibration error."""
    low: Optional = None
    high: Optional = None
    without_temperature: Optional = None
    """The expected calibration error of the probabilities as the heads give them."""


def rescale(probabilities: npt.ArrayLike, temperature: float) -> Floats:
    """Softmax of log(probabilities) / temperature over the last axis; 1 leaves them as they are."""
    from scipy.special import softmax

    logits = np.log(np.maximum(np.asarray(probabilities, np.float64), SMALLEST)) / temperature
    scaled: Floats = softmax(logits, axis=-1)
    return scaled


def fit_temperature(classified: Sequence[Classification]) -> float:
    """The temperature that makes the expected classes of one property likeliest; 1 where there are none to fit it on.

    It is fitted on videos that nothing was trained on. Those of one object are alike, so each object counts once, by
    its videos' mean. With few objects the data say little, so the temperature's logarithm has a normal prior of mean 0
    and deviation log(`PRIOR`).
    """
    from scipy.optimize import minimize_scalar

    if not classified:
        return 1.0
    probabilities = np.array([c.probabilities for c in classified])
    expected = np.array([c.expected for c in classified])
    objects = Counter(c.object_id for c in classified)
    weights = np.array([1 / objects[c.object_id] for c in classified])

    def loss(log_temperature: float) -> float:
        scaled = rescale(probabilities, float(np.exp(log_temperature)))
        missed = -np.log(np.maximum(scaled[np.arange(len(expected)), expected], SMALLEST))
        return float(weights @ missed) + (log_temperature / math.log(PRIOR)) ** 2 / 2

    # Over the logarithm, in which halving and doubling a temperature are equally far.
    found = minimize_scalar(loss, bounds=np.log(RANGE), method="bounded", options={"xatol": 1e-5})
    return float(np.exp(found.x))


def _binned(classified: Sequence[Classification]) -> pd.DataFrame:
    """A row an answer: its object, the probability of the likeliest class, whether that is the rated one, its bin."""
    probabilities = np.array([c.probabilities for c in classified])
    right = probabilities.argmax(axis=1) == [c.expected for c in classified]
    table = pd.DataFrame({"mean_probability": probabilities.max(axis=1), "right": right.astype(float)})
    # A border belongs to the bin below it.
    bins = np.clip(np.ceil(table["mean_probability"] * BINS).astype(int) - 1, 0, BINS - 1)
    return table.assign(bin=bins, object_id=[c.object_id for c in classified])


def reliability(classified: Sequence[Classification]) -> pd.DataFrame:
    """Answers of like confidence: `BINS` bins of equal width, by number from 0, of which empty ones are left out.

    Returns:
        Columns `n`, `mean_probability` of the likeliest class, and `right`, the share where it is the rated one.
    """
    table = _binned(classified)
    bins = table.groupby("bin")[["mean_probability", "right"]].mean()
    return bins.assign(n=table["bin"].value_counts())


def calibrated(classified: Sequence[Classification]) -> Iterator[tuple[Classification, Classification]]:
    """One encoder's classifications of test videos, before and after scaling by a temperature that is fitted to its
    validation videos, property by property."""
    for name in dict.fromkeys(c.property for c in classified):
        mine = [c for c in classified if c.property == name]
        temperature = fit_temperature([c for c in mine if c.part is Part.VALIDATION])
        for c in mine:
            if c.part is Part.TEST:
                yield c, c.model_copy(update={"probabilities": tuple(rescale(c.probabilities, temperature).tolist())})


def calibration_rows(encoders: Sequence[Sequence[Classification]]) -> list[CalibrationRow]:
    """Test videos of all encoders together, by property: a row for all of them, then one a bin.

    `encoders` holds the classifications of validation and test videos by each.
    """
    pairs = [pair for classified in encoders for pair in calibrated(classified)]
    rows = []
    for name in dict.fromkeys(before.property for before, _ in pairs):
        given, answers = zip(*(pair for pair in pairs if pair[0].property == name), strict=True)
        bins = reliability(answers)
        low, high = error_interval(answers)
        whole = {column: np.average(bins[column], weights=bins["n"]) for column in ("mean_probability", "right")}
        whole |= {"n": len(answers), "error": calibration_error(answers), "low": low, "high": high}
        whole |= {"without_temperature": calibration_error(given)}
        rows.append(CalibrationRow(property=name, probability="all", **whole))
        for place, b in bins.iterrows():
            words = f"{place / BINS:.1f} to {(place + 1) / BINS:.1f}"
            error = abs(b["right"] - b["mean_probability"])
            rows.append(CalibrationRow(property=name, probability=words, error=error, **b))
    return rows


def calibration_error(classified: Sequence[Classification]) -> float:
    """Expected calibration error: |right - mean probability| averaged over bins, weighted by their answers."""
    bins = reliability(classified)
    return float((bins["n"] * (bins["right"] - bins["mean_probability"])).abs().sum()) / len(classified)


def error_interval(classified: Sequence[Classification]) -> tuple[float, float]:
    """95 % interval of the calibration error, by a percentile bootstrap over objects.

    With few answers error and interval are biased upwards: chance alone separates accuracy from confidence.
    """
    table = _binned(classified)
    objects = table["object_id"].unique()
    # By object and bin, the right answers minus the sum of their probabilities; these add up over the objects drawn.
    excess = (table["right"] - table["mean_probability"]).groupby([table["object_id"], table["bin"]]).sum()
    gaps = excess.unstack(fill_value=0.0).reindex(objects).to_numpy()
    sizes = table["object_id"].value_counts().reindex(objects).to_numpy()
    drawn = np.random.default_rng(derive_seed("calibration")).integers(len(sizes), size=(DRAWS, len(sizes)))
    errors = np.abs(gaps[drawn].sum(axis=1)).sum(axis=1) / sizes[drawn].sum(axis=1)
    low, high = np.quantile(errors, [0.025, 0.975]).tolist()
    return low, high
