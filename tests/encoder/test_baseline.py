"""The baseline against slow references, brute force, planted signals and pure noise."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.encoder.baseline import predictor
from pipeline.encoder.baseline.features import (
    FEATURE_NAMES,
    HEIGHT,
    PERCENTILES,
    STEP,
    VIDEO_FEATURE_NAMES,
    WIDTH,
    coherence,
    frame_features,
    percentiles,
    uniform_patterns,
    video_features,
)
from pipeline.encoder.baseline.predictor import SMOOTHING, PropertyPredictor, decode_jointly, log_dependence
from pipeline.encoder.baseline.validation import cross_validate, deal, forest
from pipeline.errors import UserError

GREY = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)


def named(frame: np.ndarray, reference: np.ndarray = GREY) -> dict[str, float]:
    return dict(zip(FEATURE_NAMES, frame_features(frame, reference).tolist(), strict=True))


def of_group(features: dict[str, float], group: str) -> dict[str, float]:
    return {name: value for name, value in features.items() if name.startswith(f"{group}.")}


def wave(cycles: float, amplitude: float = 60) -> np.ndarray:
    """Vertical stripes, `cycles` a pixel."""
    row = 128 + amplitude * np.sin(2 * np.pi * cycles * np.arange(WIDTH))
    return np.repeat(np.rint(np.tile(row, (HEIGHT, 1)))[..., None], 3, axis=2).astype(np.uint8)


def noise(seed: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


# Features


def slow_patterns(grey: np.ndarray) -> list[float]:
    """Ojala 2002, equation 9, one pixel after the other."""
    ring = [(-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1)]
    seen: Counter[int] = Counter()
    for y in range(1, grey.shape[0] - 1):
        for x in range(1, grey.shape[1] - 1):
            bits = [int(grey[y + i, x + j] >= grey[y, x]) for i, j in ring]
            changes = sum(a != b for a, b in zip(bits, [bits[-1], *bits[:-1]], strict=True))
            seen[sum(bits) if changes <= 2 else 9] += 1
    return [seen[code] / seen.total() for code in range(10)]


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(3, 9), st.integers(3, 9), st.integers(2, 6))
def test_uniform_patterns_against_a_slow_version(seed: int, height: int, width: int, levels: int) -> None:
    grey = np.random.default_rng(seed).integers(-levels, levels, (height, width)).astype(np.float32)
    assert uniform_patterns(grey) == pytest.approx(slow_patterns(grey), abs=1e-12)
    # Rounding errors on an even surface make no pattern.
    flat = np.float32(37.4) + np.random.default_rng(0).normal(0, 1e-5, (20, 20)).astype(np.float32)
    assert uniform_patterns(flat)[8] == 1


@pytest.mark.parametrize("period", [4, 16, 64])
def test_stripes_have_their_energy_in_the_right_band_and_ring(period: int) -> None:
    features = named(wave(1 / period))
    omega = 2 * math.pi / period
    # A Gaussian of deviation s damps a wave by exp(-(s omega)^2 / 2); a band is the difference of two of them.
    scales = [2 ** (i / 2) for i in range(11)]
    damped = [math.exp(-((s * omega) ** 2) / 2) for s in scales]
    expected = [60 / math.sqrt(2) * (a - b) for a, b in itertools.pairwise(damped)]
    bands = list(of_group(features, "band").values())
    assert int(np.argmax(bands)) == int(np.argmax(expected))
    assert bands == pytest.approx(expected, rel=0.2, abs=1.5)  # Edges disturb long waves.
    edges = np.geomspace(2 / WIDTH, 0.5, 13)
    rings = list(of_group(features, "spectrum").values())
    assert edges[np.argmax(rings)] <= 1 / period * 1.001 <= edges[np.argmax(rings) + 1] * 1.001


def test_stripes_share_one_direction_and_noise_does_not() -> None:
    stripes, grain = named(wave(1 / 16)), named(noise(0))
    assert stripes["coherence.local.2px"] == pytest.approx(1, abs=0.01)
    assert stripes["coherence.global.2px"] == pytest.approx(1, abs=0.01)
    assert grain["coherence.global.2px"] < 0.05
    assert 2.8 < grain["peaked.kurtosis.2.8px"] < 3.2  # Gaussian by the central limit theorem.


@given(st.floats(0, math.pi))
def test_coherence_does_not_depend_on_the_direction(angle: float) -> None:
    y, x = np.mgrid[:80, :80]
    grey = (40 * np.sin(0.3 * (x * math.cos(angle) + y * math.sin(angle)))).astype(np.float32)
    assert coherence(grey)[1] == pytest.approx(1, abs=0.06)


def test_the_difference_does_not_wrap_around() -> None:
    frame, reference = noise(1), noise(2).astype(np.float32) + np.float32(0.375)
    exact = frame.astype(np.float64) - reference.astype(np.float64)
    blurred = cv2.GaussianBlur(exact, (0, 0), 1)
    features = named(frame, reference)
    assert list(of_group(features, "colour").values()) == pytest.approx(
        [*blurred.mean(axis=(0, 1)), *blurred.std(axis=(0, 1))], rel=1e-4, abs=1e-4
    )
    coarse = np.abs(blurred).mean(axis=2).reshape(HEIGHT // 4, 4, WIDTH // 4, 4).mean(axis=(1, 3))
    assert features["area.over32"] == pytest.approx((coarse > 32).mean(), abs=1e-3)
    dark, bright = named(GREY - 100), named(GREY + 100)
    assert (dark["colour.mean.g"], bright["colour.mean.g"]) == pytest.approx((-100, 100), abs=1e-3)
    assert dark["area.over32"] == bright["area.over32"] == 1


@given(st.integers(0, 10**6))
def test_percentiles_are_exact_to_a_step(seed: int) -> None:
    change = np.random.default_rng(seed).exponential(10, (30, 40)).astype(np.float32).clip(0, 255)
    exact = np.percentile(change, PERCENTILES, method="inverted_cdf")
    assert (percentiles(change) - exact >= -1e-6).all()
    assert (percentiles(change) - exact <= STEP + 1e-6).all()


def test_blobs_are_counted() -> None:
    frame = GREY.copy()
    for x, y in [(60, 60), (160, 60), (260, 60), (60, 180), (160, 180), (260, 180)]:
        cv2.circle(frame, (x, y), 6, (220, 220, 220), -1)
    assert named(frame)["blob.count.4px"] == 6


def test_an_untouched_gel_shows_nothing() -> None:
    features = named(GREY)
    assert {name for name, value in features.items() if value} == {
        *(f"change.p{p}" for p in PERCENTILES),  # The upper end of the lowest cell.
        *(f"lbp.{scale}px.8" for scale in (2, 4, 8)),
    }
    picture = noise(3)
    assert frame_features(picture, picture) == pytest.approx(frame_features(GREY, GREY))


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (17, 31), (480, 640)])
def test_hard_pictures_have_finite_features(size: tuple[int, int]) -> None:
    checkered = np.zeros((*size, 3), np.uint8)
    checkered[::2, ::2] = 255
    for frame in (np.zeros_like(checkered), checkered, np.full_like(checkered, 255), noise(4, *size)):
        for reference in (GREY, frame, np.zeros((5, 9, 3), np.float32)):
            features = frame_features(frame, reference)
            assert (features.shape, features.dtype) == ((len(FEATURE_NAMES),), np.float32)
            assert np.isfinite(features).all()


def test_a_video_is_its_frames_mean_and_maximum() -> None:
    frames = [noise(5), wave(1 / 9), GREY]
    rows = np.stack([frame_features(frame, GREY) for frame in frames]).astype(np.float64)
    raw = np.concatenate([rows.mean(axis=0), rows.max(axis=0)])
    features = video_features(frames, GREY)
    assert features == pytest.approx(np.sign(raw) * np.log1p(np.abs(raw)), rel=1e-4, abs=1e-6)
    assert features == pytest.approx(video_features(frames[::-1], GREY), rel=1e-5, abs=1e-6)
    alone = video_features(frames[:1], GREY)
    assert len(alone) == len(VIDEO_FEATURE_NAMES) == len(set(VIDEO_FEATURE_NAMES)) == 2 * len(FEATURE_NAMES)
    assert (alone[: len(FEATURE_NAMES)] == alone[len(FEATURE_NAMES) :]).all()
    assert (features == video_features(frames, GREY.astype(np.float32))).all()


# Predictor


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


@pytest.fixture
def few_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictor, "TREES", 20)


@pytest.mark.usefixtures("few_trees")
def test_a_planted_signal_is_found_and_seeds_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    features, labels, objects = planted(0)
    model = PropertyPredictor((3, 2), seed=1).fit(features, labels, objects)
    unseen, answers, _ = planted(1)
    assert (model.predict(unseen) == answers).all(axis=1).mean() > 0.8
    tables = model.probabilities(unseen)
    assert [t.shape for t in tables] == [(72, 3), (72, 2)]
    assert all(t.sum(axis=1) == pytest.approx(1) and (t > 0).all() for t in tables)
    monkeypatch.setattr(predictor, "cores", lambda: 1)
    again = PropertyPredictor((3, 2), seed=1).fit(features, labels, objects)
    other = PropertyPredictor((3, 2), seed=2).fit(features, labels, objects)
    assert all((a == b).all() for a, b in zip(tables, again.probabilities(unseen), strict=True))
    assert any((a != b).any() for a, b in zip(tables, other.probabilities(unseen), strict=True))


@pytest.mark.usefixtures("few_trees")
def test_a_class_that_training_lacks_stays_possible() -> None:
    features, labels, objects = planted(2, objects=8)
    labels[:, 0] = np.where(labels[:, 0] == 1, 2, labels[:, 0])
    labels[:, 1] = 1
    model = PropertyPredictor((4, 2, 1))
    model.fit(features, np.column_stack([labels, 0 * labels[:, 0]]), objects)
    first, second, third = model.probabilities(features)
    assert first[:, [1, 3]] == pytest.approx(1 / 4 / 21)
    assert second[:, 0] == pytest.approx(1 / 2 / 21)
    assert third == pytest.approx(1)
    assert set(model.predict(features)[:, 0].tolist()) <= {0, 2}
    one = PropertyPredictor((3, 3)).fit(features[:1], np.array([[2, 1]]), ["a"])
    assert one.predict(features[:1]).tolist() == [[2, 1]], "a single video trains"


# Validation


@given(st.lists(st.integers(0, 30), min_size=2, max_size=80), st.integers(2, 7), st.integers(0, 99))
def test_folds_hold_whole_objects_and_are_even(numbers: list[int], folds: int, seed: int) -> None:
    objects = [f"o{n}" for n in numbers]
    folds = min(folds, len(set(objects)))
    dealt = deal(objects, folds, seed)
    assert sorted(itertools.chain.from_iterable(dealt)) == sorted(set(objects))
    assert max(map(len, dealt)) - min(map(len, dealt)) <= 1
    assert dealt == deal(objects[::-1], folds, seed)


@pytest.mark.usefixtures("few_trees")
def test_cross_validation_finds_a_signal_and_tells_noise_at_chance() -> None:
    def right(features: np.ndarray, labels: np.ndarray, objects: list[str], seed: int) -> np.ndarray:
        classes = (3, 2)[: labels.shape[1]]
        predict = forest(features, labels, objects, classes)
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
