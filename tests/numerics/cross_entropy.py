"""Logits whose losses are known: whole multiples of a power of two, which every format holds, so that what is off is
the loss alone. The language model and the classifier are held against the same ones."""

from __future__ import annotations

import math

import numpy as np

from tests.numerics.bounds import summing
from tests.numerics.harness import FLOAT32, FLOAT64, Floats, Format

STEPS = np.array([[0, 1, -1, 3, 3], [7, -7, 0, 0, 1], [2, 2, 2, 2, 2], [-5, 4, 4, -5, 6]])
"""Logits by multiples: one loss each of several rows, among them ties."""
TARGETS = (3, 1, 0, 4)


def logits(power: int) -> Floats:
    """`STEPS` times 2^power: 4 x 5."""
    return STEPS * 2.0**power


def mean_loss(power: int) -> float:
    """The mean of log sum exp z - z of the target over the rows, with exact sums."""
    losses = []
    for row, target in zip(logits(power).tolist(), TARGETS, strict=True):
        losses.append(math.log(math.fsum(math.exp(z - max(row)) for z in row)) + max(row) - row[target])
    return math.fsum(losses) / len(losses)


def rounded_loss(power: int, fmt: Format, properties: int = 1) -> float:
    """roundings: exp, log, sums over classes and rows, in float32 at least, by the spread of logits over the loss."""
    largest = max(mean_loss(power), 2.0**-53)
    terms = properties * sum(STEPS.shape) + 6
    exact = fmt if fmt is FLOAT64 else FLOAT32
    return summing(terms, exact) * (float(np.ptp(logits(power))) + largest) / largest
