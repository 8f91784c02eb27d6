"""Which frames are kept, by every rule, against slow second implementations."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import FramesConfig
from pipeline.videos.decoding import Decoder, fit, picture
from pipeline.videos.frames import selection
from pipeline.videos.frames.reference import reference_indices, thumbnail
from tests.conftest import moving_square, write_video
from tests.frame_rules import (
    CONFIG,
    Scanned,
    constant,
    frames_of,
    luma,
    pillow,
    pressing,
    promising,
    published,
    salience,
    scanned,
)


def assert_fitted(path: Path, found: Scanned) -> None:
    """Pictures of what was kept are the frames at their places, fitted."""
    raw = frames_of(path)
    for kept in found.kept:
        np.testing.assert_array_equal(kept.image, fit(raw[kept.index], CONFIG))


def chosen(found: Scanned) -> list[tuple[int, float]]:
    return [(k.index, k.score) for k in found.kept]


STEPS = [constant(1, value)[0] for value in [*[77] * 5, *np.random.default_rng(0).choice([0, 77, 255], 40)]]
"""Many differences are equal: of such the earlier frame is kept. The first frames are steady, or they are skipped."""


@pytest.mark.parametrize(
    "frames", [*(moving_square(n) for n in (101, 3, 1)), moving_square(9, 1, 98, 17), constant(9), STEPS]
)
def test_salience_equals_the_reference(tmp_path: Path, frames: list[np.ndarray]) -> None:
    path = write_video(tmp_path / "v.avi", frames)
    # 0.07 of the 100 differences of 101 frames is 7.000000000000001 in floating point, of which 8 would be kept.
    for fraction in ("0.01", "0.07", "0.3", "1.0"):
        found = scanned(path, FramesConfig(pixels=16, fraction=float(fraction)))
        assert found.probe.frames == len(frames)
        assert chosen(found) == salience(luma(path), fraction)
        assert_fitted(path, found)


@pytest.mark.parametrize("name", ["salient", "release", "contact"])
def test_what_is_held_in_memory_changes_nothing(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "v.avi", pressing(40))
    config = FramesConfig(pixels=16, selection=name)
    held = scanned(path, config)
    monkeypatch.setattr(selection, "HELD_BYTES", 0)
    at_once = scanned(path, config)
    assert chosen(held) == chosen(at_once)
    np.testing.assert_array_equal([k.image for k in held.kept], [k.image for k in at_once.kept])


@pytest.mark.parametrize("count", [1, 3, 16, 17, 40])
def test_the_published_rule(tmp_path: Path, count: int) -> None:
    for make in (moving_square, pressing, constant):
        path = write_video(tmp_path / "v.avi", make(count))
        for promised in (max(1, count - 14), count, count + 7):
            with promising(promised):
                found = scanned(path, FramesConfig(pixels=16, selection="release"))
            assert chosen(found) == published(path, promised)
            assert_fitted(path, found)


@pytest.mark.parametrize(("seed", "fraction"), [(0, 0.05), (1, 0.3)])
def test_contact_frames_are_those_most_unlike_the_reference(tmp_path: Path, seed: int, fraction: float) -> None:
    """By the definition of strength, in float64; frames of the reference count as untouched."""
    path = write_video(tmp_path / "v.avi", pressing(50, seed))
    found = scanned(path, FramesConfig(pixels=16, selection="contact", fraction=fraction))
    thumbs = np.array([thumbnail(frame) for frame in frames_of(path)], np.float64)
    first = list(reference_indices(50))
    change = thumbs - np.rint(thumbs[first].mean(axis=0))
    expected = np.abs(change).mean(axis=(1, 2, 3)) - np.abs(change.mean(axis=(1, 2))).mean(axis=1)
    expected[: first[-1] + 1] = -1
    best = sorted(np.argsort(-expected, kind="stable")[: math.ceil(fraction * 50)].tolist())
    assert [k.index for k in found.kept] == best
    assert [k.score for k in found.kept] == pytest.approx(expected[best], abs=1e-9)
    assert found.probe.contact == pytest.approx(expected.max(), abs=1e-9)


@pytest.mark.real
@pytest.mark.parametrize("name", ["hairbrush_bristles_side_4", "tv_remote_back_3", "rice_spatula_base_1"])
def test_real_frames(real_data: Path, name: str) -> None:
    path = real_data / f"{name}.mov"
    assert chosen(scanned(path, FramesConfig(pixels=64))) == salience(luma(path), "0.3")
    promised = Decoder(path).header.frames
    assert chosen(scanned(path, FramesConfig(pixels=64, selection="release"))) == published(path, promised)
    for frame in frames_of(path)[::40]:
        expected = pillow(picture(frame)[..., ::-1], 64, "crop").astype(int)
        assert np.abs(fit(frame, FramesConfig(pixels=64)).astype(int) - expected).mean() < 1.5
