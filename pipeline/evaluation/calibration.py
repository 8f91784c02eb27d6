"""Calibration of the property heads' probabilities: temperature scaling and the expected calibration error.

Guo et al. 2017, "On Calibration of Modern Neural Networks" (arXiv 1706.04599).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.core.records import Part, Record
from pipeline.encoder.records import Classification
from pipeline.evaluation.records import Share

Floats = npt.NDArray[np.float64]

BINS = 10
"""Bins of equal width by the likeliest class's probability; a border belongs to the bin below it."""
RANGE = (0.05, 20.0)
"""Temperatures to search: beyond them probabilities are all but one-hot, or uniform."""
PRIOR = 2.0
"""Standard deviation of the prior on the temperature, as a factor."""
SMALLEST = 1e-12
"""Lower bound of a probability before its logarithm is taken."""


class CalibrationRow(Record):
    """Calibration of one property's probabilities."""

    property: str
    n: int
    error: Share
    """Expected calibration error."""
    without_temperature: Share
    """The error of the probabilities as the heads give them."""


def rescale(probabilities: npt.ArrayLike, temperature: float) -> Floats:
    """Softmax of log(probabilities) / temperature over the last axis; 1 leaves them as they are."""
    from scipy.special import softmax

    logits = np.log(np.maximum(np.asarray(probabilities, np.float64), SMALLEST)) / temperature
    scaled: Floats = softmax(logits, axis=-1)
    return scaled


def fit_temperature(classified: Sequence[Classification]) -> float:
    """The temperature of one property, from videos that nothing was trained on; 1 where there are none."""
    if not classified:
        return 1.0
    probabilities, expected, objects = zip(
        *((c.probabilities, c.expected, c.object_id) for c in classified), strict=True
    )
    return likeliest_temperature(probabilities, expected, objects)


def likeliest_temperature(probabilities: npt.ArrayLike, expected: npt.ArrayLike, objects: Sequence[str]) -> float:
    """The temperature that makes the expected classes of one property likeliest.

    Videos of one object are alike, so each object counts once, by its videos' mean. With few objects the data say
    little, so the temperature's logarithm has a normal prior of mean 0 and deviation log(`PRIOR`).

    Args:
        probabilities: Videos x classes.
        expected: The class of each video.
        objects: The object of each video.
    """
    from scipy.optimize import minimize_scalar

    counts, wanted = Counter(objects), np.asarray(expected)
    weights = np.array([1 / counts[name] for name in objects])

    def loss(log_temperature: float) -> float:
        scaled = rescale(probabilities, float(np.exp(log_temperature)))
        missed = -np.log(np.maximum(scaled[np.arange(len(wanted)), wanted], SMALLEST))
        return float(weights @ missed) + (log_temperature / math.log(PRIOR)) ** 2 / 2

    # Over the logarithm, in which halving and doubling a temperature are equally far.
    found = minimize_scalar(loss, bounds=np.log(RANGE), method="bounded", options={"xatol": 1e-5})
    return float(np.exp(found.x))


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
    """By property, test videos of all encoders together; `encoders` holds validation and test videos of each."""
    pairs = [pair for classified in encoders for pair in calibrated(classified)]
    rows = []
    for name in dict.fromkeys(before.property for before, _ in pairs):
        given, answers = zip(*(pair for pair in pairs if pair[0].property == name), strict=True)
        errors = {"error": calibration_error(answers), "without_temperature": calibration_error(given)}
        rows.append(CalibrationRow(property=name, n=len(answers), **errors))
    return rows


def calibration_error(classified: Sequence[Classification]) -> float:
    """Expected calibration error: |share right - mean probability of the likeliest class| averaged over bins, weighted
    by their answers. Of few answers it is biased upwards: chance alone separates accuracy from confidence."""
    probabilities = np.array([c.probabilities for c in classified])
    likeliest, right = probabilities.max(axis=1), probabilities.argmax(axis=1) == [c.expected for c in classified]
    excess = np.bincount(np.ceil(likeliest * BINS).astype(int), right - likeliest)
    return float(np.abs(excess).sum()) / len(classified)
