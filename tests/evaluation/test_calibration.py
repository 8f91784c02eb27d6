"""Temperatures and calibration errors against sums by hand; maps of embeddings keep what is near."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import softmax

from pipeline.core.records import Part
from pipeline.encoder.records import Classification
from pipeline.evaluation.calibration import calibration_error, calibration_rows, fit_temperature, rescale
from pipeline.evaluation.maps import map_frame
from pipeline.videos.records import Assignment
from tests.conftest import CATALOGUE, classified


def said(expected: int, *probabilities: float, object_id: str = "rug") -> Classification:
    return classified(f"{object_id}_0", "hardness", expected, int(np.argmax(probabilities)), probabilities)


def drawn(count: int, temperature: float, seed: int = 0) -> list[Classification]:
    """Classes drawn by the softmax of logits that are then said `temperature` times as large, an object each."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(size=(count, 3))
    expected = [int(rng.choice(3, p=p)) for p in softmax(logits, axis=1)]
    given = softmax(temperature * logits, axis=1).tolist()
    return [said(e, *p, object_id=f"o{i}") for i, (e, p) in enumerate(zip(expected, given, strict=True))]


def test_error_by_hand() -> None:
    """Confidences .95 and .91 in one bin (one right), .6 and .55 in two; .1 steps belong to the bin below them."""
    answers = [said(0, 0.95, 0.05), said(1, 0.91, 0.09), said(0, 0.6, 0.4), said(0, 0.45, 0.55)]
    assert calibration_error(answers) == pytest.approx(0.5 * 0.075 + 0.5 * 0.43)
    assert calibration_error([said(0, 1.0, 0.0)]) == pytest.approx(0, abs=1e-9)
    assert calibration_error([said(1, 1.0, 0.0)]) == pytest.approx(1)


def test_minimum_is_where_the_slope_vanishes() -> None:
    """The slope, written out: sums of (expected - mean logit) / T, and the prior's. Two videos are of one object."""
    answers = [said(0, 0.9, 0.1, object_id="a"), said(1, 0.7, 0.3, object_id="a"), said(0, 0.8, 0.2, object_id="b")]
    logits, weights = np.log([c.probabilities for c in answers]), np.array([0.5, 0.5, 1.0])

    def slope(log_t: float) -> float:
        scaled = logits / np.exp(log_t)
        mean = (softmax(scaled, axis=1) * scaled).sum(axis=1)
        own = scaled[np.arange(3), [c.expected for c in answers]]
        return float(weights @ (own - mean)) + log_t / np.log(2) ** 2

    assert fit_temperature(answers) == pytest.approx(np.exp(brentq(slope, -3, 3)), rel=1e-3)


def test_few_objects_move_it_little() -> None:
    assert fit_temperature([]) == 1
    right = [said(0, 0.6, 0.4)]
    assert 0.5 < fit_temperature(right) < 1
    assert fit_temperature(right * 50) == pytest.approx(fit_temperature(right)), "one object, however many videos"
    assert 1 < fit_temperature([said(1, 1.0, 0.0)]) < 20


@given(st.lists(st.floats(0, 1), min_size=2, max_size=5).filter(lambda p: sum(p) > 0.1), st.floats(0.1, 20))
def test_rescaling_keeps_a_distribution_and_its_order(values: list[float], temperature: float) -> None:
    p = np.array(values) / sum(values)
    scaled = rescale(p, temperature)
    assert scaled.sum() == pytest.approx(1)
    order = np.argsort(p)
    assert (np.diff(scaled[order]) >= -1e-12).all()
    np.testing.assert_allclose(rescale(p, 1.0), p, atol=1e-9)


def test_rows_have_the_temperature_of_their_own_encoder() -> None:
    """Two encoders that are too sure, each by its own factor, and what all their answers come to."""
    encoders, tested = [], []
    for number, temperature in enumerate((3.0, 0.5)):
        seen = drawn(2000, temperature, seed=number)
        encoders.append([c.model_copy(update={"part": Part.VALIDATION}) for c in seen[:1000]] + seen[1000:])
        tested += seen[1000:]
    (row,) = calibration_rows(encoders)
    assert (row.property, row.n) == ("hardness", 2000)
    assert row.without_temperature == pytest.approx(calibration_error(tested), abs=1e-6)
    assert row.error < 0.04 < 0.08 < row.without_temperature
    assert calibration_rows([]) == []


def videos(objects: int, each: int) -> list[Assignment]:
    names = list(CATALOGUE.objects)[:objects]
    return [Assignment(video_id=f"{o}_{i}", object_id=o, part=Part.TEST) for o in names for i in range(each)]


@pytest.mark.parametrize("count", [2, 3, 40])
def test_a_map_has_each_video_once_a_method_and_keeps_clusters_apart(count: int) -> None:
    tested = videos(count, 1)
    far = 20.0 * (np.arange(len(tested)) % 2)
    features = np.random.default_rng(0).normal(size=(len(tested), 8)) + far[:, None]
    found = map_frame(features, tested, CATALOGUE)
    assert found.equals(map_frame(features, tested, CATALOGUE)), "the same each time"
    for _, rows in found.groupby("method"):
        assert sorted(rows["video_id"]) == sorted(v.video_id for v in tested)
        assert np.isfinite(rows[["x", "y"]].to_numpy()).all()
        if count >= 40:
            places = rows[["x", "y"]].to_numpy()
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.where(np.eye(len(rows)), np.inf, 0)
            assert (far[apart.argmin(1)] == far).all()


def test_of_many_videos_a_map_has_some_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.evaluation.maps.MAPPED", 40)
    tested = videos(20, 3)
    found = map_frame(np.random.default_rng(0).normal(size=(60, 3)), tested, CATALOGUE)
    shown = found[found["method"] == "PCA"]
    assert len(shown) == 40
    assert shown["video_id"].str.rpartition("_")[0].nunique() == 20
