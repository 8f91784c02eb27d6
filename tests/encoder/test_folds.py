"""Folds of whole objects, and the joint decision, against brute force, planted signals and pure noise."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import UserError
from pipeline.encoder.folds import Fold, Labels, cross_validate, deal
from pipeline.encoder.frame_classifier import SMOOTHING, decode_jointly, fit_frame_heads, log_dependence


def test_the_prior_counts_each_object_once() -> None:
    labels = np.array([[0, 0], [0, 0], [0, 0], [1, 2], [1, 0]])
    dependence = log_dependence(labels, ["a", "a", "a", "b", "c"], (2, 3))
    total = 3 + 6 * SMOOTHING
    joint = {(0, 0): 1 + SMOOTHING, (1, 2): 1 + SMOOTHING, (1, 0): 1 + SMOOTHING}
    for i, j in itertools.product(range(2), range(3)):
        first = sum(joint.get((i, b), SMOOTHING) for b in range(3)) / total
        second = sum(joint.get((a, j), SMOOTHING) for a in range(2)) / total
        assert dependence[i, j] == pytest.approx(math.log(joint.get((i, j), SMOOTHING) / total / first / second))
    assert log_dependence(np.zeros((1, 1), np.int64), ["a"], (4,)) == pytest.approx(np.zeros(4))


@given(st.integers(0, 10**6), st.lists(st.integers(1, 4), min_size=1, max_size=4))
def test_joint_decoding_against_brute_force(seed: int, classes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    tables = [rng.dirichlet(np.ones(count), size=5) for count in classes]
    dependence = rng.normal(size=tuple(classes))
    decoded = decode_jointly([np.log(table) for table in tables], dependence)
    for video in range(5):
        best, highest = None, -math.inf
        for combination in itertools.product(*map(range, classes)):
            score = float(dependence[combination])
            score += sum(math.log(t[video, c]) for t, c in zip(tables, combination, strict=True))
            if score > highest:
                best, highest = combination, score
        assert tuple(decoded[video]) == best


def test_too_many_combinations_are_one_line() -> None:
    with pytest.raises(UserError, match=r"\A1000000 combinations of classes are too many to decide[^\n]*\Z"):
        log_dependence(np.zeros((1, 2), np.int64), ["a"], (1000, 1000))


Data = tuple[np.ndarray, np.ndarray, list[str]]


def planted(seed: int, objects: int = 24, videos: int = 3, strength: float = 4) -> Data:
    """Features whose first two columns tell the labels, up to noise, among columns that tell nothing."""
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, (3, 2), size=(objects, 2))
    labels = np.repeat(truth, videos, axis=0)
    features = rng.normal(size=(len(labels), 4)).astype(np.float32)
    features[:, :2] += strength * labels
    return features, labels, [f"o{i}" for i in range(objects) for _ in range(videos)]


@given(st.lists(st.integers(0, 30), min_size=2, max_size=80), st.integers(2, 7), st.integers(0, 99))
def test_folds_hold_whole_objects_and_are_even(numbers: list[int], folds: int, seed: int) -> None:
    objects = [f"o{n}" for n in numbers]
    folds = min(folds, len(set(objects)))
    dealt = deal(objects, folds, seed)
    assert sorted(itertools.chain.from_iterable(dealt)) == sorted(set(objects))
    assert max(map(len, dealt)) - min(map(len, dealt)) <= 1
    assert dealt == deal(objects[::-1], folds, seed)


def test_cross_validation_finds_a_signal_and_tells_noise_at_chance() -> None:
    def right(features: np.ndarray, labels: np.ndarray, objects: list[str], seed: int) -> np.ndarray:
        classes = (3, 2)[: labels.shape[1]]

        def predict(fold: Fold) -> Labels:
            own = [o for o, trained in zip(objects, fold.trained, strict=True) if trained]
            heads = fit_frame_heads(features[fold.trained, None], labels[fold.trained], own, classes, 100.0)
            return heads.predict(features[fold.tested, None])

        predicted = cross_validate(predict, objects, classes, folds=3, repeats=1, seed=seed)
        assert predicted.shape == (len(labels), 1, labels.shape[1])
        return (predicted[:, 0] == labels).all(axis=1)

    signal = planted(5, objects=30, strength=8)
    assert right(*signal, 7).mean() > 0.8
    # Classes are drawn, not balanced: of balanced ones a fold that has more leaves fewer to train on.
    noise_right = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        labels, objects = rng.integers(0, 2, (40, 1)), [f"o{i}" for i in range(40)]
        noise_right.append(right(rng.normal(size=(40, 5)).astype(np.float32), labels, objects, seed))
    # Four standard errors of 160 coin flips.
    assert np.mean(noise_right) == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(160))
