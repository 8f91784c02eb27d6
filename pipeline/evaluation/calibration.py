"""How far probabilities can be believed: temperature scaling, reliability, expected calibration error.

Guo et al. 2017, "On Calibration of Modern Neural Networks" (arXiv 1706.04599).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.records import Classification, Optional, Part, Record, Share
from pipeline.runtime import derive_seed

Floats = npt.NDArray[np.float64]

BINS = 10
RANGE = (0.05, 20.0)
"""Temperatures that are looked at: beyond them probabilities are one-hot, or even, to the eye."""
PRIOR = 2.0
SMALLEST = 1e-12
DRAWS = 1000


class CalibrationRow(Record):
    """How far one property's probabilities can be believed: all answers, or those of like confidence."""

    property: str
    probability: str
    """Of the likeliest class: "all", or a bin."""
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


class Bin(Record):
    """Answers of like confidence: above `low`, up to `high`."""

    low: float
    high: float
    n: int
    confidence: float
    """Mean of the largest probabilities."""
    accuracy: float


def rescale(probabilities: npt.ArrayLike, temperature: float) -> Floats:
    """Softmax of log(probabilities) / temperature over the last axis; 1 leaves them as they are."""
    logits = np.log(np.maximum(np.asarray(probabilities, np.float64), SMALLEST)) / temperature
    powers = np.exp(logits - logits.max(axis=-1, keepdims=True))
    scaled: Floats = powers / powers.sum(axis=-1, keepdims=True)
    return scaled


def fit_temperature(classified: Sequence[Classification]) -> float:
    """The temperature that makes the expected classes likeliest; 1 where there is nothing to fit it on.

    Videos of one object are alike, so each object counts once, by its videos' mean. Few objects say little: a normal
    prior holds the temperature's logarithm at 0, with a factor of `PRIOR` as its deviation.

    Args:
        classified: Of one property, on videos that nothing was trained on.
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

    found = minimize_scalar(loss, bounds=np.log(RANGE), method="bounded", options={"xatol": 1e-5})
    return float(np.exp(found.x))


def reliability(classified: Sequence[Classification], temperature: float = 1.0) -> list[Bin]:
    """`BINS` bins of equal width by confidence, of which empty ones are left out; right is the likeliest class."""
    confidence, right = _confidence(classified, temperature)
    places = np.clip(np.ceil(confidence * BINS).astype(int) - 1, 0, BINS - 1)
    return [
        Bin(
            low=place / BINS,
            high=(place + 1) / BINS,
            n=int((places == place).sum()),
            confidence=float(confidence[places == place].mean()),
            accuracy=float(right[places == place].mean()),
        )
        for place in np.unique(places).tolist()
    ]


def calibrated(said: Sequence[Classification]) -> Iterator[tuple[Classification, Classification]]:
    """What an encoder says of test videos, property by property, as it is and by the temperature of its validation."""
    for name in dict.fromkeys(c.property for c in said):
        mine = [c for c in said if c.property == name]
        temperature = fit_temperature([c for c in mine if c.part is Part.VALIDATION])
        for c in mine:
            if c.part is Part.TEST:
                yield c, c.model_copy(update={"probabilities": tuple(rescale(c.probabilities, temperature).tolist())})


def calibration_rows(encoders: Sequence[Sequence[Classification]]) -> list[CalibrationRow]:
    """Test videos of all encoders together, by property; a row for all of them, then one a bin.

    Args:
        encoders: What each says of validation and test videos. Its temperatures are fitted on its validation videos.
    """
    given: dict[str, list[Classification]] = {}
    tempered: dict[str, list[Classification]] = {}
    for said in encoders:
        for before, after in calibrated(said):
            given.setdefault(before.property, []).append(before)
            tempered.setdefault(after.property, []).append(after)
    rows = []
    for name, answers in tempered.items():
        bins = reliability(answers)
        low, high = error_interval(answers)
        rows.append(
            CalibrationRow(
                property=name,
                probability="all",
                n=len(answers),
                mean_probability=sum(b.n * b.confidence for b in bins) / len(answers),
                right=sum(b.n * b.accuracy for b in bins) / len(answers),
                error=calibration_error(answers),
                low=low,
                high=high,
                without_temperature=calibration_error(given[name]),
            )
        )
        rows += [
            CalibrationRow(
                property=name,
                probability=f"{b.low:.1f} to {b.high:.1f}",
                n=b.n,
                mean_probability=b.confidence,
                right=b.accuracy,
                error=abs(b.accuracy - b.confidence),
            )
            for b in bins
        ]
    return rows


def calibration_error(classified: Sequence[Classification], temperature: float = 1.0) -> float:
    """Expected calibration error: the bins' mean |accuracy - confidence|, each weighing as many answers as it has."""
    bins = reliability(classified, temperature)
    return sum(b.n * abs(b.accuracy - b.confidence) for b in bins) / len(classified)


def error_interval(classified: Sequence[Classification], temperature: float = 1.0) -> tuple[float, float]:
    """95 % of the calibration errors of objects drawn anew (percentile bootstrap over objects).

    The error of few answers is biased upwards, since chance alone parts accuracy from confidence; so is this interval.
    """
    by_object: dict[str, list[Classification]] = {}
    for c in classified:
        by_object.setdefault(c.object_id, []).append(c)
    groups = list(by_object.values())
    rng = np.random.default_rng(derive_seed("calibration"))
    errors = [
        calibration_error([c for g in rng.integers(len(groups), size=len(groups)) for c in groups[g]], temperature)
        for _ in range(DRAWS)
    ]
    low, high = np.quantile(errors, [0.025, 0.975]).tolist()
    return low, high


def _confidence(classified: Sequence[Classification], temperature: float) -> tuple[Floats, npt.NDArray[np.bool_]]:
    scaled = rescale([c.probabilities for c in classified], temperature)
    return scaled.max(axis=1), scaled.argmax(axis=1) == np.array([c.expected for c in classified])
