"""What a folder of videos may hold, and every way in which it may be wrong."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import UserError
from pipeline.physiclear.catalogue import Catalogue
from pipeline.videos import Finding, catalogue_videos, decode, inspect
from tests.conftest import moving_square, write_video


def errors(folder: Path, catalogue: Catalogue) -> list[Finding]:
    return [f for f in inspect(folder, catalogue) if f.severity == "error"]


def test_a_good_folder(tiny_videos: Path, catalogue: Catalogue) -> None:
    videos = catalogue_videos(tiny_videos, catalogue)
    assert [v.video_id for v in videos] == [
        *("baseball_0", "baseball_1", "baseball_10", "potato_0", "potato_2", "rug_0", "rug_1")
    ], "sorted by object, then by number"
    assert [v.frames for v in videos] == [12, 1, 3, 20, 9, 31, 7]
    assert videos[-1].path == "sub folder é/rug_1.AVI"
    for video in videos:
        assert (video.width, video.height, video.fps) == (48, 36, 25.0)
        assert video.sha256 == hashlib.sha256((tiny_videos / video.path).read_bytes()).hexdigest()
    assert catalogue_videos(tiny_videos, catalogue) == videos


def test_only_the_objects_asked_for(tiny_videos: Path, catalogue: Catalogue) -> None:
    assert {v.object_id for v in catalogue_videos(tiny_videos, catalogue, ["rug", "potato"])} == {"rug", "potato"}


def test_hidden_and_other_files_do_not_count(tmp_path: Path, catalogue: Catalogue) -> None:
    write_video(tmp_path / "rug_0.mp4.avi", moving_square(3)).rename(tmp_path / "rug_0.MKV")
    (tmp_path / "readme.txt").write_text("x")
    (tmp_path / "._rug_0.mov").write_bytes(b"")
    (tmp_path / ".cache").mkdir()
    (tmp_path / ".cache" / "rug_0.mov").write_bytes(b"")
    (tmp_path / "rug_7.mov").mkdir()
    assert [v.path for v in catalogue_videos(tmp_path, catalogue)] == ["rug_0.MKV"]


def test_objects_outside_the_catalogue_are_left_out_with_one_line(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copy(tiny_videos / "rug_0.avi", tmp_path)
    for name in ("yoyo_0", "yoyo_1", "kite_0"):
        shutil.copy(tiny_videos / "potato_0.avi", tmp_path / f"{name}.avi")
    with caplog.at_level(logging.WARNING):
        assert [v.video_id for v in catalogue_videos(tmp_path, catalogue)] == ["rug_0"]
    assert len(caplog.records) == 1
    for words in ("3 videos", "2 objects", "kite, yoyo", "objects.csv"):
        assert words in caplog.text


Make = Callable[[Path, Path], None]


def missing(folder: Path, good: Path) -> None:
    folder.rmdir()


def nothing(folder: Path, good: Path) -> None:
    (folder / "notes.txt").write_text("no video")


def strangers(folder: Path, good: Path) -> None:
    shutil.copy(good, folder / "yoyo_0.avi")


def badly_named(folder: Path, good: Path) -> None:
    shutil.copy(good, folder / "rug.avi")


def zero_bytes(folder: Path, good: Path) -> None:
    (folder / "rug_0.mov").touch()


def text_as_video(folder: Path, good: Path) -> None:
    (folder / "rug_0.mov").write_text("not a video at all" * 50)


def header_alone(folder: Path, good: Path) -> None:
    (folder / "rug_0.avi").write_bytes(good.read_bytes()[:600])


def dead_link(folder: Path, good: Path) -> None:
    (folder / "rug_0.mov").symlink_to(folder / "gone.mov")


def rivals(folder: Path, good: Path) -> None:
    (folder / "sub").mkdir()
    shutil.copy(good, folder / "rug_0.avi")
    shutil.copy(good, folder / "sub" / "rug_00.mp4")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (missing, ["no such folder", "data.dir"]),
        (nothing, ["no video", ".mov", "data.dir"]),
        (strangers, ["no video of an object", "yoyo", "objects.csv"]),
        (badly_named, ["rug.avi", "<object>_<number>", "rename"]),
        (zero_bytes, ["rug_0.mov", "0 bytes", "copy it again"]),
        (text_as_video, ["rug_0.mov", "no frame decodes", "convert"]),
        (header_alone, ["rug_0.avi", "no frame decodes"]),
        (dead_link, ["rug_0.mov", "unreadable", "copy it again"]),
        (rivals, ["rug_0.avi", "sub/rug_00.mp4", "keep one"]),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_bad_input_is_one_line_with_its_mend(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue, make: Make, words: list[str]
) -> None:
    folder = tmp_path / "my videos"
    folder.mkdir()
    make(folder, tiny_videos / "rug_0.avi")
    with pytest.raises(UserError) as caught:
        catalogue_videos(folder, catalogue)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(folder))
    assert all(word in message for word in words), message
    (found,) = errors(folder, catalogue)
    assert found.message in message


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="nothing is forbidden to this user")
def test_a_file_without_access_is_named(tiny_videos: Path, tmp_path: Path, catalogue: Catalogue) -> None:
    path = Path(shutil.copy(tiny_videos / "rug_0.avi", tmp_path))
    path.chmod(0)
    with pytest.raises(UserError, match=r"rug_0\.avi: unreadable"):
        catalogue_videos(tmp_path, catalogue)


def test_a_cut_off_video_keeps_what_decodes_and_warns(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue, caplog: pytest.LogCaptureFixture
) -> None:
    whole = (tiny_videos / "rug_0.avi").read_bytes()
    path = tmp_path / "rug_0.avi"
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with caplog.at_level(logging.WARNING):
        (video,) = catalogue_videos(tmp_path, catalogue)
    assert 5 < video.frames < 31
    assert video.frames == len(list(decode(path)))
    assert "rug_0.avi" in caplog.text
    assert "31 frames in its header" in caplog.text


def test_inspection_lists_everything_at_once(tiny_videos: Path, tmp_path: Path, catalogue: Catalogue) -> None:
    folder = tmp_path / "all"
    shutil.copytree(tiny_videos, folder)
    (folder / "egg_0.mov").touch()
    (folder / "egg.mov").touch()
    shutil.copy(tiny_videos / "potato_0.avi", folder / "yoyo_0.avi")
    shutil.copy(tiny_videos / "potato_0.avi", folder / "potato_2.mkv")
    shutil.copy(tiny_videos / "potato_0.avi", folder / "egg_3.avi")
    findings = inspect(folder, catalogue)
    severities = [f.severity for f in findings]
    assert severities == sorted(severities, key=["error", "warning", "info"].index)
    assert sorted(f.item for f in findings if f.severity == "error") == ["egg.mov", "egg_0.mov", "potato_2.avi"]
    warnings = {f.item: f.message for f in findings if f.severity == "warning" and f.item != str(folder)}
    assert "1 frame only" in warnings["baseball_1.avi"]
    assert "3 frames only" in warnings["baseball_10.avi"]
    assert "same content" in warnings["potato_0.avi"], "twins are named under the second in order"
    about_folder = " ".join(f.message for f in findings if f.item == str(folder))
    assert "yoyo" in about_folder
    assert "no video of 70 objects" in about_folder
    assert "9 videos of 4 objects" in about_folder


@pytest.mark.real
def test_real_videos(real_data: Path, catalogue: Catalogue) -> None:
    videos = catalogue_videos(real_data, catalogue)
    objects = {v.object_id for v in videos}
    assert (len(videos), len(objects)) in {(370, 67), (408, 74)}, "all labelled videos, or those without the test set"
    by_id = {v.video_id: v for v in videos}
    assert by_id["hairbrush_bristles_side_4"].frames == 3
    assert by_id["tv_remote_back_3"].frames == 7
    assert {v.fps for v in videos} == {10.0, 25.0}
    assert sum(v.frames for v in videos if catalogue.objects[v.object_id].splits["paper"] != "test") == 41352
    unlabelled = real_data / "mandarin_orange_small_4.mov"
    if unlabelled.exists():
        assert len(list(decode(unlabelled))) == 3
