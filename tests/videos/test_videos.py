"""Which videos a folder holds, by names or by its videos.csv, and every way in which that may be wrong."""

import errno
import os
import re
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import LIST_FILE, Listing, list_videos, raise_errors
from pipeline.videos.records import Severity
from tests.conftest import refused


def touch(folder: Path, *names: str) -> Path:
    """Files are not opened to list them: empty ones will do."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def ids(listing: Listing) -> list[str]:
    return [f.video_id for f in listing.files]


def errors(listing: Listing) -> list[tuple[str, str]]:
    return [(f.item, f.measured) for f in listing.findings if f.severity is Severity.ERROR]


def warnings(listing: Listing) -> list[str]:
    return [f.measured for f in listing.findings if f.severity is Severity.WARNING]


def test_a_good_folder(tiny_videos: Path, tmp_path: Path, catalogue: Catalogue) -> None:
    folder = Path(shutil.copytree(tiny_videos, tmp_path / "v"))
    listing = list_videos(folder, catalogue)
    names = ["baseball_0", "baseball_1", "baseball_10", "potato_0", "potato_2", "rug_0", "rug_1"]
    assert ids(listing) == names
    assert str(listing.files[-1]) == listing.files[-1].relative == "sub folder é/rug_1.AVI"
    assert all(f.path == folder / f.relative and not f.session for f in listing.files)
    assert (listing.findings, listing.unknown_objects) == ((), ())
    (folder / "sub folder é" / LIST_FILE).write_text("file,object_id\nrug_1.AVI,potato\n")
    assert ids(list_videos(folder, catalogue)) == names, "a list counts in the folder itself"


def test_hidden_and_other_files_do_not_count(tmp_path: Path, catalogue: Catalogue) -> None:
    touch(tmp_path, "rug_0.MKV", "rug_1.Mp4", "readme.txt", "._rug_0.mov", ".cache/rug_0.mov", "rug_2.mp3", "a/b.TXT")
    touch(tmp_path, "Makefile", "rug_7.mov/Makefile")
    (tmp_path / "rug_8.mov").symlink_to(tmp_path / "gone.mov")
    listing = list_videos(tmp_path, catalogue)
    assert [f.relative for f in listing.files] == ["rug_0.MKV", "rug_1.Mp4", "rug_8.mov"], "reading tells of dead links"
    (said,) = listing.findings
    assert (said.check, said.item, said.severity) == ("passed over", str(tmp_path), Severity.INFO)
    assert said.measured == "7 are no videos by their names: 2 .txt, 2 hidden, 2 without a suffix, 1 .mp3"


def test_linked_folders_are_named_and_linked_files_are_videos(tmp_path: Path, catalogue: Catalogue) -> None:
    """DVC does not look behind a link to a folder, so a change there would rerun nothing. Loops end nothing either."""
    folder, elsewhere = touch(tmp_path / "videos", "rug_0.mov"), touch(tmp_path / "monday", "rug_1.mov", "rug_2.mov")
    for link, target in (("tuesday", elsewhere), ("loop", folder), ("rug_3.mov", elsewhere / "rug_2.mov")):
        (folder / link).symlink_to(target)
    listing = list_videos(folder, catalogue)
    assert ids(listing) == ["rug_0", "rug_3"]
    said = [(f.check, f.item, f.severity) for f in listing.findings]
    assert said == [("passed over", name, Severity.WARNING) for name in ("loop", "tuesday")]
    assert all("link the files" in f.measured for f in listing.findings)
    (linked := tmp_path / "linked").symlink_to(folder)
    assert ids(list_videos(linked, catalogue)) == ids(listing), "the folder itself may be a link"


def test_accents_are_one_however_they_are_written(tmp_path: Path, catalogue: Catalogue) -> None:
    """A Mac writes an accent as a character of its own."""
    decomposed = unicodedata.normalize("NFD", "café_0.mov")
    assert decomposed != "café_0.mov"
    assert list_videos(touch(tmp_path, decomposed, "rug_0.mov"), catalogue).unknown_objects == ("café",)
    (file,) = list_videos(listed(tmp_path, "file,object_id\ncafé_0.mov,rug\n", decomposed), catalogue).files
    assert (file.video_id, file.path) == ("rug_0", tmp_path / decomposed)


def test_objects_outside_the_catalogue_are_left_out_with_one_line(tmp_path: Path, catalogue: Catalogue) -> None:
    listing = list_videos(touch(tmp_path, "rug_0.mov", "yoyo_0.mov", "yoyo_1.mov", "kite_0.mov"), catalogue)
    assert (ids(listing), listing.unknown_objects) == (["rug_0"], ("kite", "yoyo"))
    (message,) = warnings(listing)
    assert all(words in message for words in ("3 videos", "2 objects", "kite, yoyo", "objects.csv")), message


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: folder.rmdir(), ["no such folder", "data.dir"]),
        (lambda folder: touch(folder, "yoyo_0.mov"), ["no video of an object", "yoyo", "objects.csv"]),
        (lambda folder: touch(folder, "rug.avi"), ["rug.avi", "<object>_<number>", "rename", "videos.csv"]),
        (lambda folder: touch(folder, "rug_0.avi", "sub/rug_00.mp4"), ["rug_0.avi", "sub/rug_00.mp4", "keep one"]),
    ],
)
def test_bad_names_are_one_line_with_their_mend(
    tmp_path: Path, catalogue: Catalogue, make: Callable[[Path], object], words: list[str]
) -> None:
    folder = tmp_path / "my videos"
    folder.mkdir()
    make(folder)
    listing = list_videos(folder, catalogue)
    with refused(f"^{re.escape(str(folder))}") as caught:
        raise_errors(folder, listing.findings)
    assert all(word in str(caught.value) for word in words), caught.value
    assert len(errors(listing)) == 1


def test_pipes_and_closed_folders(tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = touch(tmp_path, "baseball_0.mov", "closed/pillow_0.mov")
    os.mkfifo(folder / "rug_0.mov")
    scan = os.scandir

    def refuse(path: str) -> object:
        """Root may read everything, so that permissions alone would not close the folder."""
        if str(path).endswith("closed"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    listing = list_videos(folder, catalogue)
    assert ids(listing) == ["baseball_0"]
    assert {(item, message.partition("(")[0]) for item, message in errors(listing)} == {
        ("closed", "cannot be read "),
        ("rug_0.mov", "is no file but a pipe, socket or device; move it"),
    }


def listed(folder: Path, text: str, *names: str, encoding: str = "utf-8") -> Path:
    touch(folder, *(names or ("a.mov", "b c.mp4", "tag 3/é.avi")))
    (folder / LIST_FILE).write_bytes(text.encode(encoding))
    return folder


def test_a_list_names_files_of_any_name(tmp_path: Path, catalogue: Catalogue) -> None:
    """Numbers count up within an object in the list's order, 10 after 9; names that look like numbers mean nothing."""
    names = ["tag 3/é.avi", "b c.mp4", *(f"{letter}.mov" for letter in "zyxwvutsrq")]
    of_rug = "".join(f"rug,s2,{name}\n" for name in names)
    text = f"object_id,session,file\npotato,s1,rug_7.mov\n{of_rug}"
    listing = list_videos(listed(tmp_path, text, "rug_7.mov", *names), catalogue)
    assert [(f.video_id, f.relative, f.session) for f in listing.files] == [
        ("potato_0", "rug_7.mov", "s1"),
        *((f"rug_{number}", name, "s2") for number, name in enumerate(names)),
    ]
    assert listing.findings == ()


def test_what_a_list_lacks_is_left_out_with_one_line(tmp_path: Path, catalogue: Catalogue) -> None:
    """And said once all its lines are right, which are all looked at at once."""
    listing = list_videos(listed(tmp_path, "file,object_id\na.mov,rug\n"), catalogue)
    assert (ids(listing), errors(listing)) == (["rug_0"], [])
    assert warnings(listing) == ["2 videos of the folder are not listed and are left out"]
    listing = list_videos(listed(tmp_path, "file,object_id\nx.mov,rug\na.mov,rug\na.mov,rug\ny.mov,rug\n"), catalogue)
    assert [message.partition(":")[0] for _, message in errors(listing)] == ["line 2", "line 4", "line 5"]
    assert warnings(listing) == []
    with refused("videos.csv: line 2"):
        raise_errors(tmp_path, listing.findings)


@pytest.mark.parametrize(
    "text",
    [
        "\ufefffile,object_id\na.mov,rug\nb c.mp4,potato\n",
        "file , object_id\n a.mov , rug \n\n,\nb c.mp4,potato\n",
        'object_id,note,file\nrug,"one, two",a.mov\npotato,,b c.mp4',
        "file,object_id\r\na.mov,rug\r\nb c.mp4,potato\r\n",
        "file,object_id,session\na.mov,rug\nb c.mp4,potato,\n",
        "file,object_id\n./a.mov,rug\n.\\b c.mp4,potato\n",
    ],
    ids=["byte order mark", "spaces and empty lines", "other columns", "Windows", "short lines", "as a shell writes"],
)
def test_lists_are_read_as_people_write_them(tmp_path: Path, catalogue: Catalogue, text: str) -> None:
    listing = list_videos(listed(tmp_path, text, "a.mov", "b c.mp4"), catalogue)
    found = [(f.relative, f.video_id, f.session) for f in listing.files]
    assert found == [("b c.mp4", "potato_0", ""), ("a.mov", "rug_0", "")]
    assert listing.findings == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,object_id\na.mov,rug\ngone.mov,rug\n", "line 3: no video 'gone.mov' in the folder; correct the line"),
        ("file,object_id\na.mov,rug\n\na.mov,potato\n", "line 4: a.mov is listed twice; keep one line"),
        ("file,object_id\na.mov,yoyo\n", "no video of an object of the catalogue"),
        ("file,object_id\né.avi,rug\n", "no CSV in UTF-8"),
    ],
)
def test_bad_lists_are_one_line_with_their_mend(tmp_path: Path, catalogue: Catalogue, text: str, words: str) -> None:
    listing = list_videos(listed(tmp_path, text, encoding="latin-1"), catalogue)
    ((item, _),) = errors(listing)
    assert item == (str(tmp_path) if "catalogue" in words else LIST_FILE)
    with refused(re.escape(words)) as caught:
        raise_errors(tmp_path, listing.findings)
    assert str(caught.value).count(str(tmp_path)) == 1
