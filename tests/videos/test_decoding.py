"""What comes out of the decoder, against OpenCV's and against the textbook's colours."""

from __future__ import annotations

import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import FramesConfig
from pipeline.videos.decoding import Decoder, Header, brightness, decode, picture, planes, to_rgb, turns
from pipeline.videos.frames.fit import fit
from tests.conftest import encode, moving_square, write_video

ONE = 1 << 16
TURNED = {90: (0, -ONE, ONE, 0), 180: (-ONE, 0, 0, -ONE), 270: (0, ONE, -ONE, 0)}
"""Degrees against the clock, and the first four numbers of a QuickTime display matrix."""
FORMATS = [
    ("mjpeg", "yuvj420p", "avi"),
    ("mjpeg", "yuvj422p", "avi"),
    ("mjpeg", "yuvj444p", "mov"),
    ("mpeg4", "yuv420p", "mov"),
    ("ffv1", "yuv420p", "mkv"),
    ("ffv1", "yuv422p", "mkv"),
    ("ffv1", "yuv444p", "mkv"),
    ("ffv1", "gray", "mkv"),
    ("ffv1", "bgr0", "mkv"),
    ("rawvideo", "bgr24", "avi"),
    ("png", "rgb24", "mov"),
]


def opencv(path: Path) -> list[np.ndarray]:
    """Frames by the other decoder."""
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1])
    return frames


def decoded(path: Path) -> list[av.VideoFrame]:
    with Decoder(path) as decoder:
        return list(decoder.frames())


def gradient(height: int, width: int) -> np.ndarray:
    """A smooth picture in BGR: halved colour loses nothing of it."""
    y, x = np.mgrid[0:height, 0:width] / [[[max(1, height - 1)]], [[max(1, width - 1)]]]
    return np.stack([40 + 150 * x, 60 + 130 * y, 200 - 120 * x * y], axis=2).astype(np.uint8)


def turn(path: Path, degrees: int) -> None:
    """Write a display matrix into the track header of a QuickTime file."""
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40
    a, b, c, d = TURNED[degrees]
    assert struct.unpack(">9i", data[matrix : matrix + 36])[:5] == (ONE, 0, 0, 0, ONE)
    data[matrix : matrix + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


@pytest.mark.parametrize("count", [1, 3, 40])
@pytest.mark.parametrize(("width", "height"), [(48, 36), (320, 240), (34, 98)])
def test_pictures_of_motion_jpeg_are_opencvs_bit_for_bit(tmp_path: Path, count: int, width: int, height: int) -> None:
    path = write_video(tmp_path / "v.avi", moving_square(min(count, 6) if width == 320 else count, 3, width, height))
    expected = opencv(path)
    found = list(decode(path))
    assert len(found) == len(expected)
    np.testing.assert_array_equal(found, expected)
    with Decoder(path) as decoder:
        assert decoder.header == Header(len(expected), 25.0)


@pytest.mark.parametrize(("codec", "pixels", "suffix"), FORMATS)
@pytest.mark.parametrize(("height", "width"), [(36, 48), (13, 17), (97, 18)])
def test_pictures_are_opencvs_within_a_few_steps(
    tmp_path: Path, codec: str, pixels: str, suffix: str, height: int, width: int
) -> None:
    path = encode(tmp_path / f"v.{suffix}", [gradient(height, width)[::s] for s in (1, -1, 1)], codec, pixels)
    expected = np.stack(opencv(path)).astype(int)
    found = np.stack(list(decode(path))).astype(int)
    assert found.shape == expected.shape == (3, height, width, 3)
    assert np.abs(found - expected).max() <= 12, "where sides are odd, decoders differ in how they spread colour"
    assert np.abs(found - expected).mean() <= 1.2


@pytest.mark.parametrize(("codec", "pixels", "suffix"), FORMATS)
@pytest.mark.parametrize("size", [16, 96])
def test_colours_of_fitted_frames_follow_range_and_format(
    tmp_path: Path, codec: str, pixels: str, suffix: str, size: int
) -> None:
    (frame,) = decoded(encode(tmp_path / f"v.{suffix}", [gradient(48, 64)], codec, pixels))
    expected = cv2.resize(picture(frame)[:, 8:56, ::-1], (size, size), interpolation=cv2.INTER_AREA).astype(int)
    found = fit(frame, FramesConfig(size=size)).astype(int)
    # Twice the size and bent edges: a picture enlarged in blocks is off by a step or two of the gradient.
    assert np.abs(found - expected).mean() < 2
    assert np.abs(found - expected).max() <= 8


@pytest.mark.parametrize("value", [0, 16, 77, 128, 235, 255])
@pytest.mark.parametrize(("codec", "pixels", "suffix"), FORMATS)
def test_grey_stays_grey(tmp_path: Path, codec: str, pixels: str, suffix: str, value: int) -> None:
    """Full range or not: 0 is black, 255 is white; the encoder's own rounding takes up to 5 steps."""
    (frame,) = decoded(encode(tmp_path / f"v.{suffix}", [np.full((32, 32, 3), value, np.uint8)], codec, pixels))
    shown, fitted = picture(frame)[0, 0, ::-1].astype(int), fit(frame, FramesConfig(size=16)).astype(int)
    assert np.abs(shown - value).max() <= 5
    assert np.abs(fitted - shown).max() <= 2


@given(st.tuples(st.integers(16, 235), st.integers(16, 240), st.integers(16, 240)))
def test_colours_are_those_of_the_recommendation(yuv: tuple[int, int, int]) -> None:
    """ITU-R BT.601 with its constants as they are printed in textbooks."""
    frame = av.VideoFrame(2, 2, "yuv420p")
    y, u, v = yuv[0] - 16, yuv[1] - 128, yuv[2] - 128
    rgb = [1.164384 * y + 1.596027 * v, 1.164384 * y - 0.391762 * u - 0.812968 * v, 1.164384 * y + 2.017232 * u]
    found = to_rgb(np.full((1, 1, 3), yuv, np.uint8), frame)[0, 0]
    assert found == pytest.approx(np.clip(rgb, 0, 255), abs=1)
    full = av.VideoFrame(2, 2, "yuvj420p")
    y, u, v = yuv[0], yuv[1] - 128, yuv[2] - 128
    rgb = [y + 1.402 * v, y - 0.344136 * u - 0.714136 * v, y + 1.772 * u]
    assert to_rgb(np.full((1, 1, 3), yuv, np.uint8), full)[0, 0] == pytest.approx(np.clip(rgb, 0, 255), abs=1)


def test_a_stream_that_names_bt709_is_taken_at_its_word() -> None:
    frame = av.VideoFrame.from_ndarray(np.full((48, 32), 110, np.uint8), format="yuv420p")
    other = av.VideoFrame.from_ndarray(np.full((48, 32), 110, np.uint8), format="yuv420p")
    other.colorspace = 1
    for each in (frame, other):
        found = fit(each, FramesConfig(size=16))
        assert np.abs(found.astype(int) - picture(each)[:16, :16, ::-1]).max() <= 2
    assert (fit(frame, FramesConfig(size=16)) != fit(other, FramesConfig(size=16))).any()


@pytest.mark.parametrize("degrees", TURNED)
@pytest.mark.parametrize(("codec", "pixels"), [("mpeg4", "yuv420p"), ("png", "rgb24")])
@pytest.mark.parametrize("mode", ["crop", "squash"])
def test_turned_videos_are_upright(tmp_path: Path, degrees: int, codec: str, pixels: str, mode: str) -> None:
    path = encode(tmp_path / "v.mov", [gradient(36, 48)] * 2, codec, pixels)
    upright = fit(decoded(path)[0], FramesConfig(size=32, fit=mode))
    turn(path, degrees)
    frame = decoded(path)[0]
    assert 90 * turns(frame) == degrees
    expected = opencv(path)[0].astype(int)
    assert np.abs(picture(frame).astype(int) - expected).max() <= 2, "OpenCV turns pictures by itself"
    assert picture(frame).shape == ((48, 36, 3) if degrees % 180 else (36, 48, 3))
    turned = fit(frame, FramesConfig(size=32, fit=mode))
    np.testing.assert_array_equal(turned, np.rot90(upright, degrees // 90))
    assert turned.flags.c_contiguous


@pytest.mark.parametrize(("height", "width"), [(13, 17), (1, 1), (2, 2), (97, 17), (5, 40)])
@pytest.mark.parametrize("pixels", ["yuv420p", "yuv422p", "yuv444p", "yuv410p", "yuv411p", "yuv440p"])
def test_planes_are_what_went_in(height: int, width: int, pixels: str) -> None:
    rng = np.random.default_rng(0)
    wide = {"yuv420p": 2, "yuv422p": 2, "yuv444p": 1, "yuv410p": 4, "yuv411p": 4, "yuv440p": 1}[pixels]
    high = {"yuv420p": 2, "yuv422p": 1, "yuv444p": 1, "yuv410p": 4, "yuv411p": 1, "yuv440p": 2}[pixels]
    frame = av.VideoFrame(width, height, pixels)
    written = []
    for plane in frame.planes:
        rows = rng.integers(0, 256, (plane.height, plane.line_size), np.uint8)
        plane.update(rows.tobytes())
        written.append(rows[:, : plane.width])
    chroma = (-(-height // high), -(-width // wide))
    assert [p.shape for p in planes(frame)] == [(height, width), chroma, chroma]
    for one, other in zip(planes(frame), written, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(brightness(frame), written[0])


def test_a_view_outlives_its_frame(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.avi", moving_square(30))
    views = [brightness(frame) for frame in decoded(path)]
    copies = [brightness(frame).copy() for frame in decoded(path)]
    np.testing.assert_array_equal(views, copies)


@pytest.mark.parametrize("content", [b"", b"no video at all " * 40, b"RIFF\0\0\0\0AVI LIST", bytes(5000)])
def test_what_is_no_video_has_no_frames(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "v.mov"
    path.write_bytes(content)
    with Decoder(path) as decoder:
        assert list(decoder.frames()) == []
        assert decoder.header == Header()
    assert list(decode(path)) == []
    assert list(decode(tmp_path / "gone.mov")) == []
    assert list(decode(tmp_path)) == [], "a folder"


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "v.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
    assert list(decode(tmp_path / "v.mkv")) == []


def test_damage_in_the_middle_costs_no_more_than_what_it_hits(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.avi", moving_square(40))
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = np.random.default_rng(0).bytes(3000)
    path.write_bytes(data)
    found, expected = list(decode(path)), opencv(path)
    assert 20 < len(found) < 41
    assert len(found) >= len(expected)


@pytest.mark.parametrize("suffix", ["mov", "mp4", "avi", "mkv"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_cut_off_file_gives_what_is_there(tmp_path: Path, suffix: str, share: float) -> None:
    whole = encode(tmp_path / f"w.{suffix}", moving_square(30), "mpeg4", "yuv420p").read_bytes()
    path = tmp_path / f"v.{suffix}"
    path.write_bytes(whole[: int(share * len(whole))])
    assert len(list(decode(path))) >= len(opencv(path))


@pytest.mark.real
def test_real_pictures_are_opencvs_bit_for_bit(real_data: Path) -> None:
    for name in ("hairbrush_bristles_side_4", "tv_remote_back_3"):
        np.testing.assert_array_equal(list(decode(real_data / f"{name}.mov")), opencv(real_data / f"{name}.mov"))
