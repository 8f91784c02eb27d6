"""Joint decisions at their edges: probabilities of 0 and 1, ties, underflow, a single class, everything impossible.

The decision itself is float64 whatever it is given; logits come in the classifier's format. It is held against a search
in exact fractions, so that the bound is 0: no decision may change.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import partial

import numpy as np
import torch

from pipeline.encoder.baseline.predictor import decode_jointly, log_dependence
from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.model import FrameEncoder
from pipeline.stability.case import DOUBLE, SOLVED, Case, Dtype, Floats, exactly

PART = "joint decisions"
SAME = exactly("use: no decision may change; held against a search in exact fractions")
Table = Sequence[Sequence[float]]
"""One video's probabilities of each class, by property."""

HALF = ((0.5, 0.5), (0.5, 0.5))
TABLES: dict[str, Table] = {
    "all classes alike": HALF,
    "certain": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "tie of two combinations": ((0.25, 0.5, 0.25), (0.5, 0.5, 0.0)),
    "too small for float32": ((1e-300, 1e-200), (1e-100, 1.0)),
    "the smallest numbers": ((5e-324, 1e-320), (5e-324, 1.0)),
    "every combination impossible": ((0.0, 0.0), (0.5, 0.5)),
    "a single class": ((1.0,), (1.0,)),
    "a rounding apart": ((0.5, 0.5 + 2**-40), (0.5 + 2**-39, 0.5)),
}


def cases() -> list[Case]:
    """Probabilities in float64, and logits in the formats of classifiers."""
    return [*_tables(), *_priors(), *_logits()]


def _tables() -> Iterator[Case]:
    for name, table in TABLES.items():
        yield Case(PART, name, DOUBLE, partial(_decided, table, None), SAME, partial(_searched, table, None))


def _priors() -> Iterator[Case]:
    labels = np.array([[0, 0], [0, 0], [1, 1], [1, 1]])
    for name, table in (("prior breaks the tie", HALF), ("prior against certainty", ((1.0, 0.0), (0.0, 1.0)))):
        yield Case(PART, name, DOUBLE, partial(_decided, table, labels), SAME, partial(_searched, table, labels))


def _decided(table: Table, labels: np.ndarray | None, _: Dtype) -> Floats:
    shape = tuple(len(row) for row in table)
    prior = np.zeros(shape) if labels is None else log_dependence(labels, [str(i) for i in range(len(labels))], shape)
    return np.asarray(decode_jointly([np.log([row]) for row in table], prior)[0], dtype=np.float64)


def _searched(table: Table, labels: np.ndarray | None) -> Floats:
    """The first combination with the largest product, all of it in fractions."""
    shape = tuple(len(row) for row in table)
    joint = {c: Fraction(1, 6) for c in itertools.product(*map(range, shape))}
    for row in [] if labels is None else labels.tolist():
        joint[tuple(row)] += 1
    total = sum(joint.values(), Fraction(0))

    def worth(combination: tuple[int, ...]) -> Fraction:
        evidence, dependence = Fraction(1), joint[combination] / total
        for i, k in enumerate(combination):
            evidence *= Fraction(table[i][k])
            dependence /= sum((v for c, v in joint.items() if c[i] == k), Fraction(0)) / total
        return evidence if labels is None else evidence * dependence

    return np.array(max(joint, key=worth), dtype=np.float64)


def _logits() -> Iterator[Case]:
    """Powers of two, which every format holds; three properties of three classes."""
    for name, scale in (("logits of 0", 0.0), ("logits of 64", 64.0), ("logits of 2^100", 2.0**100)):
        rows = [[[1.0, 1.0, 0.5], [0.0, 0.0, 0.0], [-1.0, 0.5, 1.0]], [[0.0, -1.0, -0.5], [0.5, 1.0, 1.0], [1.0] * 3]]
        logits = scale * np.array(rows)
        best = logits.argmax(axis=2).astype(np.float64)
        yield Case(PART, name, (*SOLVED, Dtype.BFLOAT16), partial(_voted, logits), SAME, lambda b=best: b)  # type: ignore[misc]


def _voted(logits: Floats, dtype: Dtype) -> Floats:
    model = FrameVotes(FrameEncoder(4), [3, 3, 3])
    return model.decide(torch.from_numpy(logits).flatten(1).to(dtype.torch)).numpy().astype(np.float64)
