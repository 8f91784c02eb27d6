"""Salience against an independent reference, and frames as they are stored and drawn."""

from __future__ import annotations

import itertools
import math
import random
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pipeline.frames
from pipeline.artifacts import read_table
from pipeline.config import FramesConfig
from pipeline.errors import UserError
from pipeline.frames import (
    difference,
    extract_frames,
    fit,
    salient_count,
    salient_frames,
    sample_evaluation,
    sample_training,
)
from pipeline.physiclear.catalogue import Catalogue
from pipeline.records import Frame, Video
from pipeline.videos import catalogue_videos, decode
from tests.conftest import moving_square, write_video

CONFIG = FramesConfig(size=16)


def reference(frames: list[np.ndarray], count: int) -> list[tuple[int, int]]:
    """(index, score) of the salient frames: plain int64 arithmetic and a stable sort."""
    stack = np.stack(frames).astype(np.int64)
    scores = np.abs(np.diff(stack, axis=0)).sum(axis=(1, 2, 3))
    if len(scores) == 0:
        return [(0, 0)]
    best = sorted(np.argsort(-scores, kind="stable")[:count])
    return [(int(i) + 1, int(scores[i])) for i in best]


def flashing(count: int) -> list[np.ndarray]:
    """Black and white by turns: uint8 arithmetic would wrap 0 - 255 around to 1."""
    return [np.full((30, 40, 3), 255 * (i % 2), np.uint8) for i in range(count)]


def constant(count: int) -> list[np.ndarray]:
    return [np.full((30, 40, 3), 77, np.uint8)] * count


def found(frames: list[np.ndarray], count: int) -> list[tuple[int, int]]:
    scored, seen = salient_frames(iter(frames), count, CONFIG)
    assert seen == len(frames)
    for score, index, image in scored:
        np.testing.assert_array_equal(image, fit(frames[index], CONFIG))
        assert score >= 0
    return [(index, score) for score, index, _ in scored]


@pytest.mark.parametrize("frames", [moving_square(40), moving_square(3), flashing(11), constant(9), moving_square(1)])
@pytest.mark.parametrize("fraction", [0.01, 0.3, 1.0])
def test_salience_equals_the_reference(frames: list[np.ndarray], fraction: float) -> None:
    count = salient_count(len(frames), fraction)
    assert found(frames, count) == reference(frames, count)


@given(
    st.integers(1, 30).flatmap(
        lambda n: st.tuples(st.lists(st.sampled_from([0, 1, 127, 128, 255]), min_size=n, max_size=n), st.integers(1, n))
    )
)
def test_ties_go_to_the_earlier_frame(values_and_count: tuple[list[int], int]) -> None:
    values, count = values_and_count
    frames = [np.full((2, 3, 3), value, np.uint8) for value in values]
    assert found(frames, count) == reference(frames, count)


def test_white_to_black_is_the_greatest_difference() -> None:
    black, white = flashing(2)
    assert difference(black, white) == difference(white, black) == 255 * 30 * 40 * 3
    large = np.full((2160, 3840, 3), 255, np.uint8)
    assert difference(large, np.zeros_like(large)) == 255 * large.size, "exact beyond 32 bits"


def test_the_first_frame_never_competes() -> None:
    frames = [np.full((30, 40, 3), v, np.uint8) for v in (255, 0, 0, 0)]
    assert [i for i, _ in found(frames, 3)] == [1, 2, 3]


@pytest.mark.parametrize(("frames", "fraction", "count"), [(1, 0.3, 1), (2, 0.3, 1), (3, 0.3, 1), (101, 0.3, 30)])
def test_top_thirty_percent(frames: int, fraction: float, count: int) -> None:
    assert salient_count(frames, fraction) == count


def test_the_fraction_is_taken_as_written() -> None:
    assert math.ceil(0.07 * 100) == 8, "what floating point would say"
    assert salient_count(101, 0.07) == 7


@given(st.integers(2, 2000), st.floats(0.001, 1))
def test_as_many_as_the_fraction_rounded_up(frames: int, fraction: float) -> None:
    count = salient_count(frames, fraction)
    assert 1 <= count <= frames - 1
    assert count - 1 < Fraction(str(fraction)) * (frames - 1) <= count


@pytest.mark.parametrize(("height", "width"), [(36, 48), (48, 36), (17, 97), (240, 321), (5, 5), (1, 9)])
@pytest.mark.parametrize("mode", ["crop", "squash"])
def test_frames_are_fitted_to_a_square_of_rgb(height: int, width: int, mode: str) -> None:
    blue = np.zeros((height, width, 3), np.uint8)
    blue[..., 0] = 200
    for size in (16, 64):
        image = fit(blue, FramesConfig(size=size, fit=mode))
        assert image.shape == (size, size, 3)
        assert image.dtype == np.uint8
        assert (image == (0, 0, 200)).all()


def test_crop_takes_the_centre_and_squash_takes_all() -> None:
    frame = np.zeros((20, 60, 3), np.uint8)
    frame[:, 20:40] = 255
    assert (fit(frame, FramesConfig(size=20, fit="crop")) == 255).all()
    squashed = fit(frame, FramesConfig(size=30, fit="squash"))[..., 0].mean()
    assert squashed == pytest.approx(255 / 3, abs=2)


def test_files_hold_what_the_table_says(tiny_videos: Path, tmp_path: Path, catalogue: Catalogue) -> None:
    videos = catalogue_videos(tiny_videos, catalogue)
    frames = extract_frames(videos, tiny_videos, CONFIG, tmp_path)
    assert read_table(tmp_path / "frames.parquet", Frame) == frames
    pixels = np.load(tmp_path / "frames.npy", mmap_mode="r")
    assert (pixels.shape, pixels.dtype) == ((len(frames), 16, 16, 3), np.uint8)
    assert [f.row for f in frames] == list(range(len(frames)))
    for video in videos:
        raw = list(decode(tiny_videos / video.path))
        own = [f for f in frames if f.video_id == video.video_id]
        assert [(f.frame_index, f.score) for f in own] == reference(raw, salient_count(video.frames, 0.3))
        for frame in own:
            np.testing.assert_array_equal(pixels[frame.row], fit(raw[frame.frame_index], CONFIG))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frames.npy", "frames.parquet"]


def test_the_number_of_workers_changes_nothing(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    videos = catalogue_videos(tiny_videos, catalogue)
    for workers in (1, 5):
        monkeypatch.setattr(pipeline.frames, "cores", lambda workers=workers: workers)
        extract_frames(videos, tiny_videos, CONFIG, tmp_path / str(workers))
    for name in ("frames.npy", "frames.parquet"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "5" / name).read_bytes()


def test_spaces_and_accents_in_names(tmp_path: Path, catalogue: Catalogue) -> None:
    folder = tmp_path / "vidéos à moi 触覚"
    write_video(folder / "un dossier" / "rug_0.avi", moving_square(6))
    videos = catalogue_videos(folder, catalogue)
    assert len(extract_frames(videos, folder, CONFIG, tmp_path / "sortie é")) == 2


def test_a_video_that_changed_since_is_an_error_and_leaves_nothing(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue
) -> None:
    videos = catalogue_videos(tiny_videos, catalogue)
    wrong = [v.model_copy(update={"frames": v.frames + (v.video_id == "potato_0")}) for v in videos]
    with pytest.raises(UserError, match=r"potato_0\.avi: 20 frames decode where 21 were counted"):
        extract_frames(wrong, tiny_videos, CONFIG, tmp_path)
    gone = [videos[0].model_copy(update={"path": "gone.avi"})]
    with pytest.raises(UserError, match=r"gone\.avi: 0 frames"):
        extract_frames(gone, tiny_videos, CONFIG, tmp_path)
    with pytest.raises(UserError, match="no videos"):
        extract_frames([], tiny_videos, CONFIG, tmp_path)
    assert list(tmp_path.iterdir()) == []


@given(st.integers(1, 400), st.integers(1, 64), st.integers(0, 2**32))
def test_training_samples(count: int, k: int, seed: int) -> None:
    chosen = sample_training(count, k, random.Random(seed))
    assert len(chosen) == k
    assert list(chosen) == sorted(chosen)
    assert set(chosen) <= set(range(count))
    assert len(set(chosen)) == k or count < k
    assert chosen == sample_training(count, k, random.Random(seed))


@given(st.integers(1, 400), st.integers(1, 64))
def test_evaluation_samples_are_uniform_from_the_first(count: int, k: int) -> None:
    chosen = sample_evaluation(count, k)
    assert len(chosen) == k
    assert chosen[0] == 0
    assert chosen[-1] < count
    gaps = [b - a for a, b in itertools.pairwise(chosen)]
    assert all(gap in (count // k, -(-count // k)) for gap in gaps)


def test_every_salient_frame_is_drawn_equally_often() -> None:
    rng = random.Random(0)
    counts = np.zeros(10)
    for _ in range(4000):
        counts[list(sample_training(10, 5, rng))] += 1
    assert counts == pytest.approx(2000, rel=0.08)


@pytest.mark.real
def test_real_frames(real_data: Path, tmp_path: Path, catalogue: Catalogue) -> None:
    names = ["hairbrush_bristles_side_4", "tv_remote_back_3", "rice_spatula_base_1"]
    videos = [v for v in catalogue_videos(real_data, catalogue, ["hairbrush_bristles_side"]) if v.video_id in names]
    videos += [_video(real_data, name) for name in names[1:]]
    config = FramesConfig(size=224)
    frames = extract_frames(videos, real_data, config, tmp_path)
    for video in videos:
        raw = list(decode(real_data / video.path))
        own = [(f.frame_index, f.score) for f in frames if f.video_id == video.video_id]
        assert own == reference(raw, math.ceil(0.3 * (len(raw) - 1)))
    assert np.load(tmp_path / "frames.npy", mmap_mode="r").shape == (len(frames), 224, 224, 3)


def _video(folder: Path, name: str) -> Video:
    path = folder / f"{name}.mov"
    height, width = cv2.VideoCapture(str(path)).read()[1].shape[:2]
    count = sum(1 for _ in decode(path))
    return Video(
        video_id=name,
        object_id=name.rpartition("_")[0],
        path=path.name,
        sha256="",
        frames=count,
        fps=25,
        width=width,
        height=height,
    )
