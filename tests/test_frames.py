"""Which frames are kept, by every rule, against slow second implementations; how they are fitted, stored and drawn."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pillow

from pipeline.decoding import Decoder, Header, picture, planes
from pipeline.errors import UserError
from pipeline.frames import selection
from pipeline.frames.course import Course, run_pass
from pipeline.frames.extract import extract_frames
from pipeline.frames.fit import fit
from pipeline.frames.reference import reference_indices, strength, thumbnail
from pipeline.frames.sampling import sample_evaluation, sample_training
from pipeline.frames.selection import TOUCHING, Kept, Pool, difference, kept_count, thin, uniform_indices
from pipeline.frames.store import FrameStore
from pipeline.frames.subtraction import subtract
from pipeline.physiclear.catalogue import Catalogue
from pipeline.sections import FramesConfig
from tests.conftest import encode, moving_square, write_video

CONFIG = FramesConfig(size=16)


def flashing(count: int) -> list[np.ndarray]:
    """Black and white by turns: uint8 arithmetic would wrap 0 - 255 around to 1."""
    return [np.full((30, 40, 3), 255 * (i % 2), np.uint8) for i in range(count)]


def constant(count: int, value: int = 77) -> list[np.ndarray]:
    return [np.full((30, 40, 3), value, np.uint8)] * count


def pressing(count: int, seed: int = 0, width: int = 80, height: int = 60) -> list[np.ndarray]:
    """Still for a fifth of the time, then bumps of changing place and depth come and go."""
    rng = np.random.default_rng(seed)
    ground = 90 + 20 * np.mgrid[0:height, 0:width][1] / width
    y, x = np.mgrid[0:height, 0:width]
    frames = []
    for i in range(count):
        depth = 60 * max(0.0, math.sin(math.pi * (i / count - 0.2) / 0.8))
        phase = 2 * math.pi * (i // 4) / 7
        bump = depth * np.sin(x / 3 + phase) * np.exp(-(((x - width / 2) / 18) ** 2) - ((y - height / 2) / 14) ** 2)
        noise = rng.normal(0, 0.7, (height, width))
        grey = np.clip(ground + bump + noise, 0, 255)
        frames.append(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8))
    return frames


def frames_of(path: Path) -> list[av.VideoFrame]:
    with Decoder(path) as decoder:
        return list(decoder.frames())


def chosen(course: Course) -> list[tuple[int, float]]:
    return [(k.index, k.score) for k in course.kept]


def salience(frames: Sequence[np.ndarray], fraction: str) -> list[tuple[int, float]]:
    """The paper's rule in plain int64 arithmetic and a stable sort, from planes of brightness."""
    stack = np.stack(frames).astype(np.int64)
    scores = np.abs(stack[1:] - stack[:-1]).sum(axis=(1, 2))
    if len(scores) == 0:
        return [(0, 0)]
    count = -(-Fraction(fraction) * len(scores) // 1)
    best = sorted(np.argsort(-scores, kind="stable")[: int(count)])
    return [(int(i) + 1, int(scores[i])) for i in best]


def luma(path: Path) -> list[np.ndarray]:
    return [planes(frame)[0].copy() for frame in frames_of(path)]


@pytest.mark.parametrize(
    "frames",
    [moving_square(40), moving_square(3), flashing(11), constant(9), moving_square(1), moving_square(9, 1, 98, 17)],
)
@pytest.mark.parametrize("fraction", ["0.01", "0.07", "0.3", "1.0"])
def test_salience_equals_the_reference(tmp_path: Path, frames: list[np.ndarray], fraction: str) -> None:
    path = write_video(tmp_path / "v.avi", frames)
    course = run_pass(path, FramesConfig(size=16, fraction=float(fraction)))
    assert course.frames == len(frames)
    assert chosen(course) == salience(luma(path), fraction)
    for kept in course.kept:
        np.testing.assert_array_equal(kept.image, fit(frames_of(path)[kept.index], CONFIG))


values_and_count = st.integers(1, 30).flatmap(
    lambda n: st.tuples(st.lists(st.sampled_from([0, 1, 127, 255]), min_size=n, max_size=n), st.integers(1, n))
)


@given(values_and_count)
def test_ties_go_to_the_earlier_frame(case: tuple[list[int], int]) -> None:
    scores, capacity = case
    pool = Pool(capacity, CONFIG)
    frame = av.VideoFrame.from_ndarray(np.full((24, 16), 128, np.uint8), format="yuv420p")
    for index, score in enumerate(scores):
        pool.offer(score, index, frame)
    best = sorted(sorted(range(len(scores)), key=lambda i: -scores[i])[:capacity])
    assert [(k.index, k.score) for k in pool.kept()] == [(i, scores[i]) for i in best]


def test_a_pool_of_nothing_keeps_nothing() -> None:
    pool = Pool(0, CONFIG)
    pool.offer(1.0, 0, av.VideoFrame(16, 16, "yuv420p"))
    assert pool.kept() == []


@pytest.mark.parametrize("name", ["salient", "release", "contact", "adaptive", "uniform"])
def test_what_is_held_in_memory_changes_nothing(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "v.avi", pressing(40))
    config = FramesConfig(size=16, selection=name)
    held = run_pass(path, config).kept
    monkeypatch.setattr(selection, "HELD_BYTES", 0)
    at_once = run_pass(path, config).kept
    assert [(k.index, k.score) for k in held] == [(k.index, k.score) for k in at_once]
    for one, other in zip(held, at_once, strict=True):
        np.testing.assert_array_equal(one.image, other.image)


def test_white_to_black_is_the_greatest_difference() -> None:
    black, white = (frame[..., 0] for frame in flashing(2))
    assert difference(black, white) == difference(white, black) == 255 * 30 * 40
    large = np.full((4320, 7680), 255, np.uint8)
    assert difference(large, np.zeros_like(large)) == 255 * large.size, "exact beyond 32 bits"
    padded = np.zeros((30, 64), np.uint8)
    padded[:, 40:] = 99
    assert difference(padded[:, :40], white) == 255 * 30 * 40, "what stands behind a line's end does not count"


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32))
def test_differences_are_exact(height: int, width: int, seed: int) -> None:
    one, other = np.random.default_rng(seed).integers(0, 256, (2, height, width), np.uint8)
    assert difference(one, other) == np.abs(one.astype(np.int64) - other).sum()


@pytest.mark.parametrize(("frames", "fraction", "count"), [(1, 0.3, 1), (2, 0.3, 1), (3, 0.3, 1), (101, 0.3, 30)])
def test_top_thirty_percent(frames: int, fraction: float, count: int) -> None:
    assert kept_count(frames, FramesConfig(fraction=fraction)) == count


def test_the_fraction_is_taken_as_written() -> None:
    assert math.ceil(0.07 * 100) == 8, "what floating point would say"
    assert kept_count(101, FramesConfig(fraction=0.07)) == 7
    assert kept_count(100, FramesConfig(fraction=0.07, selection="uniform")) == 7
    assert int(0.29 * 100) == 28 == kept_count(100, FramesConfig(fraction=0.29, selection="release")), "as published"


@given(st.integers(2, 2000), st.floats(0.001, 1), st.sampled_from(["salient", "uniform", "contact", "adaptive"]))
def test_as_many_as_the_fraction_rounded_up(frames: int, fraction: float, name: str) -> None:
    count = kept_count(frames, FramesConfig(fraction=fraction, selection=name))
    candidates = frames - (name == "salient")
    assert 1 <= count <= candidates
    assert count - 1 < Fraction(str(fraction)) * candidates <= count


def published(path: Path, promised: int) -> list[tuple[int, int]]:
    """utils/process_dataset.py again: (frame saved, changed pixels), from OpenCV's frames and the header's count."""
    capture = cv2.VideoCapture(str(path))
    there, before = capture.read()
    earlier = cv2.cvtColor(before, cv2.COLOR_BGR2GRAY)
    scores = []
    for i in range(1, promised):
        there, frame = capture.read()
        if not there:
            break
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        scores.append((i, int(np.count_nonzero(cv2.absdiff(grey, earlier)))))
        earlier = grey
    best = sorted(scores, key=lambda item: item[1], reverse=True)[: int(0.3 * promised)]
    return sorted((i - 1, score) for i, score in best) if len(best) >= 5 else []


@pytest.mark.parametrize("count", [1, 3, 16, 17, 40])
@pytest.mark.parametrize("header", [-14, 0, 7])
@pytest.mark.parametrize("make", [moving_square, pressing, constant])
def test_the_published_rule(
    tmp_path: Path, count: int, header: int, make: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert callable(make)
    path = write_video(tmp_path / "v.avi", make(count))
    promised = max(1, count + header)
    config = FramesConfig(size=16, selection="release")
    course = run_pass(path, config, promised)
    assert chosen(course) == published(path, promised)
    for kept in course.kept:
        np.testing.assert_array_equal(kept.image, fit(frames_of(path)[kept.index], config))


@given(st.integers(1, 500), st.integers(1, 500))
def test_uniform_places(frames: int, count: int) -> None:
    count = min(frames, count)
    places = uniform_indices(frames, count)
    assert len(set(places)) == count
    assert places == sorted(places)
    if count == 1:
        assert places == [frames // 2]
    else:
        exact = np.linspace(0, frames - 1, count)
        assert (places[0], places[-1]) == (0, frames - 1)
        assert np.abs(np.array(places) - exact).max() < 1
        assert np.ptp(np.diff(places)) <= 1


@pytest.mark.parametrize(("count", "fraction"), [(1, 0.3), (2, 0.3), (7, 0.3), (30, 0.1), (30, 1.0)])
def test_uniform_frames(tmp_path: Path, count: int, fraction: float) -> None:
    path = write_video(tmp_path / "v.avi", moving_square(count))
    config = FramesConfig(size=16, selection="uniform", fraction=fraction)
    kept = run_pass(path, config).kept
    assert [k.index for k in kept] == uniform_indices(count, kept_count(count, config))
    for k in kept:
        np.testing.assert_array_equal(k.image, fit(frames_of(path)[k.index], config))


def strengths(path: Path) -> list[float]:
    """Strength of contact of every frame by its definition, in float64; those of the reference count as untouched."""
    thumbs = [thumbnail(frame).astype(np.float64) for frame in frames_of(path)]
    first = reference_indices(len(thumbs))
    still = np.rint(np.mean([thumbs[i] for i in first], axis=0))
    return [
        -1.0 if i <= first[-1] else np.abs(t - still).mean() - np.abs((t - still).mean(axis=(0, 1))).mean()
        for i, t in enumerate(thumbs)
    ]


@pytest.mark.parametrize("fraction", [0.05, 0.3])
@pytest.mark.parametrize("seed", [0, 1])
def test_contact_frames_are_those_most_unlike_the_reference(tmp_path: Path, fraction: float, seed: int) -> None:
    path = write_video(tmp_path / "v.avi", pressing(50, seed))
    course = run_pass(path, FramesConfig(size=16, selection="contact", fraction=fraction))
    expected = strengths(path)
    best = sorted(sorted(range(50), key=lambda i: -expected[i])[: math.ceil(fraction * 50)])
    assert [k.index for k in course.kept] == best
    assert [k.score for k in course.kept] == pytest.approx([expected[i] for i in best], abs=1e-9)
    assert course.contact == pytest.approx(max(expected), abs=1e-9)


def gap(one: Kept, other: Kept) -> float:
    assert one.thumb is not None
    assert other.thumb is not None
    return strength(one.thumb, other.thumb)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("tolerance", [0.0, 0.3, 0.7, 2.0])
def test_adaptive_frames_cover_the_contact_and_differ_from_each_other(
    tmp_path: Path, seed: int, tolerance: float
) -> None:
    path = write_video(tmp_path / "v.avi", pressing(60, seed))
    # At no tolerance at all, nothing that is in contact is thinned out but what noise could have made.
    pool = run_pass(path, FramesConfig(size=16, selection="adaptive", tolerance=0.0)).kept
    course = run_pass(path, FramesConfig(size=16, selection="adaptive", tolerance=tolerance))
    noise = min(course.strengths)
    reach = max(k.score for k in pool) - noise
    near = tolerance * reach + math.sqrt(2) * noise
    taken = {k.index: k for k in course.kept}
    assert list(taken) == sorted(taken)
    assert set(taken) <= {k.index for k in pool}
    assert len(taken) <= kept_count(60, FramesConfig())
    assert all(k.score - noise >= TOUCHING * reach for k in course.kept)
    assert all(gap(a, b) > near for a, b in itertools.combinations(taken.values(), 2))
    assert all(min(gap(k, t) for t in taken.values()) <= near for k in pool if k.index not in taken)


@given(st.integers(1, 12), st.integers(0, 2**32), st.floats(0, 3), st.floats(0, 20))
def test_what_is_thinned_out_looks_like_what_is_left(count: int, seed: int, tolerance: float, noise: float) -> None:
    rng = np.random.default_rng(seed)
    kept = made_up(
        [rng.integers(0, 256, (4, 5, 3), np.uint8) for _ in range(count)], rng.uniform(0, 60, count).tolist()
    )
    taken = thin(kept, tolerance, noise)
    reach = max(0.0, max(k.score for k in kept) - noise)
    near = tolerance * reach + math.sqrt(2) * noise
    assert [k.index for k in taken] == sorted({k.index for k in taken})
    assert all(gap(a, b) > near - 1e-9 for a, b in itertools.combinations(taken, 2))
    for k in kept:
        if k not in taken and k.score - noise >= TOUCHING * reach:
            assert min(gap(k, t) for t in taken) <= near + 1e-9


def made_up(thumbs: Sequence[np.ndarray], scores: Sequence[float]) -> list[Kept]:
    return [Kept(i, s, np.zeros((1, 1, 3), np.uint8), t) for i, (t, s) in enumerate(zip(thumbs, scores, strict=True))]


@given(st.integers(1, 12), st.integers(0, 2**32), st.floats(0, 3), st.floats(0, 3), st.floats(0, 20))
def test_less_tolerance_keeps_more(count: int, seed: int, one: float, other: float, noise: float) -> None:
    """Whatever is taken, a lower tolerance takes it too: it goes on where the higher one stopped."""
    rng = np.random.default_rng(seed)
    thumbs = [rng.integers(0, 256, (4, 5, 3), np.uint8) for _ in range(count)]
    kept = made_up(thumbs, rng.uniform(0, 60, count).tolist())
    less, more = sorted((one, other))
    wide, narrow = ({k.index for k in thin(kept, t, noise)} for t in (less, more))
    assert narrow <= wide
    strongest = max(kept, key=lambda k: k.score)
    assert strongest.index in narrow
    reach = max(0.0, strongest.score - noise)
    assert all(kept[i].score - noise >= TOUCHING * reach for i in wide - {strongest.index})


@pytest.mark.parametrize("name", ["contact", "adaptive", "uniform", "salient"])
@pytest.mark.parametrize("frames", [constant(30), constant(30, 0), constant(30, 255), constant(1), constant(2)])
def test_without_contact_something_is_kept(tmp_path: Path, name: str, frames: list[np.ndarray]) -> None:
    path = write_video(tmp_path / "v.avi", frames)
    config = FramesConfig(size=16, selection=name)
    kept = run_pass(path, config).kept
    assert 1 <= len(kept) <= kept_count(len(frames), config)
    assert all(k.score == 0 for k in kept)
    if name == "adaptive":
        assert len(kept) == 1, "more of the same adds nothing"


def test_a_header_without_a_number_of_frames(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.mkv", pressing(12))
    assert Decoder(path).header == Header(0, 25.0)
    for name in ("salient", "uniform", "contact", "adaptive"):
        assert len(run_pass(path, FramesConfig(size=16, selection=name)).kept) == 1
    assert run_pass(path, FramesConfig(size=16, selection="release")).kept == []


def pillow(image: np.ndarray, size: int, mode: str) -> np.ndarray:
    """The central square or all of a picture, by PIL's antialiased bicubic filter."""
    height, width = image.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    if mode == "crop":
        image = image[top : top + side, left : left + side]
    return np.asarray(Pillow.fromarray(np.ascontiguousarray(image)).resize((size, size), Pillow.Resampling.BICUBIC))


def scene(height: int, width: int) -> np.ndarray:
    """About four waves a side in BGR: whatever it is resized to, pixels are small against them."""
    y, x = np.mgrid[0:height, 0:width] * 240 / min(height, width)
    waves = [120 + 60 * np.sin(x / 9 + c) * np.cos(y / 11) + 25 * np.sin((x + y) / 40) for c in range(3)]
    return np.stack(waves, axis=2).astype(np.uint8)


@pytest.mark.parametrize(
    ("height", "width", "size"),
    [(240, 320, 64), (240, 320, 224), (480, 640, 224), (321, 241, 64), (97, 130, 48), (480, 640, 48), (1080, 600, 112)],
)
@pytest.mark.parametrize("mode", ["crop", "squash"])
@pytest.mark.parametrize("pixels", ["yuv420p", "yuv422p", "yuv444p", "yuv411p", "yuv440p"])
def test_fitted_frames_are_near_a_bicubic_resize(
    tmp_path: Path, height: int, width: int, size: int, mode: str, pixels: str
) -> None:
    """At most 2 of 255 steps apart on average; 4 where odd sides shift a small picture's colour by half a pixel."""
    (frame,) = frames_of(encode(tmp_path / "v.mkv", [scene(height, width)], "ffv1", pixels))
    expected = pillow(picture(frame)[..., ::-1], size, mode).astype(int)
    found = fit(frame, FramesConfig(size=size, fit=mode)).astype(int)
    assert np.abs(found - expected).mean() <= (4 if height == 97 else 2)
    assert np.quantile(np.abs(found - expected), 0.99) <= 16


@pytest.mark.parametrize(
    ("height", "width"), [(36, 48), (48, 36), (17, 97), (240, 321), (5, 5), (1, 9), (1, 1), (2, 2), (3, 200)]
)
@pytest.mark.parametrize("pixels", ["yuv420p", "yuv422p", "yuv444p", "yuv410p", "yuv411p", "yuv440p"])
@pytest.mark.parametrize("mode", ["crop", "squash"])
def test_one_colour_fills_every_square(height: int, width: int, pixels: str, mode: str) -> None:
    frame = av.VideoFrame(width, height, pixels)
    for plane, value in zip(frame.planes, (100, 90, 200), strict=True):
        plane.update(bytes([value]) * plane.buffer_size)
    expected = (1.164 * 84 + 1.596 * 72, 1.164 * 84 + 0.392 * 38 - 0.813 * 72, 1.164 * 84 - 2.017 * 38)
    for size in (16, 64):
        image = fit(frame, FramesConfig(size=size, fit=mode))
        assert (image.shape, image.dtype) == ((size, size, 3), np.uint8)
        assert np.abs(image - np.array(expected)).max() <= 1


@pytest.mark.parametrize("pixels", ["yuv420p", "yuv422p", "yuv444p", "yuv411p"])
def test_crop_takes_the_centre_and_squash_takes_all(tmp_path: Path, pixels: str) -> None:
    """In colour as in brightness, also where colour is halved one way only."""
    image = np.zeros((32, 96, 3), np.uint8)
    image[:, 32:64] = (30, 40, 250)
    (frame,) = frames_of(encode(tmp_path / "v.mkv", [image], "ffv1", pixels))
    cropped = fit(frame, FramesConfig(size=32, fit="crop"))
    assert np.abs(cropped[:, 4:-4].astype(int) - (250, 40, 30)).max() <= 8
    squashed = fit(frame, FramesConfig(size=24, fit="squash"))
    assert squashed[..., 0].mean() == pytest.approx(250 / 3, abs=4)
    assert squashed[12, 12, 0] > 230 > 20 > squashed[12, 2, 0]


@given(st.integers(1, 400), st.integers(1, 64), st.integers(0, 2**32))
def test_training_samples(count: int, k: int, seed: int) -> None:
    drawn = sample_training(count, k, random.Random(seed))
    assert len(drawn) == k
    assert list(drawn) == sorted(drawn)
    assert set(drawn) <= set(range(count))
    assert len(set(drawn)) == k or count < k
    assert drawn == sample_training(count, k, random.Random(seed))


@given(st.integers(1, 400), st.integers(1, 64))
def test_evaluation_samples_are_uniform_from_the_first(count: int, k: int) -> None:
    drawn = sample_evaluation(count, k)
    assert len(drawn) == k
    assert drawn[0] == 0
    assert drawn[-1] < count
    gaps = [b - a for a, b in itertools.pairwise(drawn)]
    assert all(between in (count // k, -(-count // k)) for between in gaps)


def test_every_kept_frame_is_drawn_equally_often() -> None:
    rng = random.Random(0)
    counts = np.zeros(10)
    for _ in range(4000):
        counts[list(sample_training(10, 5, rng))] += 1
    assert counts == pytest.approx(2000, rel=0.08)


def test_the_store_gives_pictures_with_and_without_the_reference(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue
) -> None:
    found = extract_frames(tiny_videos, catalogue, CONFIG, tmp_path, tmp_path / "partial")
    plain, subtracted = FrameStore(tmp_path), FrameStore(tmp_path, "subtract")
    assert plain.size == subtracted.size == 16
    references = np.load(tmp_path / "references.npy")
    for place, video in enumerate(found.videos):
        rows = [f.row for f in found.frames if f.video_id == video.video_id]
        assert plain.rows(video.video_id) == rows
        np.testing.assert_array_equal(plain.pictures(video.video_id), plain.pixels[rows])
        np.testing.assert_array_equal(
            subtracted.pictures(video.video_id), subtract(np.asarray(plain.pixels[rows]), references[place])
        )
        drawn = sample_evaluation(len(rows), 5)
        np.testing.assert_array_equal(
            subtracted.pictures(video.video_id, drawn), subtracted.pictures(video.video_id)[list(drawn)]
        )


@pytest.mark.parametrize(("file", "reference"), [("frames.npy", "none"), ("references.npy", "subtract")])
def test_a_store_with_a_row_too_few_is_an_error(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue, file: str, reference: str
) -> None:
    extract_frames(tiny_videos, catalogue, CONFIG, tmp_path, tmp_path / "partial")
    np.save(tmp_path / file, np.load(tmp_path / file)[:-1])
    with pytest.raises(UserError, match="differ in length; run"):
        FrameStore(tmp_path, "subtract" if reference == "subtract" else "none")


@pytest.mark.real
@pytest.mark.parametrize("name", ["hairbrush_bristles_side_4", "tv_remote_back_3", "rice_spatula_base_1"])
def test_real_frames(real_data: Path, name: str) -> None:
    path = real_data / f"{name}.mov"
    assert chosen(run_pass(path, FramesConfig(size=64))) == salience(luma(path), "0.3")
    promised = Decoder(path).header.frames
    assert chosen(run_pass(path, FramesConfig(size=64, selection="release"))) == published(path, promised)
    for frame in frames_of(path)[::40]:
        expected = pillow(picture(frame)[..., ::-1], 64, "crop").astype(int)
        assert np.abs(fit(frame, FramesConfig(size=64)).astype(int) - expected).mean() < 1.5
