"""How realism is measured: distances against what is known of them, transfer, and the whole on made-up videos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.encoder.baseline.features import VIDEO_FEATURE_NAMES
from pipeline.benchmarks import DATA_VARIABLE, distance, realism
from pipeline.benchmarks import transfer as transfer_module
from pipeline.benchmarks.distance import frechet, mean_differences, principal_axes, told_apart, wasserstein
from pipeline.benchmarks.realism import PICTURE, distances, kind_of, looks, measure
from pipeline.benchmarks.transfer import Kind, transfer
from pipeline.errors import UserError
from pipeline.videos.catalogue import Catalogue
from pipeline.scenes.film import write_film
from pipeline.scenes.light import make_sensor, shade
from pipeline.scenes.recipe import Recipe
from pipeline.config import ScenesConfig
from tests.conftest import ROOT

CLASSES = (2, 3)


@pytest.fixture(autouse=True)
def _small_forests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distance, "TREES", 30)
    monkeypatch.setattr(transfer_module, "FOLDS", 2)
    monkeypatch.setattr(realism, "SPLITS", 1)
    monkeypatch.setattr(realism, "REPEATS", 1)


def rows(count: int, features: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, features)).astype(np.float32)


@given(st.integers(0, 1000), st.floats(-5, 5), st.floats(0.5, 4))
def test_single_features_shift_by_what_they_are_shifted(seed: int, shift: float, scale: float) -> None:
    first = rows(30, 4, seed)
    scales = np.full(4, scale)
    moved = first + np.float32(shift)
    for measured in (mean_differences, wasserstein):
        assert np.abs(measured(first, first, scales)).max() == 0
        np.testing.assert_allclose(measured(first, moved, scales), abs(shift) / scale, atol=1e-5)
        np.testing.assert_array_equal(measured(first, moved, scales), measured(moved, first, scales))


@given(st.integers(0, 1000))
def test_wasserstein_sees_what_means_do_not(seed: int) -> None:
    first, scale = rows(40, 3, seed), np.ones(3)
    wider = (first - first.mean(axis=0)) * 2 + first.mean(axis=0)
    assert mean_differences(first, wider, scale).max() < 1e-6
    # Equal means: every point moves by its distance to the mean.
    expected = np.abs(first - first.mean(axis=0)).mean(axis=0)
    np.testing.assert_allclose(wasserstein(first, wider, scale), expected, rtol=1e-4)


def test_frechet_of_gaussians() -> None:
    """Against the closed form where covariances commute: |m|^2 + sum of (s1 - s2)^2."""
    axes, first = np.eye(3), rows(20_000, 3, 0)
    spreads, means = np.array([0.5, 1, 3]), np.array([1, 0, -2])
    second = rows(20_000, 3, 1) * spreads + means
    expected = np.sqrt((means**2).sum() + ((spreads - 1) ** 2).sum())
    assert frechet(first, second, axes) == pytest.approx(expected, rel=0.02)
    assert frechet(first, first, axes) == pytest.approx(0, abs=1e-3)


def test_principal_axes_are_those_of_the_covariance() -> None:
    features = rows(500, 5, 2) @ np.diag([5.0, 3, 1, 0.1, 0.1]).astype(np.float32)
    axes = principal_axes(features, np.ones(5), 2)
    assert axes.shape == (5, 2)
    _, vectors = np.linalg.eigh(np.cov(features, rowvar=False))
    np.testing.assert_allclose(np.abs((axes * vectors[:, :-3:-1]).sum(axis=0)), 1, atol=1e-3)


def names(count: int, each: int = 4, start: int = 0) -> list[str]:
    return [f"object {start + i}" for i in range(count) for _ in range(each)]


def test_trees_tell_apart_only_what_differs() -> None:
    one, two = names(15), names(15, start=15)
    first, second = rows(60, 6, 0), rows(60, 6, 1)
    assert told_apart(first, second, (one, two), 0, jobs=1) == pytest.approx(0.5, abs=0.15)
    assert told_apart(first, second + 3, (one, two), 0, jobs=1) > 0.95
    # Objects that the trees know by heart do not count: each object has a place of its own, and none tells its side.
    places = np.repeat(10 * rows(30, 6, 2), 4, axis=0)
    known = told_apart(first + places[:60], second + places[60:], (one, two), 0, jobs=1)
    assert known < 0.75


def kind(shift: float, seed: int, objects: Sequence[str]) -> Kind:
    labels = np.array([[int(o.split()[1]) % c for c in CLASSES] for o in objects])
    features = rows(len(objects), 5, seed) * np.float32(0.3)
    features[:, :2] += labels
    return Kind(features + np.float32(shift), tuple(objects), labels)


def test_transfer_goes_all_four_ways() -> None:
    objects = names(20)
    ways = transfer({"real": kind(0, 0, objects), "scenes": kind(0, 1, objects[8:])}, CLASSES, ("a", "b"), repeats=1)
    cases = {row.case: row for row in ways}
    assert len(cases) == 3 * 4
    for row in ways:
        assert row.low <= row.cost <= row.high
        assert row.cost < row.majority <= row.chance or row.case.startswith("all"), "what carries over is learnt"
    same = cases["a, real to real"]
    assert (same.ratio, same.baseline) == (1, "a, real to real")
    apart = transfer({"real": kind(0, 0, objects), "scenes": kind(9, 1, objects)}, CLASSES, ("a", "b"), repeats=1)
    assert {r.case: r for r in apart}["all properties, real to scenes"].cost > 0.5, "nothing carries over that far"


def wide_kind(shift: float, seed: int) -> Kind:
    objects = names(20, each=3)
    features = rows(len(objects), len(VIDEO_FEATURE_NAMES), seed) + np.float32(shift)
    return Kind(features, tuple(objects), np.zeros((len(objects), 1), np.int64))


def test_distances_grow_with_a_shift() -> None:
    real = wide_kind(0, 0)
    near, far, same = (distances(real, k, splits=2) for k in (wide_kind(0.5, 1), wide_kind(2, 1), real))
    for less, more, none in zip(near, far, same, strict=True):
        assert less.cost < more.cost or less.case == "told apart"
        assert none.ratio == pytest.approx(1), "the real videos in the scenes' place"
        assert less.low <= less.cost <= less.high
    assert {row.case.partition(", ")[2] for row in near} >= {"all", "colour", "change", "band", "lbp", "spectrum"}


def make_videos(recipes: dict[str, Recipe], config: ScenesConfig, folder: Path) -> list[Path]:
    """Balls of an object's own size, instead of scenes."""
    sensor = make_sensor(64, 48, 0)
    y, x = np.mgrid[:48, :64]
    for place, object_id in enumerate(config.objects):
        for number in range(2):
            squares = (x - 32 - number) ** 2 + (y - 24) ** 2
            ball = np.exp(-squares / (30 + 15 * place)).astype(np.float32)
            skins = [np.float32(depth) * ball for depth in (0, 0, 0.3, 0.6, 0.6, 0.5, 0)]
            pictures = [shade(skin, sensor, 0.3, seed * 977) for seed, skin in enumerate(skins)]
            write_film(folder / f"{object_id}_{number}.avi", pictures, 10.0)
    return sorted(folder.glob("*.avi"))


def test_the_whole_on_made_up_videos(
    catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    objects = tuple(sorted(catalogue.objects))[:10]
    folder = tmp_path / "real videos"
    folder.mkdir()
    make_videos({}, ScenesConfig(objects=objects), folder)
    monkeypatch.setenv(DATA_VARIABLE, str(folder))
    monkeypatch.setattr(realism, "synthesize", make_videos)
    monkeypatch.setattr(realism, "_recipes", lambda root, catalogue: {})
    monkeypatch.setattr(realism, "bench_videos", lambda root: (folder, catalogue))
    measured = {row.case: row for row in measure(tmp_path)}
    assert measured["Wasserstein, all"].ratio == pytest.approx(1), "scenes are the real videos here"
    assert measured["Frechet"].ratio == pytest.approx(1)
    assert measured["all properties, scenes to real"].ratio == 1
    assert (tmp_path / PICTURE).stat().st_size > 1000
    kinds = kind_of(looks(folder, catalogue), catalogue)
    assert kinds.features.shape == (20, len(VIDEO_FEATURE_NAMES))
    assert set(kinds.objects) == set(objects)


def test_without_real_videos_one_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path))
    with pytest.raises(UserError, match=DATA_VARIABLE) as problem:
        measure(ROOT)
    assert "\n" not in str(problem.value)
