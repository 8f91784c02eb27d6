"""What comes out of the decoder and how frames become squares, against OpenCV, PIL and the textbook's colours."""

import multiprocessing
import shutil
import struct
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import FramesConfig
from pipeline.use.media import count_frames
from pipeline.videos.decoding import Decoder, Header, fit, picture, planes, to_rgb, turns
from pipeline.videos.film import KEY_EVERY, write_film
from tests.conftest import HUNG, encode, moving_square, refused, write_video
from tests.frame_rules import decode, frames_of, pillow, scanned

ONE = 1 << 16
TURNED = {90: (0, -1, 1, 0), 180: (-1, 0, 0, -1), 270: (0, 1, -1, 0)}
MIRRORED = {0: (-1, 0, 0, 1), 90: (0, 1, 1, 0), 180: (1, 0, 0, -1), 270: (0, -1, -1, 0)}
"""Degrees against the clock, after mirroring or not, and a, b, c and d of a display matrix (ISO 14496-12, 8.3.2): it
shows the pixel at (p, q) at (a p + c q, b p + d q), moved into the picture."""


def opencv(path: Path) -> list[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1])
    return frames


def gradient(height: int, width: int) -> np.ndarray:
    """A smooth picture in BGR: halved colour loses nothing of it."""
    y, x = np.mgrid[0:height, 0:width] / [[[max(1, height - 1)]], [[max(1, width - 1)]]]
    return np.stack([40 + 150 * x, 60 + 130 * y, 200 - 120 * x * y], axis=2).astype(np.uint8)


def waves(height: int, width: int) -> np.ndarray:
    """About four waves a side in BGR: whatever it is resized to, pixels are small against them."""
    y, x = np.mgrid[0:height, 0:width] * 240 / min(height, width)
    channels = [120 + 60 * np.sin(x / 9 + c) * np.cos(y / 11) + 25 * np.sin((x + y) / 40) for c in range(3)]
    return np.stack(channels, axis=2).astype(np.uint8)


@pytest.mark.parametrize(("count", "width", "height"), [(1, 48, 36), (40, 48, 36), (3, 34, 98)])
def test_pictures_of_motion_jpeg_are_opencvs_bit_for_bit(tmp_path: Path, count: int, width: int, height: int) -> None:
    path = write_video(tmp_path / "v.avi", moving_square(count, 3, width, height))
    expected = opencv(path)
    np.testing.assert_array_equal(list(decode(path)), expected)
    with Decoder(path) as decoder:
        assert decoder.header == Header(len(expected), 25.0)
    views = [planes(frame)[0] for frame in frames_of(path)]
    np.testing.assert_array_equal(views, [planes(frame)[0].copy() for frame in frames_of(path)], "views keep frames")


@pytest.mark.parametrize(("codec", "pixels", "suffix"), [("libx264", "yuv420p", "mp4"), ("ffv1", "yuv444p", "mkv")])
@pytest.mark.parametrize(("transfer", "hdr"), [(0, False), (1, False), (16, True), (18, True)])
def test_hdr_is_known(tmp_path: Path, codec: str, pixels: str, suffix: str, transfer: int, hdr: bool) -> None:
    with Decoder(encode(tmp_path / f"v.{suffix}", moving_square(3), codec, pixels, transfer=transfer)) as decoder:
        assert decoder.header.hdr == hdr


@pytest.mark.parametrize(
    ("codec", "pixels", "suffix"),
    [
        *(("mjpeg", "yuvj420p", "avi"), ("mjpeg", "yuvj422p", "avi"), ("mjpeg", "yuvj444p", "mov")),
        *(("ffv1", pixels, "mkv") for pixels in ("yuv420p", "yuv422p", "yuv444p", "gray", "bgr0")),
        *(("mpeg4", "yuv420p", "mov"), ("rawvideo", "bgr24", "avi"), ("png", "rgb24", "mov")),
    ],
)
def test_pictures_follow_range_and_format(tmp_path: Path, codec: str, pixels: str, suffix: str) -> None:
    for height, width in ((13, 17), (97, 18)):
        path = encode(tmp_path / f"v.{suffix}", [gradient(height, width)[::s] for s in (1, -1, 1)], codec, pixels)
        expected, found = np.stack(opencv(path)).astype(int), np.stack(list(decode(path)))
        assert found.shape == expected.shape == (3, height, width, 3)
        assert np.abs(found - expected).max() <= 12, "where sides are odd, decoders differ in how they spread colour"
        assert np.abs(found - expected).mean() <= 1.2
    (frame,) = frames_of(encode(tmp_path / f"w.{suffix}", [gradient(48, 64)], codec, pixels))
    for size in (16, 96):
        expected = cv2.resize(picture(frame)[:, 8:56, ::-1], (size, size), interpolation=cv2.INTER_AREA).astype(int)
        error = np.abs(fit(frame, FramesConfig(pixels=size)) - expected)
        # Twice the size and bent edges: a picture enlarged in blocks is off by a step or two of the gradient.
        assert error.mean() < 2
        assert error.max() <= 8
    # Full range or not: 0 is black, 255 is white; the encoder's own rounding takes up to 5 steps.
    for value in (0, 16, 77, 128, 235, 255):
        (frame,) = frames_of(encode(tmp_path / f"g.{suffix}", [np.full((32, 32, 3), value, np.uint8)], codec, pixels))
        shown = picture(frame)[0, 0, ::-1].astype(int)
        assert np.abs(shown - value).max() <= 5
        assert np.abs(fit(frame, FramesConfig(pixels=16)) - shown).max() <= 2


@given(st.tuples(st.integers(16, 235), st.integers(16, 240), st.integers(16, 240)))
def test_colours_are_those_of_the_recommendation(yuv: tuple[int, int, int]) -> None:
    """ITU-R BT.601 with its constants as they are printed in textbooks."""
    y, u, v = yuv[0] - 16, yuv[1] - 128, yuv[2] - 128
    limited = [1.164384 * y + 1.596027 * v, 1.164384 * y - 0.391762 * u - 0.812968 * v, 1.164384 * y + 2.017232 * u]
    full = [yuv[0] + 1.402 * v, yuv[0] - 0.344136 * u - 0.714136 * v, yuv[0] + 1.772 * u]
    for pixels, rgb in (("yuv420p", limited), ("yuvj420p", full)):
        found = to_rgb(np.full((1, 1, 3), yuv, np.uint8), av.VideoFrame(2, 2, pixels))[0, 0]
        assert found == pytest.approx(np.clip(rgb, 0, 255), abs=1)


def test_a_stream_that_names_bt709_is_taken_at_its_word() -> None:
    frame, other = (av.VideoFrame.from_ndarray(np.full((48, 32), 110, np.uint8), format="yuv420p") for _ in range(2))
    other.colorspace = 1
    for each in (frame, other):
        found = fit(each, FramesConfig(pixels=16))
        assert np.abs(found.astype(int) - picture(each)[:16, :16, ::-1]).max() <= 2
    assert (fit(frame, FramesConfig(pixels=16)) != fit(other, FramesConfig(pixels=16))).any()


@pytest.mark.parametrize(("degrees", "matrix"), [*TURNED.items(), *MIRRORED.items()])
@pytest.mark.parametrize(("codec", "pixels", "mode"), [("mpeg4", "yuv420p", "crop"), ("png", "rgb24", "squash")])
def test_turned_and_mirrored_videos_are_upright(
    tmp_path: Path, degrees: int, matrix: tuple[int, int, int, int], codec: str, pixels: str, mode: str
) -> None:
    path = encode(tmp_path / "v.mov", [gradient(36, 48)] * 2, codec, pixels)
    stored, config = frames_of(path)[0], FramesConfig(pixels=32, fit=mode)
    data, (a, b, c, d) = bytearray(path.read_bytes()), matrix
    place = data.index(b"tkhd") + 4 + 40
    assert struct.unpack_from(">9i", data, place)[:5] == (ONE, 0, 0, 0, ONE)
    struct.pack_into(">9i", data, place, a * ONE, b * ONE, 0, c * ONE, d * ONE, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    frame = frames_of(path)[0]
    assert 90 * turns(frame) == degrees
    for before, shown in ((picture(stored), picture(frame)), (fit(stored, config), fit(frame, config))):
        q, p = np.mgrid[: before.shape[0], : before.shape[1]]
        x, y = a * p + c * q, b * p + d * q
        np.testing.assert_array_equal(shown[y - y.min(), x - x.min()], before)
        assert shown.size == before.size
        assert shown.flags.c_contiguous


@pytest.mark.parametrize(("aspect", "size"), [(Fraction(4, 3), (48, 27)), (Fraction(1, 2), (24, 36))])
def test_pixels_that_are_no_squares_are_made_squares(tmp_path: Path, aspect: Fraction, size: tuple[int, int]) -> None:
    path = encode(tmp_path / "v.mp4", [gradient(36, 48)] * 2, "mpeg4", "yuv420p", aspect=aspect)
    expected = cv2.resize(opencv(path)[0], size, interpolation=cv2.INTER_AREA).astype(int)
    assert np.abs(next(decode(path)) - expected).mean() < 4


@pytest.mark.parametrize("default", [0, 1])
def test_of_two_tracks_the_default_is_read(tmp_path: Path, default: int) -> None:
    with av.open(str(path := tmp_path / "v.mkv"), "w") as container:
        streams = [container.add_stream("mpeg4", rate=25, width=48, height=height) for height in (32, 64)]
        streams[default].disposition, streams[1 - default].disposition = map(av.stream.Disposition, (1, 0))
        for stream in streams:
            frame = av.VideoFrame.from_ndarray(gradient(stream.height, 48), format="bgr24")
            container.mux([*stream.encode(frame), *stream.encode(None)])
    assert [shown.shape for shown in decode(path)] == [((32, 64)[default], 48, 3)]
    assert count_frames(path, 60) == 1, "a server takes it"


def test_what_is_no_video_has_no_frames(tmp_path: Path) -> None:
    for number, content in enumerate((b"", b"no video at all " * 40, b"RIFF\0\0\0\0AVI LIST", bytes(5000))):
        (tmp_path / f"{number}.mov").write_bytes(content)
    with av.open(str(tmp_path / "v.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
    for path in (*tmp_path.iterdir(), tmp_path, tmp_path / "none.mov"):
        with Decoder(path) as decoder:
            assert list(decoder.frames()) == []
            assert decoder.header == Header()


@pytest.mark.parametrize(("codec", "suffix"), [("mpeg4", "mp4"), ("libx264", "mov"), ("mjpeg", "mov")])
@pytest.mark.parametrize(("first", "shown"), [(10, 40), (0, 60), (20, 40), (0, 1)])
def test_a_trimmed_file_promises_what_it_shows(tmp_path: Path, codec: str, suffix: str, first: int, shown: int) -> None:
    """A lossless trim leaves all frames in the file, with an edit list (ISO 14496-12, 8.6.6) of those shown."""
    path = tmp_path / f"rug_0.{suffix}"
    whole = list(decode(encode(path, moving_square(60), codec, "yuvj420p" if codec == "mjpeg" else "yuv420p")))
    data = bytearray(path.read_bytes())
    movie, media, edits = (data.index(name) for name in (b"mvhd", b"mdhd", b"elst"))
    ticks, fine = (struct.unpack_from(">I", data, at + 16)[0] for at in (movie, media))
    count, _, start = struct.unpack_from(">IIi", data, edits + 8)
    assert (len(whole), count) == (60, 1)
    struct.pack_into(">Ii", data, edits + 12, shown * ticks // 25, start + first * fine // 25)
    path.write_bytes(data)
    with Decoder(path) as decoder:
        assert decoder.header.frames == shown
        found = [picture(frame) for frame in decoder.frames()]
    np.testing.assert_array_equal(found, whole[first : first + shown])


@pytest.mark.parametrize(
    "name", ["2024-05-01T12:30:05_0.mp4", "concat:a|b.mp4", "http:a.mp4", "file:a.mp4", "pipe:0.mp4", "a:b/%d [1]?.mp4"]
)
def test_a_name_is_no_address(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    encode(plain := Path("plain.mp4"), moving_square(5), "mpeg4", "yuv420p")
    Path(name).parent.mkdir(exist_ok=True)
    shutil.copy(plain, name)
    np.testing.assert_array_equal(list(decode(Path(name))), list(decode(plain)))
    write_film(written := Path(name).with_stem("written:again"), moving_square(5), 25.0)
    assert len(list(decode(written))) == 5


def test_frames_that_damage_changed_are_left_out(tmp_path: Path) -> None:
    """Up to the next whole picture, one in twelve: those between are coded as changes to the damaged one."""
    path = encode(tmp_path / "v.mp4", moving_square(40), "mpeg4", "yuv420p")
    whole, data = list(decode(path)), bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packet = [*container.demux(video=0)][15]
    place = data.index(bytes(packet)) + packet.size // 3
    data[place : place + 16] = np.random.default_rng(0).bytes(16)
    path.write_bytes(data)
    assert len(opencv(path)) == 40, "the other decoder takes them"
    np.testing.assert_array_equal(list(decode(path)), whole[:15] + whole[24:])
    assert scanned(path).probe.header_frames == 40, "which the audit compares"


@pytest.mark.parametrize(
    ("height", "width", "size"), [(240, 320, 64), (240, 320, 224), (321, 241, 64), (97, 130, 48), (540, 300, 56)]
)
def test_fitted_frames_are_near_a_bicubic_resize(tmp_path: Path, height: int, width: int, size: int) -> None:
    """At most 2 of 255 steps apart on average; 4 where odd sides shift a small picture's colour by half a pixel."""
    for pixels in ("yuv420p", "yuv422p", "yuv444p", "yuv411p", "yuv440p"):
        (frame,) = frames_of(encode(tmp_path / "v.mkv", [waves(height, width)], "ffv1", pixels))
        shown = picture(frame)[..., ::-1]
        for mode in ("crop", "squash"):
            error = np.abs(fit(frame, FramesConfig(pixels=size, fit=mode)) - pillow(shown, size, mode).astype(int))
            assert error.mean() <= (4 if height == 97 else 2), (pixels, mode)
            assert np.quantile(error, 0.99) <= 16, (pixels, mode)


@pytest.mark.parametrize("pixels", ["yuv420p", "yuv444p", "yuv410p", "yuv411p"])
@pytest.mark.parametrize("mode", ["crop", "squash"])
def test_one_colour_fills_every_square(pixels: str, mode: str) -> None:
    expected = np.array([1.164 * 84 + 1.596 * 72, 1.164 * 84 + 0.392 * 38 - 0.813 * 72, 1.164 * 84 - 2.017 * 38])
    for height, width in ((36, 48), (17, 97), (240, 321), (1, 9), (1, 1), (2, 2), (3, 200)):
        frame = av.VideoFrame(width, height, pixels)
        for plane, value in zip(frame.planes, (100, 90, 200), strict=True):
            plane.update(bytes([value]) * plane.buffer_size)
        for size in (16, 64):
            image = fit(frame, FramesConfig(pixels=size, fit=mode))
            assert (image.shape, image.dtype) == ((size, size, 3), np.uint8)
            assert np.abs(image - expected).max() <= 1


RATES = (25.0, 29.97, 65.4, 90.011, 239.999, 1000.0)


@pytest.mark.parametrize(
    ("count", "fps", "size"), [(30, 10.0, (48, 64)), (13, 12.5, (47, 65)), *((2, fps, (48, 64)) for fps in RATES)]
)
def test_what_is_written_is_read(tmp_path: Path, count: int, fps: float, size: tuple[int, int]) -> None:
    """Files as the real videos are coded: MPEG-4 part 2, a whole picture every twelve; sides may be odd."""
    y, x = np.mgrid[: size[0], : size[1]]
    frames = [np.stack([x + 50, y + 60, x + y + 2 * n], axis=-1).astype(np.uint8) for n in range(count)]
    write_film(path := tmp_path / "a b.avi", frames, fps)
    with Decoder(path) as decoder:
        kinds = [frame.key_frame for frame in decoder.frames()]
        assert (decoder.header.frames, decoder.header.fps) == (count, pytest.approx(fps, rel=1e-5))
    assert kinds == [n % KEY_EVERY == 0 for n in range(count)]
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"
    error = np.stack(list(decode(path))).astype(int) - np.stack(frames)
    assert np.abs(error).mean() < 3, "colour is coded at half the resolution"
    with refused("cannot be written"):
        write_film(tmp_path / "none" / "a.avi", frames, fps)


def test_a_fork_decodes_after_its_parent_has(tmp_path: Path) -> None:
    """What converts pixels is kept from frame to frame: a fork would wait for ever for threads that it kept."""
    for name, side in (("parent", 512), ("child", 64)):
        encode(tmp_path / f"{name}.mkv", moving_square(2, 0, side, side), "ffv1", "bgr0")
    assert len(frames_of(tmp_path / "parent.mkv")) == 2
    child = multiprocessing.get_context("fork").Process(target=frames_of, args=(tmp_path / "child.mkv",))
    child.start()
    child.join(HUNG)
    child.kill()
    child.join()
    assert child.exitcode == 0
