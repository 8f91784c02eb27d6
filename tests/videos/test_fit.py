"""How frames are cropped or squashed to a square, against PIL."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from pipeline.config import FramesConfig
from pipeline.videos.decoding import picture
from pipeline.videos.frames.fit import fit
from tests.conftest import encode
from tests.frame_rules import frames_of, pillow


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
