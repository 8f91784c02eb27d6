"""Datasets of LeRobot as videos, to the frame, against what LeRobot itself decodes (shared/data/lerobot/README.md)."""

import json
import shutil
from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.use import live
from pipeline.videos.frames.reference import LONGEST
from pipeline.videos.importing.lerobot import import_episodes
from tests.conftest import ROOT, refused
from tests.frame_rules import decode

DATASETS = ROOT.parent / "shared/data/lerobot"
pytestmark = pytest.mark.skipif(not DATASETS.is_dir(), reason="needs shared/data/lerobot beside the checkout")
by_layout = pytest.mark.parametrize("layout", ["touch_demo", "touch_demo_v21"])
GEL, WRIST = "observation.images.gelsight", "observation.images.wrist"
NAMES = ["press_the_sponge_0", "press_the_mug_0", "hover_over_the_pen_0", "press_the_sponge_1"]  # By episode.


def expected(layout: str) -> Any:
    return json.loads((DATASETS / "expected.json").read_text())["datasets"][layout]["episodes"]


def bits(video: Path) -> list[tuple[int, int]]:
    """Episode and frame that the pictures of the wrist camera spell."""
    blocks = [picture[3:9].reshape(6, 16, 8, 3)[:, :, 2:6].mean((0, 2, 3)) for picture in decode(video)]
    return [divmod(int(np.packbits(block > 127).view(">u2")[0]), 1 << 12) for block in blocks]


def packets(video: Path) -> list[bytes]:
    with av.open(str(video)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


@by_layout
def test_episodes_are_copied_to_the_frame(layout: str, tmp_path: Path) -> None:
    for key in (GEL, WRIST):
        said = CliRunner().invoke(app, f"import lerobot {DATASETS / layout} --video {key} --out {tmp_path / key}")
        assert said.exit_code == 0, said.output
    listed = pd.read_csv(tmp_path / GEL / "videos.csv").values.tolist()
    for name, row, episode in zip(NAMES, listed, expected(layout), strict=True):
        place, number, length = episode["videos"][GEL], episode["episode_index"], episode["length"]
        session = f"{DATASETS.name}/{layout} episode {number} ({place['from']:.3f} to {place['to']:.3f} s)"
        assert row == [f"{name}.mp4", name[:-2], session, GEL]
        first, video = place["first_frame_in_file"], tmp_path / GEL / f"{name}.mp4"
        assert packets(video) == packets(DATASETS / layout / place["file"])[first : first + length]
        assert [picture.mean() for picture in decode(video)] == pytest.approx(episode["gelsight_mean_per_frame"], abs=2)
        assert bits(tmp_path / WRIST / f"{name}.mp4") == [(number, i) for i in range(length)]


@by_layout
def test_a_second_call_keeps_what_a_person_added(layout: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out, listed, names = tmp_path / "out", tmp_path / "out/videos.csv", tmp_path / "names.csv"
    names.write_text("task,object_id\npress the mug,mug\n")
    assert len(import_episodes(DATASETS / layout, GEL, out, names, 4.0, pressed=False)) == 1
    assert f"{names}: lacks 3 of 4 episodes, which are left out" in caplog.text
    pd.read_csv(listed).assign(note="a, b").to_csv(listed, index=False)
    written = import_episodes(DATASETS / layout, GEL, out, None, 4.0, pressed=False)
    assert [video.stem for video in written] == [NAMES[0], NAMES[2], NAMES[3]]
    assert pd.read_csv(listed, keep_default_na=False).note.tolist() == ["a, b", "", "", ""]
    assert import_episodes(DATASETS / layout, GEL, out, None, 4.0, pressed=False) == []
    assert len(import_episodes(DATASETS / layout, WRIST, out, None, 4.0, pressed=False)) == 4


@by_layout
def test_it_goes_on_in_a_folder_that_has_videos(layout: str, tmp_path: Path) -> None:
    """With a list as the studio writes it, and without one: the chain takes old videos and new ones."""
    for folder in ((with_list := tmp_path / "listed"), tmp_path / "plain"):
        import_episodes(DATASETS / layout, GEL, folder, None, 4.0, pressed=False)
        (folder / "press_the_mug_0.mp4").rename(folder / "mug_7.mp4")
        for name in (NAMES[0], NAMES[2], NAMES[3]):
            (folder / f"{name}.mp4").unlink()
        (folder / "videos.csv").unlink()
    (with_list / "videos.csv").write_text("file,object_id,session\nmug_7.mp4,mug,monday\n")
    for folder, session in ((with_list, "monday"), (tmp_path / "plain", "")):
        import_episodes(DATASETS / layout, GEL, folder, None, 4.0, pressed=False)
        listed = pd.read_csv(folder / "videos.csv", keep_default_na=False)
        assert listed.file.tolist() == ["mug_7.mp4", *(f"{name}.mp4" for name in NAMES)]
        assert listed.session[0] == session


def numbers(video: Path) -> list[int]:
    return list((pd.read_csv(video.with_suffix(".csv")).recorded_ns * 30e-9).round())


@by_layout
def test_each_press_becomes_a_video(layout: str, tmp_path: Path) -> None:
    written = import_episodes(DATASETS / layout, GEL, tmp_path, None, 4.0, pressed=True)
    drawn = [press for episode in expected(layout) for press in episode["presses"]]
    for video, press in zip(written, drawn, strict=True):
        frames, on, off = numbers(video), press["on"], press["off"]
        assert on - LONGEST <= frames[0] < on < off <= frames[-1] < off + LONGEST
    # No presses, but changes as strong, whose pictures spell which frames they are.
    changes = import_episodes(DATASETS / layout, WRIST, tmp_path / "wrist", None, 2.0, pressed=True)
    assert len(changes) >= 4
    assert [[frame for _, frame in bits(video)] for video in changes] == [numbers(video) for video in changes]


@pytest.mark.parametrize("options", ["keyint=250", "keyint=12:min-keyint=12:open-gop=1"])
@pytest.mark.parametrize("codec", ["x264", "x265"])
def test_episodes_with_no_keyframe(codec: str, options: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shutil.copytree(DATASETS / "touch_demo", root := tmp_path / "touch_demo")
    rows = pd.read_parquet(meta := root / "meta/episodes/chunk-000/file-000.parquet")
    rows.assign(**{f"videos/{WRIST}/from_timestamp": [0.0, 1.9999999, 4.8333333]}).to_parquet(meta)  # As sums may be.
    pictures = list(decode(file := root / "videos" / WRIST / "chunk-000/file-000.mp4"))
    with av.open(str(file), "w") as to:
        coded = {f"{codec}-params": f"{options}:scenecut=0:bframes=3:log-level=none"}
        stream = to.add_stream(f"lib{codec}", rate=30, options=coded, width=128, height=96, pix_fmt="yuv420p")
        for picture in pictures:
            to.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        to.mux(stream.encode(None))
    (table := tmp_path / "names.csv").write_text("episode,object_id\n0,a\n1,b\n2,c\n")
    written = import_episodes(root, WRIST, tmp_path / "out", table, 4.0, pressed=False)
    assert "cut off" not in caplog.text, "frames that are copied but not shown are none that lack"
    wanted = {name: [(i, j) for j in range(n)] for i, (name, n) in enumerate([("a_0", 60), ("b_0", 85), ("c_0", 41)])}
    assert {video.stem: bits(video) for video in written} == wanted
    assert numbers(written[2]) == [*range(41)]


@by_layout
def test_what_is_wrong_is_named_with_its_mend(layout: str, tmp_path: Path) -> None:
    shutil.copytree(DATASETS / layout, root := tmp_path / layout)
    video, info = root / expected(layout)[1]["videos"][GEL]["file"], root / "meta/info.json"
    (table := tmp_path / "names.csv").write_text("task,object_id\npress the bell,bell\n")

    def refuses(words: str, dataset: Path = root, key: str = GEL, names: Path | None = None) -> None:
        with refused(words):
            import_episodes(dataset, key, tmp_path / "out", names, 4.0, pressed=False)

    refuses(f"info.json: no video gelsight; .*its videos: {GEL}, {WRIST}", key="gelsight")
    refuses("nowhere/meta/info.json: is missing; name a LeRobot dataset's folder", tmp_path / "nowhere")
    refuses("names.csv.* has no task 'press the bell'; correct the line", names=table)
    table.write_text(f"episode,object_id\n0,{'ö' * 76}\n")
    refuses("episode 0: object 'ö{50}' .152 bytes. .*, up to 150 bytes; name it in a CSV", names=table)
    table.write_text("episode,object_id\n0,rug\n1,mug\n0,mug\n")
    refuses("names.csv, line 4: episode 0 has an object already; remove one of its lines", names=table)
    video.write_bytes(video.read_bytes()[:-1000])
    refuses(f"{video.name}: (no whole video|lacks) .*; download the dataset again")
    video.unlink()
    refuses(f"{video.name}: is missing; download the dataset again")
    next(root.glob("meta/episodes*/**/file-001.parquet"), root / "meta/episodes.jsonl").unlink()
    refuses("meta.* download the dataset again")
    info.write_text(info.read_text().replace('"v', '"v9.'))
    refuses("info.json: codebase_version v9.*; convert it with LeRobot to v2.1 or v3.0")


def test_live_says_that_opencv_reads_no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "PAUSE", 0.0)
    with refused("file-001.mp4: opens, but OpenCV reads no picture of it; send H.264 or MJPEG"):
        next(live.watch(f"file:{DATASETS}/touch_demo/videos/{GEL}/chunk-000/file-001.mp4"))
