"""The folder that the studio fills: read by the catalogue's own reader, and nothing is lost on the way."""

import os
import threading
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.params import compose
from pipeline.core.io import read_json
from pipeline.running.errors import UserError
from pipeline.scales import check_inputs
from pipeline.use.rated_folder import RatedFolder
from pipeline.use.studio import Studio
from pipeline.videos.audit.labels import icc3k
from pipeline.videos.audit.run import check_folder
from pipeline.videos.catalogue import load_catalogue
from tests.conftest import ROOT, refused
from tests.use.videos import press

PROPERTIES = ROOT / "pipeline" / "physiclear" / "properties.yaml"
LEVELS = {"hardness": 0, "roughness": 2, "bumpiness": 1}


def opened(folder: Path, *videos: str) -> RatedFolder:
    (folder / "videos").mkdir(parents=True, exist_ok=True)
    for name in videos:
        press(folder / "videos" / name)
    return RatedFolder(folder, PROPERTIES)


def rate(data: RatedFolder, rater: str, object_id: str, **levels: int) -> None:
    for name, level in (LEVELS | levels).items():
        data.rate(rater, object_id, name, level)


def test_raters_are_told_what_the_document_says() -> None:
    lines = (ROOT / "docs" / "data.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]
    told = read_json(ROOT / "pipeline" / "use" / "page" / "raters.json")
    for name, guide in told.items():
        what, how, *classes = next(row[1:] for row in rows if row[0] == name and len(row) == 6)
        assert [what, how] == [guide["what"], guide["how"]]
        for cell, (level, means) in zip(classes, guide["levels"].items(), strict=True):
            assert cell == (means if means.startswith(level) else f"{level}: {means}")
    properties = load_catalogue(PROPERTIES.parent).properties
    assert {p.name: list(p.levels) for p in properties} == {name: list(g["levels"]) for name, g in told.items()}


def test_what_raters_say_is_a_catalogue_that_the_chain_trains_on(tmp_path: Path) -> None:
    data = opened(tmp_path, *(f"object_{key}_{n}.mp4" for key in "abcdefgh" for n in range(2)))
    for place, key in enumerate("abcdefgh"):
        rate(data, "ann", f"object_{key}", hardness=place % 3)
        data.rate("ben", f"object_{key}", "hardness", 2)
    with refused("class"):
        data.rate("ben", "object_a", "hardness", 3)
    catalogue = load_catalogue(data.catalogue)
    assert catalogue.objects["object_b"].ratings == ((1, 2), (2,), (1,)), "in the raters' order, what is there"
    assert catalogue.language.dataset == "", "PhysiCLeAR's figures are not for these videos"
    assert [f for f in check_folder(tmp_path, catalogue) if f.severity == "error"] == []
    folders = f"data.dir={data.videos}", f"data.catalogue={data.catalogue}"
    check_inputs(compose("small", ["data.source=videos", *folders]))
    rate(data, "ann", "object_a", hardness=1)
    assert load_catalogue(data.catalogue).labels("object_a") == (2, 2, 1), "who changes her mind is asked once"


def test_agreement_is_over_objects_that_all_have_rated(tmp_path: Path) -> None:
    data = opened(tmp_path, *(f"{key}_0.mp4" for key in ("a", "b", "c", "d", "what_ann_alone_rated")))
    given = {"ann": (0, 1, 2, 2), "ben": (0, 2, 1, 2), "cid": (1, 1, 2, 2)}
    for rater, levels in given.items():
        for key, level in zip("abcd", levels, strict=True):
            rate(data, rater, key, hardness=level)
    rate(data, "ann", "what_ann_alone_rated", hardness=2)
    none = "roughness", "bumpiness"  # Where nothing differs.
    agreed = {"hardness": icc3k([*zip(*given.values(), strict=True)]), **dict.fromkeys(none)}
    assert data.agreement(data.ratings()) == agreed
    rate(data, "dan", "b", hardness=0)
    assert data.agreement(data.ratings()) == agreed, "who has just begun hides nothing"
    with refused("no such object"):  # It has another name now, on another page.
        data.rate("ann", "e", "hardness", 1)


def test_a_folder_written_by_hand_stays_as_it_is(tmp_path: Path) -> None:
    """Names and splits stay; nobody knows whose its ratings are, so raters are numbered."""
    (catalogue := tmp_path / "catalogue").mkdir()
    (catalogue / "properties.yaml").write_bytes((ROOT / "examples/new_sensor/properties.yaml").read_bytes())
    lines = ["object_id,name,hardness,roughness,bumpiness,split_lab", "foam,a block of foam,0 1,1 1,0 0,train"]
    (catalogue / "objects.csv").write_text("\n".join([*lines, "glass,a pane of glass,2,0,0,test\n"]))
    before = load_catalogue(catalogue)
    data = opened(tmp_path, "glass_0.mp4")
    assert load_catalogue(catalogue) == before
    assert [row["rater"] for row in data.ratings()] == ["rater 1", "rater 2", "rater 1"]
    assert data.id_of("A block of foam") == "foam"
    rate(data, "ann", "glass")
    assert data.rename("glass", "pane", "a big pane, of glass") == ("a pane of glass", {"pane_0.mp4": "glass_0.mp4"})
    found = load_catalogue(catalogue).objects["pane"]
    assert (found.name, found.ratings[0]) == ("a big pane, of glass", (2, 0))
    assert found.splits == before.objects["glass"].splits
    assert [video["file"] for video in data.recorded()] == ["pane_0.mp4"]
    with refused("is another object"):
        data.rename("foam", "pane", "a pane")
    data.rename("pane", "pane", "a pane")
    assert load_catalogue(catalogue).objects["pane"].name == "a pane", "another name, the same id"
    with refused("no name for an object"):
        data.id_of("ж" * 76)
    (catalogue / "properties.yaml").write_text("properties: [\n")
    with refused("properties.yaml: "):
        RatedFolder(tmp_path, PROPERTIES)


def test_videos_move_come_back_and_survive_a_kill(tmp_path: Path) -> None:
    data = opened(tmp_path, "foam_0.mp4", "foam_1.mp4")
    listed = data.videos / "videos.csv"
    listed.write_text(rows := "file,object_id,session,force\nfoam_0.mp4,foam,monday,2\nfoam_1.mp4,foam,monday,3\n")
    (data.videos / "foam_1.csv").write_text("frame\n0\n")
    content = (data.videos / "foam_1.mp4").read_bytes()
    now, whose = data.move("foam_1.mp4", "")
    assert [row["file"] for row in data.recorded()] == ["foam_0.mp4"]
    assert data.move(now, whose) == ("foam_1.mp4", "")
    assert listed.read_text() == rows, "an undo brings the session back, too"
    assert (data.videos / "foam_1.mp4").read_bytes() == content
    assert (data.videos / "foam_1.csv").exists()
    data.move("foam_0.mp4", "a_sponge")
    assert "a_sponge_0.mp4,a_sponge,monday,2" in listed.read_text()
    with refused("no such video"):
        data.move("../catalogue/properties.yaml", "foam")
    # Killed between a video and its line, or between a deletion and its line; a part is of a process that ended.
    press(data.videos / "foam_7.mp4")
    (data.videos / "a_sponge_0.mp4").unlink()
    (rest := data.videos / ".foam_8.999999999.part.mp4").write_bytes(content)
    assert [row["file"] for row in opened(tmp_path).recorded()] == ["foam_1.mp4", "foam_7.mp4"]
    assert [line.split(",")[0] for line in listed.read_text().split()[1:]] == ["foam_1.mp4", "foam_7.mp4"]
    assert not rest.exists()


@pytest.mark.parametrize("writes", range(9))
def test_a_new_name_that_is_killed_loses_no_rating_and_no_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    data, done = opened(tmp_path, "foam_0.mp4", "foam_1.mp4"), list[str]()
    for file in ("foam_0.csv", "foam_1.csv"):
        (data.videos / file).write_text("frame\n0\n")
    (data.videos / "videos.csv").write_text("file,object_id,session\nfoam_0.mp4,foam,monday\nfoam_1.mp4,foam,monday\n")
    for rater in ("ann", "ben"):
        rate(data, rater, "foam")
    replace = os.replace

    def killed(source: str, target: str) -> None:
        if len(done) == writes:
            raise KeyboardInterrupt
        done.append(target)
        replace(source, target)

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(os, "replace", killed)
        data.rename("foam", "sponge", "a sponge")
    again = RatedFolder(tmp_path, PROPERTIES)
    videos, found = again.recorded(), load_catalogue(again.catalogue).objects
    assert len(videos) == 2
    assert {video["session"] for video in videos} == {"monday"}
    assert all((again.videos / video["file"]).with_suffix(".csv").exists() for video in videos)
    names = {video["object_id"] for video in videos}
    assert {row["rater"] for row in again.ratings() if row["object_id"] in names} == {"ann", "ben"}
    assert {found[key].ratings for key in names} == {((0, 0), (2, 2), (1, 1))}
    if names == {"foam"}:
        again.rename("foam", "sponge", "a sponge")
        assert load_catalogue(again.catalogue).objects.keys() == {"sponge"}


@settings(max_examples=40)
@given(st.lists(st.tuples(st.sampled_from(["press", "give", "delete", "rename"]), st.integers(0, 4)), max_size=8))
def test_undo_gives_back_what_was_step_by_step(steps: list[tuple[str, int]]) -> None:
    with TemporaryDirectory() as folder:
        data, desk = RatedFolder(Path(folder), PROPERTIES), Studio.__new__(Studio)
        desk.data, desk.lock, desk.undos, desk.target = data, threading.RLock(), [], ""

        def shown() -> list[tuple[str, str, bytes]]:
            rows = data.recorded()
            return sorted((r["file"], r["object_id"], (data.videos / r["file"]).read_bytes()) for r in rows)

        (data.videos / "first try.mp4").write_bytes(b"first")
        (data.videos / "videos.csv").write_text("file,object_id,session\nfirst try.mp4,foam,monday\n")
        before = [shown()]
        for place, (kind, number) in enumerate(steps):
            name, videos = f"object {number}", data.recorded()
            row = videos[number % len(videos)] if videos else None
            if kind == "press":
                file = f"foam_{100 + place}.mp4"
                (data.videos / file).write_bytes(bytes([place]))
                desk.undos.append(lambda file=file: data.move(file, ""))  # type: ignore[misc]
            elif row and kind == "rename":
                with suppress(UserError):  # To the name of another object.
                    desk.rename(row["object_id"], name)
            elif row:
                desk.move(row["file"], name if kind == "give" else "")
            before += [shown()] * (len(desk.undos) - len(before) + 1)
        while desk.undos:
            assert shown() == before.pop()
            desk.undo()
        assert shown() == before.pop()


def test_what_was_written_by_hand_is_kept_where_it_would_be_lost(tmp_path: Path) -> None:
    """A line prepared for ratings, a video that is not there yet, a column of one's own."""
    (catalogue := tmp_path / "catalogue").mkdir()
    (videos := tmp_path / "videos").mkdir()
    objects = "object_id,name,hardness,roughness,bumpiness,split_lab\nfoam,a block of foam,,,,train\n"
    listed = "file,object_id,session,force\nelsewhere/a.mp4,foam,monday,2\n"
    (catalogue / "objects.csv").write_text(objects)
    (videos / "videos.csv").write_text(listed)
    opened(tmp_path)
    assert [f.read_text() for f in catalogue.glob("objects.csv.*")] == [objects]
    assert [f.read_text() for f in videos.glob("videos.csv.*")] == [listed]
    assert len([*tmp_path.rglob("*.csv.*")]) == 2
    opened(tmp_path)
    assert len([*tmp_path.rglob("*.csv.*")]) == 2, "nothing was lost the second time"
    (catalogue / "objects.csv").write_text(objects)
    opened(tmp_path)
    kept = [f.read_text() for f in catalogue.glob("objects.csv.*")]
    assert kept == [objects, objects], "a copy took an older one's place, within one second"
