"""Recordings cut into presses: bags of both ROS versions, long videos, folders of pictures."""

import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from tempfile import mkdtemp
from typing import Any
from unittest import mock

import av
import cv2
import numpy as np
import pytest

from pipeline.config import FramesConfig
from pipeline.core.io import read_csv
from pipeline.running.errors import UserError
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.decoding import Decoder
from pipeline.videos.files import extending, list_videos
from pipeline.videos.film import write_film
from pipeline.videos.frames.reference import LONGEST
from pipeline.videos.importing.bags import shots
from pipeline.videos.importing.presses import SHORTEST, FrameTime, Shot, cut, film, presses
from pipeline.videos.records import Severity
from tests.conftest import octopi, refused
from tests.frame_rules import decode, scanned
from tests.use.videos import recording

pytest.importorskip("rosbags", reason="needs rosbags: pip install -e '.[robot]'")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

TOPIC, STEP_NS, START_NS = "/gelsight/image", 40_000_000, 1_700_000_000_000_000_000
TOUCHED = (range(20, 40), range(70, 82))
LENGTH = 110


def import_bag(bag: Path, out: Path, object_id: str) -> list[Path]:
    return cut(lambda: shots(bag, TOPIC), str(bag), out, object_id)


def message(store: Any, picture: np.ndarray, encoding: str, index: int, at: int) -> tuple[Any, str]:
    """A ROS message of a picture (BGR) with this stamp (ns) and its type; rows are padded by five bytes."""
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
    extra = {"seq": index} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="gel", **extra)
    if "png" in encoding:
        sent = picture[:, :, ::-1] if "compressed rgb" in encoding else picture
        data = cv2.imencode(".png", sent)[1].ravel()
        kind = "sensor_msgs/msg/CompressedImage"
        return types[kind](header=header, format=encoding, data=data), kind
    height, width = picture.shape[:2]
    order = picture[:, :, ::-1] if encoding.startswith("rgb") else picture
    if encoding in ("mono8", "8UC1"):
        order = picture[:, :, :1]
    elif encoding.endswith("a8"):
        order = np.dstack([order, np.full((height, width, 1), 7, np.uint8)])
    padded = np.pad(order.reshape(height, -1), ((0, 0), (0, 5)), constant_values=255)
    kind, shape = "sensor_msgs/msg/Image", {"height": height, "width": width, "step": padded.shape[1]}
    return types[kind](header=header, encoding=encoding, is_bigendian=0, data=padded.ravel(), **shape), kind


def write_bag(
    folder: Path,
    kind: str,
    pictures: Sequence[np.ndarray],
    encoding: str = "bgr8",
    received: Callable[[int], int] = lambda index: START_NS + index * STEP_NS,
    stamped: Callable[[int], int] = lambda index: START_NS + index * STEP_NS - 3_000_000,
) -> Path:
    """A bag with a topic of images and one of text; when (ns) each picture was received, and what its stamp says."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    bag = folder / ("touch.bag" if kind == "ros1" else f"touch_{kind}")
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer: Any = Writer1(bag) if kind == "ros1" else Writer2(bag, version=8, storage_plugin=plugin)
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    with writer:
        text = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        said = store.types["std_msgs/msg/String"](data="hello")
        writer.write(text, START_NS, serialize(said, "std_msgs/msg/String"))
        images = None
        for index, picture in enumerate(pictures):
            sent, of = message(store, picture, encoding, index, stamped(index))
            images = images or writer.add_connection(TOPIC, of, typestore=store)
            writer.write(images, received(index), serialize(sent, of))
    return bag


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return recording(TOUCHED, LENGTH)


@pytest.mark.parametrize(
    ("kind", "encoding"),
    [
        *(("ros1", encoding) for encoding in ("8UC3", "rgb8", "bgra8", "rgba8", "mono8", "8UC1", "png")),
        *(("ros1", f"rgb8; png compressed {order}") for order in ("rgb8", "bgr8")),
        *(("sqlite3", "bgr8"), ("sqlite3", "png"), ("mcap", "bgr8")),
    ],
)
def test_pictures_come_back_as_sent(tmp_path: Path, pictures: list[np.ndarray], kind: str, encoding: str) -> None:
    bag = write_bag(tmp_path, kind, pictures[18:22], encoding)
    # A single file of a ROS 2 bag is enough.
    for source in (bag, *bag.glob("*.mcap"), *bag.glob("*.db3")):
        for index, (shot, sent) in enumerate(zip(shots(source, TOPIC), pictures[18:22], strict=True)):
            expected = sent[:, :, :1].repeat(3, 2) if encoding in ("mono8", "8UC1") else sent
            np.testing.assert_array_equal(shot.picture, expected)
            assert shot.recorded == START_NS + index * STEP_NS
            assert shot.stamped == shot.recorded - 3_000_000


@pytest.mark.parametrize(("kind", "cold"), [("ros1", 0), ("mcap", 0), ("ros1", 12)])
def test_each_press_becomes_a_video_that_the_chain_takes(
    tmp_path: Path, pictures: list[np.ndarray], kind: str, cold: int, catalogue: Catalogue
) -> None:
    """Also where the light warms up in the first `cold` pictures, which is no press."""
    gains = [*np.linspace(0.25, 1, cold, endpoint=False), *[1.0] * (LENGTH - cold)]
    sent = [np.rint(picture * gain).astype(np.uint8) for picture, gain in zip(pictures, gains, strict=True)]
    bag, out = write_bag(tmp_path, kind, sent), tmp_path / "videos"
    written = import_bag(bag, out, "baseball")
    assert [p.name for p in written] == ["baseball_0.mp4", "baseball_1.mp4"]
    assert sorted(p.suffix for p in out.iterdir()) == [".csv", ".csv", ".mp4", ".mp4"], "and nothing unfinished"
    listing = list_videos(out, catalogue)
    assert [(f.check, f.severity) for f in listing.findings] == [("passed over", Severity.INFO)], "the tables of times"
    for file, touched in zip(listing.files, TOUCHED, strict=True):
        rows = read_csv(file.path.with_suffix(".csv"), FrameTime)
        begin, end = touched.start - LONGEST, touched.stop + LONGEST
        assert [r.recorded_ns for r in rows] == [START_NS + i * STEP_NS for i in range(begin, end)]
        assert [r.frame for r in rows] == list(range(end - begin))
        inside = [r.contact for r in rows if begin + r.frame in touched]
        assert min(inside) > 3 * max(r.contact for r in rows if begin + r.frame not in touched)
        seen = scanned(file.path, FramesConfig(pixels=32, per_video=3, selection="contact"))
        assert (seen.probe.frames, seen.probe.fps, seen.probe.starts_touching) == (len(rows), 25.0, False)
        assert all(begin + kept.index in touched for kept in seen.kept), "what is kept shows contact"
        # The film is lossy; a frame's neighbours in it must not be what it shows.
        shown = list(decode(file.path))
        for place in (0, LONGEST + 3):
            assert np.abs(shown[place].astype(int) - sent[begin + place]).mean() < 4
    assert [p.name for p in import_bag(bag, out, "baseball")] == ["baseball_2.mp4", "baseball_3.mp4"]


def test_a_recording_that_begins_in_contact_is_measured_by_its_end(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    (video,) = import_bag(write_bag(tmp_path, "ros1", pictures[24:70]), tmp_path / "out", "rug")
    rows = read_csv(video.with_suffix(".csv"), FrameTime)
    assert len(rows) == 16 + LONGEST
    assert rows[0].contact > 3 * rows[-1].contact


EVEN, PAIRS = ((lambda step: lambda i: START_NS + i // step * step * STEP_NS + i % step * 1000)(n) for n in (1, 2))
TIMES: dict[str, tuple[Callable[[int], int], Callable[[int], int]]] = {
    "in pairs": (PAIRS, EVEN),
    "played slowly, by a simulation's clock": (lambda i: START_NS + 3 * i * STEP_NS, lambda i: i * STEP_NS),
    "no stamps": (PAIRS, lambda i: 0),
    "numbers for stamps": (PAIRS, lambda i: START_NS + i),
    "stamps that fall": (EVEN, lambda i: START_NS - i * STEP_NS),
    "stamps of another unit": (EVEN, lambda i: i * 10**12),
    "a clock that was set": (EVEN, lambda i: EVEN(i) - (i > 50) * 10**10),
}
"""When pictures are received and what their stamps say, by number."""


@pytest.mark.parametrize("times", TIMES)
def test_the_rate_is_that_of_the_camera(tmp_path: Path, pictures: list[np.ndarray], times: str) -> None:
    for video in import_bag(write_bag(tmp_path, "mcap", pictures, "bgr8", *TIMES[times]), tmp_path / "out", "rug"):
        with Decoder(video) as decoder:
            assert decoder.header.fps == 25


def test_presses_that_are_near_share_what_lies_between_them() -> None:
    """Each would have more untouched frames beside it than there are; what is too short or too weak is no press."""
    counts = (40, 10, LONGEST, 10, 40, SHORTEST - 1, 40, 10, 40)
    strengths = np.repeat([0.2, 3, 0.2, 3, 0.2, 3, 0.2, 0.35, 0.2], counts)
    first, middle, last = 40 - LONGEST, 50 + LONGEST // 2, 60 + 2 * LONGEST
    assert presses(strengths) == [(first, middle), (middle, last)]


def test_what_is_no_recording_of_touch_is_refused_in_one_line(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    def bag(*sent: np.ndarray, encoding: str = "bgr8", kind: str = "ros1", late: int = 0) -> Path:
        """With the recorder's clock set back by so many seconds in the middle of thirty pictures."""
        times = (lambda i: EVEN(i) - (i >= 15) * late * 10**9), EVEN
        return write_bag(Path(mkdtemp(dir=tmp_path)), kind, sent, encoding, *times)

    def cut_off(kind: str) -> Path:
        whole = bag(*pictures[:30], kind=kind)
        file = next(p for p in (whole, *whole.glob("*")) if p.suffix in (".bag", ".mcap", ".db3"))
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
        return whole

    quiet = [shown for i, shown in enumerate(pictures) if not any(i in touched for touched in TOUCHED)]
    for source, told, *options in (
        (bag(*quiet), "nothing touches the sensor in 78 pictures"),
        (bag(*pictures[:2], encoding="16UC1"), "encoding '16UC1'; send one of bgr8, 8UC3, rgb8, mono8, 8UC1"),
        *((bag(*pictures[:30], late=seconds), "its clock was set back") for seconds in (1, 3600)),
        *((cut_off(kind), "copy it again") for kind in ("ros1", "sqlite3", "mcap")),
        (bag(pictures[0], kind="mcap"), f"/none is not in it; its image topics: {TOPIC}", "--topic", "/none"),
    ):
        with refused(re.escape(told)):
            octopi("import", "bag", source, "--out", out := tmp_path / "o", "--topic", TOPIC, *options)
        assert not out.exists() or not list(out.iterdir()), "nothing half-written is left"


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_colours_that_two_pixels_share_are_read(tmp_path: Path, encoding: str) -> None:
    """By ITU-R BT.601's own formula, brightness from 16 to 235, of pictures whose pairs of pixels have one colour."""
    y, u, v = (np.random.default_rng(0).integers(60, 180, size) for size in ((8, 12), (8, 6), (8, 6)))
    parts = (u, y[:, ::2], v, y[:, 1::2]) if encoding == "yuv422" else (y[:, ::2], u, y[:, 1::2], v)
    packed = np.stack(parts, axis=2).reshape(8, 12, 2).astype(np.uint8)
    (shot,) = shots(write_bag(tmp_path, "ros1", [packed], encoding), TOPIC)
    light, blue, red = 1.164 * (y - 16), u.repeat(2, 1) - 128, v.repeat(2, 1) - 128
    bgr = np.stack([light + 2.018 * blue, light - 0.813 * red - 0.391 * blue, light + 1.596 * red], axis=2)
    assert np.abs(shot.picture - np.clip(bgr, 0, 255)).max() < 3


def test_a_long_video_and_a_folder_of_pictures_are_cut_as_a_bag_is(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    (folder := tmp_path / "grasp").mkdir()
    for number, shown in enumerate(pictures):
        cv2.imwrite(str(folder / f"frame_{number}.png"), shown)  # frame_10 comes after frame_9.
    write_film(long := tmp_path / "long.mp4", pictures, 25.0)
    (text := tmp_path / "text.mp4").write_text("no video")
    command = ["import", "video", "--out", out := tmp_path / "videos", "--object", "rug"]
    for source, options, numbers in ((folder, ["--fps", "25"], (0, 1)), (long, ["--times", "4"], (2, 3))):
        said = octopi(*command, source, *options)
        assert f"rug_{numbers[0]}.mp4, rug_{numbers[1]}.mp4" in said
        for number, touched in zip(numbers, TOUCHED, strict=True):
            rows = read_csv(out / f"rug_{number}.csv", FrameTime)
            expected = [(touched.start - LONGEST + i) * STEP_NS for i in range(len(touched) + 2 * LONGEST)]
            assert [r.recorded_ns for r in rows] == [r.stamped_ns for r in rows] == expected
    assert "rug_4.mp4" in octopi(*command, long, "--whole")
    assert len(list(decode(out / "rug_4.mp4"))) == LENGTH
    cv2.imwrite(str(folder / "frame_3.png"), pictures[3][:-2])
    for source, options, words in (
        (folder, ["--fps", "25"], "frame_3.png: of another size"),
        (folder, ["--fps", "0.5"], "--fps takes 1 to 240"),
        (text, ["--fps", "25"], "no picture decodes"),
    ):
        with refused(re.escape(words)):
            octopi(*command, source, *options)


@pytest.mark.parametrize(
    "names", [["grasp1.9", "grasp1.10"], ["1700000000.12", "1700000000.2"], [str(n / 25) for n in range(1, 60)]]
)
def test_pictures_are_ordered_as_their_names_count(tmp_path: Path, names: list[str]) -> None:
    for value, name in enumerate(names):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((4, 4, 3), value, np.uint8))
    assert [int(shot.picture[0, 0, 0]) for shot in film(tmp_path, 25.0)] == [*range(len(names))]


def test_cut_pictures_are_counted(tmp_path: Path, pictures: list[np.ndarray], caplog: pytest.LogCaptureFixture) -> None:
    for number, shown in enumerate(pictures[:6]):
        cv2.imwrite(str(file := tmp_path / f"{number}.jpg"), shown)
        if number in (2, 5):
            file.write_bytes(file.read_bytes()[: -1 if number == 2 else 900])
    assert [shot.recorded // STEP_NS for shot in film(tmp_path, 25.0)] == [0, 1, 3, 4], "at the others' own times"
    assert f"{tmp_path}: 2 of 6 pictures are cut off" in caplog.text


def test_few_bits_in_many_are_no_black_picture(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    """Where all sixteen are used the upper eight count."""
    for number, times in enumerate((257, 16)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), pictures[0].astype(np.uint16) * times)
    shown = film(tmp_path, 25.0)
    np.testing.assert_array_equal(next(shown).picture, pictures[0])
    with refused(r"1\.png: .* save it in 8 bits"):
        next(shown)


def test_a_video_of_varying_rate_is_cut_by_its_time_stamps(tmp_path: Path) -> None:
    """Two seconds at 25 a second show black, two at 10 a second white."""
    with av.open(str(tmp_path / "phone.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=50, width=64, height=48)
        stream.codec_context.time_base = Fraction(1, 50)
        for at in (*range(0, 100, 2), *range(100, 200, 5)):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 255 * (at >= 100), np.uint8), format="bgr24")
            frame.pts, frame.time_base = at, Fraction(1, 50)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    (tmp_path / "videos.csv").write_text("file,object_id,begin,end\nphone.mp4,rug,,2\nphone.mp4,rug,2,\n")
    octopi("import", "video", tmp_path / "videos.csv", "--out", tmp_path / "cut")
    black, white = ([p.mean() for p in decode(tmp_path / "cut" / f"rug_{n}.mp4")] for n in (0, 1))
    assert (len(black), len(white)) == (50, 20)
    assert max(black) < 40 < 215 < min(white)


def test_a_table_says_where_to_cut(
    tmp_path: Path, pictures: list[np.ndarray], catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    def checked(*args: Any, **more: Any) -> list[Path]:
        there.append(len([*out.glob("*.mp4")]))
        return cut(*args, **more)

    there: list[int] = []
    monkeypatch.setattr("pipeline.videos.importing.presses.cut", checked)
    write_film(tmp_path / "long.mp4", pictures, 25.0)
    table, out = tmp_path / "videos.csv", tmp_path / "cut"
    table.write_text(
        "file,object_id,session,begin,end\nlong.mp4,rug,one,,0.4\nlong.mp4,rug,two,1.2,2\nlong.mp4,felt,two,,\n"
    )
    assert "3 videos" in octopi("import", "video", table, "--out", out)
    assert there == [0] * 3, "a kill before the end leaves none that would come twice"
    lengths = [len(list(decode(out / f"{name}.mp4"))) for name in ("rug_0", "rug_1", "felt_0")]
    assert lengths == [10, 20, LENGTH]
    assert [r.recorded_ns for r in read_csv(out / "rug_1.csv", FrameTime)] == [(30 + i) * STEP_NS for i in range(20)]
    rug = catalogue.objects["rug"]
    listing = list_videos(out, catalogue.model_copy(update={"objects": {"rug": rug, "felt": rug}}))
    sessions = [(f.relative, f.session) for f in listing.files]
    assert sessions == [("felt_0.mp4", "two"), ("rug_0.mp4", "one"), ("rug_1.mp4", "two")]
    (found,) = (f for f in list_videos(tmp_path, catalogue).findings if f.severity is Severity.ERROR)
    assert f"octopi import video {table} --out" in found.measured, "the chain would take the whole file"
    table.write_text("file,object_id\nlong.mp4,rug\n")
    octopi("import", "video", table, "--out", out)
    listed = [f.relative for f in list_videos(out, catalogue).files]
    assert listed == ["rug_0.mp4", "rug_1.mp4", "rug_2.mp4"], "what the list had, and what it has now"
    for cells, told in (
        ("rug,inf", "line 3: begin is 'inf'"),
        ("a rug,0", "line 2: object 'a rug' .* take letters"),
        ("rug,9", "line 2: 0 pictures are no press"),
    ):
        table.write_text(f"file,object_id,begin\nlong.mp4,{'rug,1' if 'inf' in cells else cells}\nlong.mp4,{cells}\n")
        with refused(told):
            octopi("import", "video", table, "--out", out)
    with refused("names sections of files, and would be lost; name another folder"):
        octopi("import", "video", table, "--out", tmp_path)
    assert len([*out.glob("*.mp4")]) == 4, "nothing is written where a line is wrong"
    table.write_text("file,object_id\nlong.mp4,rug\n")
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.videos.importing.presses.add_to_list", mock.Mock(side_effect=OSError("full")))
        with pytest.raises(OSError, match="full"):
            octopi("import", "video", table, "--out", out)
    assert len([*out.glob("*.mp4")]) == 4, "nor where the list cannot be written"
    octopi("import", "video", tmp_path / "long.mp4", "--out", out, "--object", "rug", "--whole")
    assert "rug_3.mp4" in [f.relative for f in list_videos(out, catalogue).files], "the list goes on"
    videos = tmp_path / "lab" / "videos"
    with extending(videos):
        for call in (("import", "video", tmp_path / "long.mp4", "--out", videos), ("studio", videos.parent)):
            with refused("videos: an import or a studio writes into it; let it end"):
                octopi(*call)
    assert [*out.glob(".*"), *videos.glob(".*")] == [], "no lock is left"


def test_presses_are_written_all_or_none(
    tmp_path: Path, pictures: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that who begins anew after an error or a kill has none twice."""
    calls, replace = iter([LENGTH, TOUCHED[1].start, *[LENGTH] * 4]), os.replace

    def read() -> Iterator[Shot]:
        end = next(calls)
        yield from (Shot(picture, place * STEP_NS, place * STEP_NS) for place, picture in enumerate(pictures[:end]))
        if end < LENGTH:
            raise UserError("the rest cannot be read")

    with refused("the rest cannot be read"):
        cut(read, "it", tmp_path, "rug")
    assert [*tmp_path.iterdir()] == []

    def killed(source: Path, target: Path) -> None:
        if target.suffix == ".mp4" and [*tmp_path.glob("rug_*.mp4")]:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(os, "replace", killed)
        patch.setattr(Path, "unlink", lambda *_, **__: None)
        cut(read, "it", tmp_path, "rug")
    assert len([*tmp_path.glob("rug_*.mp4")]) == 1
    assert cut(read, "it", tmp_path, "rug") == sorted(tmp_path.glob("*.mp4")) == sorted(tmp_path.glob("rug_[01].mp4"))
