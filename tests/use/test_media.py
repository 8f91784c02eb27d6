"""Videos that clients send: what is taken, what is refused, and at what cost."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import av
import pytest

from pipeline.config import FramesConfig
from pipeline.use.frames import read_touch
from pipeline.use.media import Gate, Limits, from_base64
from pipeline.videos.decoding import SUFFIXES, Decoder
from pipeline.videos.files import video_files
from tests.closure import ROOT
from tests.conftest import HUNG, refused
from tests.use.videos import avi_of_giant_jpegs, blank, claims_frames, claims_pixels, video

FRAMES = FramesConfig(pixels=32)


@pytest.fixture(scope="module")
def gate() -> object:
    with closing(Gate(Limits(frames=200, seconds=5, pixels=500_000, check_seconds=int(HUNG)))) as gate:
        yield gate


def test_base64_comes_back_with_and_without_a_head_and_nothing_else_does() -> None:
    data = bytes(range(256))
    text = base64.b64encode(data).decode()
    for head in ("", "data:video/mp4;base64,", "data:;base64,", "data:video/mp4;codecs=avc1;base64,"):
        assert from_base64(head + text) == data
    for bad in (
        *("", "data:video/mp4;base64,", "data:video/mp4;base64,AAA", "data:video/mp4;base64,AA AA", "AA\nAA", "ä"),
        *("file:///etc/passwd", "/etc/passwd", "http://127.0.0.1/a.mp4", "C:\\a.mov", "data:video/mp4,AAAA", "-_-_"),
        *("DATA:video/mp4;base64,AAAA", "concat:a|b", "pipe:0"),
    ):
        with refused("^video: ") as error:
            from_base64(bad)
        assert error.value.status == 422


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_video_is_one_for_the_server_for_ask_and_in_a_folder(gate: Gate, suffix: str, tmp_path: Path) -> None:
    codecs = {".mkv": "ffv1", ".webm": "libvpx", ".wmv": "wmv2", **dict.fromkeys((".avi", ".mjpg", ".mjpeg"), "mjpeg")}
    videos = [video(seed, suffix=suffix, codec=codecs.get(suffix, "mpeg4")) for seed in (1, 2)]
    named, other = tmp_path / f"rug_0{suffix.upper()}", tmp_path / "rug_0.gif"
    for path in (named, other):
        path.write_bytes(videos[0])
    assert video_files(tmp_path)[0] == [named]
    with refused("no video by its name"):
        read_touch(other, FRAMES, quiet=0)
    asked = read_touch(named, FRAMES, quiet=0)
    with Decoder(named) as decoder:
        assert decoder.header.frames in (0, 12)
    with gate.files(videos) as paths:
        assert [p.read_bytes() for p in paths] == videos
        served = read_touch(paths[0], FRAMES, quiet=0)
    assert not any(p.parent.exists() for p in paths)
    assert (served.frames == asked.frames).all()


@pytest.mark.parametrize(
    ("data", "status", "words"),
    [
        (lambda: claims_pixels(40_000, 40_000), 413, "pixels"),
        (lambda: claims_pixels(15_000, 15_000), 413, "pixels"),
        (lambda: blank(2, 1024, 1024), 413, "pixels"),
        (lambda: avi_of_giant_jpegs(15_000, 15_000), 422, "no frame"),
        (lambda: claims_frames(10**6), 413, "longer than 200 frames"),
        (lambda: claims_frames(10**8), 413, "longer than 200 frames|too much memory"),
        (lambda: blank(201), 413, "longer than 200 frames"),
        (lambda: b"hello", 422, "no video"),
        (lambda: video()[:300], 422, "no video"),
        (lambda: b"\x89PNG\r\n\x1a\n" + bytes(100), 422, "no video"),
        (lambda: bytes(1000), 422, "no video"),
    ],
)
def test_bombs_and_what_is_no_video(gate: Gate, data: Callable[[], bytes], status: int, words: str) -> None:
    with refused(f"^video 1: .*({words})") as error, gate.files([data()]):
        pass
    assert error.value.status == status
    assert "/tmp" not in str(error.value)
    with gate.files([video()]):
        pass


def test_a_playlist_cannot_read_another_file(gate: Gate, tmp_path: Path) -> None:
    (other := tmp_path / "secret.mp4").write_bytes(video())
    (playlist := tmp_path / "list.mov").write_text("ffconcat version 1.0\nfile secret.mp4\n")
    with av.open(str(playlist)) as container:
        assert next(container.decode(video=0)), "FFmpeg alone reads it"
    with Decoder(playlist) as decoder:
        assert list(decoder.frames()) == []
    hls = f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{other}\n#EXT-X-ENDLIST\n"
    for text in (hls, f"ffconcat version 1.0\nfile {other}\n"):
        with refused("no video"), gate.files([text.encode()]):
            pass


def test_a_checker_that_dies_or_takes_too_long_is_replaced(tmp_path: Path) -> None:
    """A pipe that nobody writes to takes for ever to open, as a decoder may take."""
    os.mkfifo(tmp_path / "endless.mov")
    with closing(Gate(Limits(check_seconds=1))) as gate:
        with refused("too long") as error:
            gate._check(tmp_path / "endless.mov", "video 1")
        assert error.value.status == 413
        gate.limits = Limits(check_seconds=int(HUNG))  # Of the next process.
        with gate.files([video()]):
            gate._checker.kill()
            gate._checker.wait()
        with gate.files([video()]):
            pass


LITTLE = """
from pipeline.use import media
media.SPARE_BYTES = 32 << 20
media.main()
try:
    bytes(64 << 20)
except MemoryError:
    print("limited")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux limits the memory of a process")
def test_bombs_take_no_memory(tmp_path: Path) -> None:
    """They are told from a good video within a tenth of what one claims, as the kernel gives no more."""
    videos = {"good": video(), "pixels": claims_pixels(15_000, 15_000), "frames": claims_frames(10**6)}
    for name, data in videos.items():
        (tmp_path / name).write_bytes(data)
    paths = "".join(f"{tmp_path / name}\n" for name in (*videos, "good"))
    command = [sys.executable, "-c", LITTLE, json.dumps({"check_seconds": int(HUNG)})]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, input=paths, env=env, capture_output=True, text=True, check=True)
    *answers, limited = done.stdout.splitlines()
    good, pixels, frames, again = (json.loads(answer)["message"] for answer in answers)
    assert (good, again, limited) == ("", "", "limited")
    assert "more than 10000000 pixels" in pixels
    assert "longer than 3000 frames" in frames
