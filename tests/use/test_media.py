"""Videos that clients send: what is taken, what is refused, and at what cost."""

import base64
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import av
import pytest

from pipeline.config import FramesConfig
from pipeline.use.frames import read_touch
from pipeline.use.media import Gate
from pipeline.use.protocol import from_base64
from pipeline.videos.decoding import SUFFIXES, Decoder
from pipeline.videos.files import video_files
from tests.conftest import HUNG, refused
from tests.use.videos import avi_of_giant_jpegs, blank, claims_frames, claims_pixels, video

FRAMES = FramesConfig(pixels=32)


@pytest.fixture(scope="module")
def gate() -> Iterator[Gate]:
    with closing(Gate(int(HUNG))) as gate:
        yield gate


def test_base64_comes_back_with_and_without_a_head_and_nothing_else_does() -> None:
    data = bytes(range(256))
    text = base64.b64encode(data).decode()
    for head in ("", "data:video/mp4;base64,", "data:;base64,", "data:video/mp4;codecs=avc1;base64,"):
        assert from_base64(head + text) == data
    broken = "data:video/mp4;base64,AAA", "data:video/mp4;base64,AA AA", "AA\nAA", "ä", "data:video/mp4,AAAA", "-_-_"
    for bad in (*broken, "file:///etc/passwd", "/etc/passwd", "http://127.0.0.1/a.mp4", "concat:a|b", "pipe:0"):
        with pytest.raises(ValueError, match="broken base64"):
            from_base64(bad)


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
    "data",
    [
        lambda: claims_pixels(40_000, 40_000),
        lambda: avi_of_giant_jpegs(15_000, 15_000),
        lambda: claims_frames(10**8),
        lambda: video()[:300],
        lambda: bytes(1000),
    ],
)
def test_bombs_and_what_is_no_video(gate: Gate, data: Callable[[], bytes]) -> None:
    with refused("video2.*no frame"), gate.files([video(), data()]):
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
        with refused("no frame"), gate.files([text.encode()]):
            pass


def test_a_checker_that_takes_too_long_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipe that nobody writes to takes for ever to open, as a decoder may take."""
    with closing(Gate(seconds=1)) as gate:
        with monkeypatch.context() as patch, refused("too long"):
            patch.setattr(Path, "write_bytes", lambda path, _: os.mkfifo(path))
            with gate.files([b""]):
                pass
        gate.seconds = int(HUNG)
        with gate.files([video()]):
            pass


@pytest.mark.skipif(sys.platform != "linux", reason="Linux limits the memory of a process")
def test_decoding_takes_no_more_memory_than_is_spared(gate: Gate) -> None:
    """A frame of 16 million pixels takes 24 MB, and FFmpeg holds several."""
    large = blank(4, 4000, 4000)
    with closing(Gate(int(HUNG), 64 << 20)) as small, refused("too much memory"), small.files([large]):
        pass
    with gate.files([large]):
        pass
