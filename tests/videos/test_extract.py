"""The extraction as a whole: what lies in its files, how it goes on after a kill, and what hard videos do to it."""

import hashlib
import logging
import math
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from pipeline.config import FramesConfig
from pipeline.core.io import read_table
from pipeline.running.parallel import run_parallel
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.decoding import fit
from pipeline.videos.files import VideoFile
from pipeline.videos.frames import extract
from pipeline.videos.frames.extract import Extraction
from pipeline.videos.frames.reference import reference_indices
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.selection import kept_count
from pipeline.videos.records import Finding, Frame, Probe
from tests.conftest import encode, moving_square, not_utf8, refused, write_video
from tests.frame_rules import CONFIG, FILES, Place, constant, frames_of, luma, pressing, promising, salience, scanned

NAMES = ["baseball_0", "baseball_1", "baseball_10", "potato_0", "potato_2", "rug_0", "rug_1"]
"""The videos of `tiny_videos`, sorted by object and number."""
NOISE = np.random.default_rng(0).integers(0, 256, (12, 97, 17, 3), np.uint8)


@pytest.fixture
def place(tiny_videos: Path, tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> Place:
    """A copy of the tiny videos whose scans are noted in a file: they run in other processes."""
    shutil.copytree(tiny_videos, tmp_path / "my videos")
    place = Place(tmp_path / "my videos", tmp_path, catalogue)

    def noted(file: VideoFile, config: FramesConfig) -> Scan | Finding:
        with place.log.open("a") as stream:
            stream.write(file.video_id + "\n")
        return scan(file, config)

    monkeypatch.setattr(extract, "scan", noted)
    return place


def test_files_hold_what_the_table_says(place: Place) -> None:
    found = place.extract()
    assert read_table(place.out / "frames.parquet", Frame) == list(found.frames)
    assert read_table(place.out / "probes.parquet", Probe) == list(found.probes)
    pixels = np.load(place.out / "frames.npy", mmap_mode="r")
    references = np.load(place.out / "references.npy", mmap_mode="r")
    assert (pixels.shape, pixels.dtype) == ((len(found.frames), 16, 16, 3), np.uint8)
    assert (references.shape, references.dtype) == ((7, 16, 16, 3), np.uint8)
    assert [f.row for f in found.frames] == list(range(len(found.frames)))
    assert [v.video_id for v in found.videos] == [p.video_id for p in found.probes] == NAMES
    assert [v.frames for v in found.videos] == [12, 1, 3, 20, 9, 31, 7]
    assert found.videos[-1].path == "sub folder é/rug_1.AVI"
    for video, probe, reference in zip(found.videos, found.probes, references, strict=True):
        path = place.folder / video.path
        raw = frames_of(path)
        own = [f for f in found.frames if f.video_id == video.video_id]
        assert [(f.frame_index, f.score) for f in own] == salience(luma(path), "0.3")
        for frame in own:
            np.testing.assert_array_equal(pixels[frame.row], fit(raw[frame.frame_index], CONFIG))
        if not probe.starts_touching:
            first = [fit(raw[i], CONFIG).astype(float) for i in reference_indices(len(raw))]
            np.testing.assert_array_equal(reference, np.rint(np.mean(first, axis=0)))
        assert (video.width, video.height, video.fps) == (48, 36, 25.0)
        assert video.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
        assert (probe.kept, probe.frames, probe.header_frames) == (len(own), video.frames, video.frames)
    assert sorted(p.name for p in place.out.iterdir()) == sorted(FILES)
    assert list(place.partial.iterdir()) == []


def kill_after(count: int, place: Place, config: FramesConfig = CONFIG) -> None:
    """Interrupt an extraction when one process has scanned the next `count` videos."""

    def until(work: Callable[[Any], Any], jobs: Sequence[Any], *_: str) -> Iterator[Any]:
        yield from map(work, jobs[:count])
        raise KeyboardInterrupt

    with patch.object(extract, "run_parallel", until), pytest.raises(KeyboardInterrupt):
        place.extract(config)


@pytest.fixture(scope="module")
def whole(tiny_videos: Path, tmp_path_factory: pytest.TempPathFactory, catalogue: Catalogue) -> list[bytes]:
    """What an extraction that nothing interrupts writes."""
    place = Place(tiny_videos, tmp_path_factory.mktemp("whole"), catalogue)
    place.extract()
    return place.bytes()


@pytest.mark.parametrize(("count", "rest"), [(0, "as it was"), (6, "as it was"), (6, "cut off"), (6, "half written")])
def test_a_killed_extraction_goes_on_where_it_was(place: Place, whole: list[bytes], count: int, rest: str) -> None:
    kill_after(count, place)
    assert not place.out.exists()
    (work,) = place.partial.iterdir()
    assert len([*work.iterdir()]) == count
    last = work / f"{NAMES[count - 1]}.safetensors"
    if rest == "half written":
        last.rename(work / f".{last.name}.1.part")
    elif rest == "cut off":
        last.write_bytes(last.read_bytes()[:-1])
    place.decoded()
    place.extract()
    assert place.decoded() == sorted(NAMES[count - (rest != "as it was") :])
    assert place.bytes() == whole
    assert list(place.partial.iterdir()) == []


def test_what_changed_after_a_kill_is_read_anew(place: Place) -> None:
    kill_after(5, place)
    place.decoded()
    write_video(place.folder / "potato_0.avi", moving_square(15, 77))
    assert place.extract().videos[3].frames == 15
    assert place.decoded() == sorted(["potato_0", *NAMES[5:]]), "the changed video, and those that were not finished"
    resumed = place.bytes()
    place.extract()
    assert place.bytes() == resumed


def test_videos_that_come_while_others_are_read_are_no_silent_matter(place: Place) -> None:
    """DVC hashes the folder behind the command, and would take it for what was read."""

    def meanwhile(*given: Any) -> Iterator[Any]:
        yield from run_parallel(*given)
        write_video(place.folder / "rug_2.avi", moving_square(15, 77))

    with patch.object(extract, "run_parallel", meanwhile), refused("videos were added or changed while they were read"):
        place.extract()
    place.decoded()
    assert [v.video_id for v in place.extract().videos] == [*NAMES, "rug_2"]
    assert place.decoded() == ["rug_2"]


def test_what_videos_csv_says_after_a_kill_counts(place: Place) -> None:
    for session in ("one", "two"):
        lines = f"file,object_id,session\nbaseball_0.avi,baseball,{session}\npotato_0.avi,potato,one\n"
        (place.folder / "videos.csv").write_text(lines)
        if session == "one":
            kill_after(1, place)
    assert [p.session for p in place.extract().probes] == ["two", "one"]


def test_other_parameters_start_anew(place: Place) -> None:
    place.extract(FramesConfig(pixels=32))
    expected = place.bytes()
    kill_after(4, place)
    place.decoded()
    place.extract(FramesConfig(pixels=32))
    assert place.decoded() == NAMES
    assert place.bytes() == expected
    place.extract()
    assert place.decoded() == NAMES[4:], "and what was killed waits"


def test_an_error_names_its_video_and_keeps_what_is_finished(place: Place) -> None:
    (place.folder / "potato_1.mov").write_text("no video")
    with refused(r"my videos/potato_1\.mov: no frame decodes"):
        place.extract()
    assert not place.out.exists()
    (place.folder / "potato_1.mov").unlink()
    place.decoded()
    assert len(place.extract().videos) == 7
    assert not {*NAMES[:4]} & {*place.decoded()}, "what stands before it is finished, and perhaps more"
    (place.folder / "rug_0.avi").rename(not_utf8(place.folder, "rug_?_0.avi"))
    with refused(r"rug_\\udcff_0\.avi: its name is no text in UTF-8; rename it"):
        place.extract()


def test_short_videos_are_left_out_by_the_published_rule(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        found = place.extract(FramesConfig(pixels=16, selection="release"))
    assert [v.video_id for v in found.videos] == ["potato_0", "rug_0"]
    assert [p.video_id for p in found.probes] == NAMES
    assert [p.kept for p in found.probes] == [0, 0, 0, 6, 0, 9, 0]
    assert len([r for r in caplog.records if "too few" in r.message]) == 5
    assert len(np.load(place.out / "references.npy")) == 2


def test_nothing_to_keep_is_an_error(place: Place) -> None:
    for name in ("potato_0", "rug_0"):
        (place.folder / f"{name}.avi").unlink()
    with refused(r"no video has a frame to keep; choose another frames\.selection"):
        place.extract(FramesConfig(pixels=16, selection="release"))
    assert not place.out.exists()


# Hard videos: no contact, tiny pictures, lying headers, broken files


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
        *((constant(30), 0.0), (constant(30, 0), 1.0), (constant(30, 255), 1.0), (constant(2), 0.0)),
        *((moving_square(count), None) for count in (1, 3)),
        *((list(NOISE[:, :high, :wide]), None) for high, wide in ((1, 1), (2, 2), (1, 9), (13, 17), (97, 17))),
    ],
)
def test_hard_videos(
    tmp_path: Path, catalogue: Catalogue, frames: list[np.ndarray], saturated: float | None, selection: str
) -> None:
    encode(tmp_path / "v" / "rug_0.mkv", frames, "mjpeg", "yuvj444p")
    found, probe = one(tmp_path / "v", catalogue, selection)
    assert (probe.height, probe.width, probe.frames) == (*frames[0].shape[:2], len(frames))
    assert probe.header_frames == 0, "Matroska promises none"
    assert 1 <= probe.kept == len(found.frames) <= kept_count(len(frames), FramesConfig(selection=selection))
    if selection == "salient":
        assert probe.kept == max(1, math.ceil(0.3 * (len(frames) - 1)))
    if saturated is not None:
        assert probe.saturated == saturated
        assert (probe.contact, probe.contact_end, probe.starts_touching) == (0, 0, False)
        assert all(frame.score == 0 for frame in found.frames)


def test_a_cut_off_video_warns(tmp_path: Path, catalogue: Catalogue, caplog: pytest.LogCaptureFixture) -> None:
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
def test_a_header_that_lies_changes_nothing(tmp_path: Path, selection: str) -> None:
    path = write_video(tmp_path / "rug_0.avi", pressing(40))

    def look() -> tuple[Probe, list[tuple[int, float, bytes]]]:
        found = scanned(path, FramesConfig(pixels=16, selection=selection))
        return found.probe, [(k.index, k.score, k.image.tobytes()) for k in found.kept]

    probe, kept = look()
    for promised in (0, 1, 7, 39, 41, 4000):
        with promising(promised):
            assert look() == (probe.model_copy(update={"header_frames": promised}), kept)


def test_an_uneven_rate_is_measured(tmp_path: Path, catalogue: Catalogue) -> None:
    for slower, bound in ((1, 0.01), (3, 0.1)):
        milliseconds = [40 * i if i < 24 else 960 + slower * 40 * (i - 24) for i in range(48)]
        encode(tmp_path / str(slower) / "rug_0.mkv", pressing(48), milliseconds=milliseconds)
        assert one(tmp_path / str(slower), catalogue)[1].irregular == pytest.approx(slower, abs=bound)


def test_files_that_are_no_good_are_named(tiny_videos: Path, tmp_path: Path, catalogue: Catalogue) -> None:
    (folder := tmp_path / "my vidéos 触覚").mkdir()
    shown = [frame for width in (48, 64) for frame in moving_square(4, 0, width, 36)]
    two_sizes = b"".join(cv2.imencode(".jpg", frame)[1].tobytes() for frame in shown)
    for name, content, words in (
        ("rug_0.mov", b"", "empty (0 bytes); copy it again"),
        ("rug_0.avi", (tiny_videos / "rug_0.avi").read_bytes()[:600], "no frame decodes"),
        ("rug_0.mjpg", two_sizes, "frames of 2 sizes; convert it"),
        ("rug_0.mkv", None, "unreadable"),
    ):
        path = folder / name
        if content is None:
            path.symlink_to(folder / "gone.mkv")
        else:
            path.write_bytes(content)
        with refused(f"^{re.escape(str(path))}: .*{re.escape(words)}"):
            Place(folder, tmp_path, catalogue).extract()
        path.unlink()
