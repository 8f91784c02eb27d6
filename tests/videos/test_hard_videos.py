"""What hard videos do to the extraction: no contact, tiny pictures, lying headers, broken files."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import FramesConfig
from pipeline.core.records import Probe
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.decoding import Decoder, Header
from pipeline.videos.files import VideoFile
from pipeline.videos.frames.extract import Extraction
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.selection import kept_count
from tests.conftest import encode, moving_square, refused, write_video
from tests.frame_rules import Place, constant, luma, pressing, salience


def one(folder: Path, catalogue: Catalogue, selection: str = "salient") -> tuple[Extraction, Probe]:
    place = Place(folder, folder.parent, catalogue)
    found = place.extract(FramesConfig(pixels=16, selection=selection))
    (probe,) = found.probes
    numbers = [v for v in probe.model_dump().values() if isinstance(v, float)]
    assert all(map(math.isfinite, [*numbers, *probe.thumbnail, *probe.signature]))
    assert (len(probe.thumbnail), len(probe.signature)) == (6 * 8 * 3, 18 * 24)
    return found, probe


@pytest.mark.parametrize("selection", ["salient", "contact"])
@pytest.mark.parametrize(
    ("frames", "saturated"),
    [
        (constant(30), 0.0),
        (constant(30, 0), 1.0),
        (constant(30, 255), 1.0),
        (constant(2), 0.0),
        (moving_square(1), None),
        (moving_square(3), None),
    ],
    ids=["grey", "black", "white", "two", "one", "three"],
)
def test_hard_videos(
    tmp_path: Path, catalogue: Catalogue, frames: list[np.ndarray], saturated: float | None, selection: str
) -> None:
    write_video(tmp_path / "v" / "rug_0.avi", frames)
    found, probe = one(tmp_path / "v", catalogue, selection)
    assert probe.frames == len(frames)
    assert 1 <= probe.kept == len(found.frames) <= kept_count(len(frames), FramesConfig(selection=selection))
    if saturated is not None:
        assert probe.saturated == saturated
        assert (probe.contact, probe.contact_end, probe.starts_touching) == (0, 0, False)
        assert all(frame.score == 0 for frame in found.frames)


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 9), (13, 17), (97, 17)])
def test_tiny_and_odd_pictures(tmp_path: Path, catalogue: Catalogue, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (*size, 3), np.uint8) for _ in range(12)]
    encode(tmp_path / "v" / "rug_0.mkv", frames)
    found, probe = one(tmp_path / "v", catalogue)
    assert (probe.height, probe.width, probe.frames, probe.header_frames) == (*size, 12, 0)
    assert len(found.frames) == 4


def test_a_cut_off_video_keeps_what_decodes_and_warns(
    tmp_path: Path, catalogue: Catalogue, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_video(tmp_path / "v" / "rug_0.avi", moving_square(31))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with caplog.at_level(logging.WARNING):
        found, probe = one(tmp_path / "v", catalogue)
    (video,) = found.videos
    assert 5 < video.frames < 31 == probe.header_frames
    assert [(f.frame_index, f.score) for f in found.frames] == salience(luma(path), "0.3")
    assert "rug_0.avi" in caplog.text
    assert "31 frames in its header" in caplog.text


@pytest.mark.parametrize("selection", ["salient", "contact"])
def test_a_header_that_lies_changes_nothing(tmp_path: Path, selection: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "rug_0.avi", pressing(40))
    file, config = VideoFile(path, path.name, "rug", "rug_0"), FramesConfig(pixels=16, selection=selection)
    honest = scan(file, config)
    assert isinstance(honest, Scan)
    init, promised = Decoder.__init__, 0

    def lying(self: Decoder, path: Path) -> None:
        init(self, path)
        self.header = Header(promised, self.header.fps)

    monkeypatch.setattr(Decoder, "__init__", lying)
    for promised in (0, 1, 7, 39, 41, 4000):
        found = scan(file, config)
        assert isinstance(found, Scan)
        assert [(k.index, k.score) for k in found.kept] == [(k.index, k.score) for k in honest.kept]
        assert found.probe == honest.probe.model_copy(update={"header_frames": promised})
        np.testing.assert_array_equal([k.image for k in found.kept], [k.image for k in honest.kept])


def test_an_uneven_rate_is_measured(tmp_path: Path, catalogue: Catalogue) -> None:
    even, uneven = tmp_path / "even", tmp_path / "uneven"
    frames = pressing(48)
    encode(even / "rug_0.mkv", frames, milliseconds=[40 * i for i in range(48)])
    encode(uneven / "rug_0.mkv", frames, milliseconds=[40 * i if i < 24 else 960 + 120 * (i - 24) for i in range(48)])
    regular, irregular = one(even, catalogue)[1], one(uneven, catalogue)[1]
    assert regular.irregular == pytest.approx(1, abs=0.01)
    assert irregular.irregular == pytest.approx(3, abs=0.1)


def two_sizes(path: Path) -> None:
    """Motion JPEG in a row, each frame of its own size."""
    small, large = (write_video(path.parent / f"{w}.avi", moving_square(4, 0, w, 36)) for w in (48, 64))
    jpegs = []
    for file in (small, large):
        data = file.read_bytes()
        jpegs += [b"\xff\xd8\xff" + part for part in data.split(b"\xff\xd8\xff")[1:]]
        file.unlink()
    path.write_bytes(b"".join(jpeg[: jpeg.rindex(b"\xff\xd9") + 2] for jpeg in jpegs))


Make = Callable[[Path, Path], object]


@pytest.mark.parametrize(
    ("name", "make", "words"),
    [
        ("rug_0.mov", lambda path, _: path.touch(), "empty (0 bytes); copy it again"),
        ("rug_0.mov", lambda path, _: path.write_text("not a video at all" * 50), "no frame decodes"),
        ("rug_0.avi", lambda path, good: path.write_bytes(good.read_bytes()[:600]), "no frame decodes"),
        ("rug_0.mov", lambda path, _: path.symlink_to(path.parent / "gone.mov"), "unreadable"),
        ("rug_0.mjpg", lambda path, _: two_sizes(path), "frames of 2 sizes; convert it"),
    ],
    ids=["empty", "text", "header alone", "dead link", "two sizes"],
)
def test_files_that_are_no_good_are_named(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue, name: str, make: Make, words: str
) -> None:
    folder = tmp_path / "my vidéos 触覚"
    folder.mkdir()
    make(folder / name, tiny_videos / "rug_0.avi")
    with refused(f"^{re.escape(str(folder / name))}: .*{re.escape(words)}"):
        Place(folder, tmp_path, catalogue).extract()
