"""`octopi ask` and `octopi describe`: what a person types, what machines read, and going on after a kill."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from pipeline.cli import app, main
from pipeline.running import progress
from pipeline.use import ask as asking
from pipeline.use.ask import Chat, describe_folder, described
from pipeline.use.model import ALONE, DIVIDED, Octopi
from pipeline.use.results import Description
from tests.conftest import not_utf8, refused, write_video
from tests.conftest import octopi as command
from tests.report.conftest import rows_of
from tests.use.shared import Made

QUESTION = "Describe {tactile}."
Command = Callable[..., Result]


@pytest.fixture
def by_command(octopi: Octopi, monkeypatch: pytest.MonkeyPatch) -> Command:
    """`octopi WORDS...` with the model that is loaded already."""
    monkeypatch.setattr("pipeline.cli._load", lambda *_: octopi)

    def run(*words: object, typed: str = "", status: int = 0) -> Result:
        found = CliRunner().invoke(app, [str(word) for word in words], input=typed)
        assert found.exit_code == status, found.output
        return found

    return run


def test_an_answer_for_machines_however_long_it_takes(
    made: Made, octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "QUICK", 0)
    monkeypatch.setattr(sys, "argv", ["octopi", "ask", QUESTION, str(files[0]), "--model", str(made.folder), "--json"])
    with pytest.raises(SystemExit):
        main()
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["answer"] == octopi.ask(QUESTION, files[:1])
    assert found["videos"][0]["frames"] == list(octopi.look(files[0]).numbers)
    assert said.err == ""
    assert list(progress.track(["a"], "work", "piece")) == ["a"]
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "work: piece 1 of 1, 0 s left\n")


def test_a_question_may_be_longer_than_a_files_name(by_command: Command, octopi: Octopi, files: list[Path]) -> None:
    question = "Which is it? " * 20
    said = by_command("ask", question, files[0])
    assert said.stdout == octopi.ask(question, files[:1]) + "\n"
    assert "compares, but there is one video" in said.stderr
    assert octopi.doubts_about(question, 2) == octopi.doubts_about("Describe it.", 1) == octopi.doubts


def test_a_chat(octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    chat = Chat(octopi, said.append)

    def type_(*lines: str) -> str:
        said.clear()
        chat.run(lines)
        return "".join(said)

    assert "no video yet" in type_("/frames")
    assert "1 for the next question" in type_(f"/add {files[0]}")
    assert "nothing.avi: no such file" in type_("/add nothing.avi")
    assert "2 {tactile} for 1 video;" in type_("Is {tactile} softer than {tactile}?"), "the chat goes on"
    first = octopi.ask("{tactile} How soft is it?", files[:1])
    said_first, heads = type_("How soft is it?").split("\n(property heads: ")
    assert said_first == first, "without marks they stand in front"
    assert all(level in heads for level in octopi.describe(files[0]).levels.values())
    assert type_("And now?") == octopi.ask("And now?", history=chat.history[:1]) + "\n"
    assert [len(e.videos) for e in chat.history] == [1, 0]
    assert ALONE in type_("Which is softer?")
    type_(f"/add {files[1]}")
    assert ALONE not in type_("Which is softer?")
    numbers = ", ".join(map(str, octopi.look(files[0]).numbers))
    assert f"{files[0]}: frames {numbers}" in type_("/frames")
    assert type_("/reset", QUESTION.replace("{tactile}", "it")).startswith("a new conversation\n")
    assert "/quit" in type_("/unknown", "", "   ")
    assert type_("/quit", "/frames") == ""
    monkeypatch.setattr(octopi, "stream", mock.Mock(side_effect=KeyboardInterrupt))
    assert "stopped" in type_("Hello?")
    assert not chat.history


def test_a_chat_goes_on_without_a_video_in_which_nothing_is_touched(
    octopi: Octopi, files: list[Path], tmp_path: Path
) -> None:
    said: list[str] = []
    still = write_video(tmp_path / "still.avi", [np.full((36, 48, 3), 90, np.uint8)] * 12)
    chat = Chat(octopi, said.append)
    chat.run([f"/add {still}", f"/add {files[0]}", "How soft is it?"])
    assert said[0].startswith(f"{still}: nothing touches the sensor")
    assert [exchange.videos for exchange in chat.history] == [(str(files[0]),)]


def test_a_chat_mixes_no_recordings_of_one_name(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    said: list[str] = []
    chat, touch = Chat(octopi, said.append), tmp_path / files[0].name
    shutil.copy(files[0], touch)
    chat.run([f"/add {touch}", "How soft is it?"])
    shutil.copy(files[1], touch)
    said.clear()
    chat.run([f"/add {touch}", "And now?", "/reset", f"/add {touch}", "How soft is it?"])
    changed = f"{touch} has changed since it was added; name the new one otherwise, or /reset"
    assert [line for line in "".join(said).split("\n") if "changed" in line] == [changed] * 2
    assert f"\n{octopi.ask('{tactile} How soft is it?', files[1:2])}\n(property heads: " in "".join(said)
    touch.unlink()
    said.clear()
    chat.run(["And now?"])
    assert said == [f"{touch} is gone since it was added; put it back, or /reset\n"]


@pytest.fixture
def folder(files: list[Path], tmp_path: Path) -> Path:
    place = tmp_path / "videos" / "a,  b"
    place.mkdir(parents=True)
    for file in files:
        shutil.copy(file, place)
    (place / "broken.avi").write_text("no video")
    (place / "notes.txt").touch()
    (place / "gone.mov").symlink_to(place / "nowhere.mov")
    (place.parent / "linked").symlink_to(place)
    return place.parent


def test_a_folder_is_described(
    octopi: Octopi, folder: Path, files: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert describe_folder(octopi, [folder], tmp_path / "out.csv") == (5, 2)
    found = {row["file"]: row for row in rows_of(tmp_path / "out.csv")}
    assert set(found) == {f"a,  b/{name}" for name in ("broken.avi", "gone.mov", *(f.name for f in files))}
    assert "no frame decodes" in found["a,  b/broken.avi"]["error"]
    assert "no such file" in found["a,  b/gone.mov"]["error"]
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["linked", str(folder)]
    assert "1 .txt" in caplog.text
    for file in files:
        row, expected = found[f"a,  b/{file.name}"], octopi.describe(file)
        assert {name: row[name] for name in octopi.properties} == expected.levels
        for name, known in expected.probabilities.items():
            assert {level: float(row[f"{name}: {level}"]) for level in known} == pytest.approx(known, abs=1e-4)
        assert row["error"] == ""
    assert octopi.table(folder).to_csv(index=False) == (tmp_path / "out.csv").read_text()


def test_names_that_are_no_text_are_described_once(
    octopi: Octopi, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place := not_utf8(tmp_path, "a?b")).mkdir()
    shutil.copy(files[0], not_utf8(place, "?.avi"))
    out = tmp_path / "out.csv"
    assert describe_folder(octopi, [tmp_path], out) == (1, 0)
    assert [row["file"] for row in rows_of(out)] == [r"a\udcffb/\udcff.avi"]
    monkeypatch.setattr(octopi, "look", lambda _: pytest.fail("described again"))
    assert describe_folder(octopi, [tmp_path], out) == (1, 0)


def test_described_by_command(by_command: Command, folder: Path, files: list[Path], tmp_path: Path) -> None:
    out, alone = tmp_path / "out.csv", tmp_path / "alone.csv"
    (tmp_path / "empty").mkdir()
    for place, words in (("nothing", "no such file or folder"), ("empty", "holds no video")):
        assert words in str(by_command("describe", tmp_path / place, status=1).exception)
    assert f"{out}: 5 videos, 2 of them not described" in by_command("describe", folder, "--csv", out).stdout
    by_command("describe", files[0], "--csv", alone)
    assert [row["file"] for row in rows_of(alone)] == [files[0].name]
    (broken := tmp_path / "broken.avi").touch()
    by_command("describe", broken, status=1)


def test_a_row_of_the_table_has_its_files_name(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    """Those of two that are called alike have what tells them apart."""
    table, _ = described(octopi, [*files[:2], twin := Path(shutil.copy(files[1], tmp_path))])
    assert [*table.columns[0].cells] == [files[0].name, str(files[1]), str(twin)]


def test_an_unknown_property_loads_no_model(made: Made, files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Octopi, "from_pretrained", lambda *_, **__: pytest.fail("loaded"))
    for words in (("compare", *files[:2], "softness"), ("rank", "softness", *files[:2])):
        with refused(r"softness: no property of this model; .*hardness \(harder, softer\)"):
            command(*words, "--model", made.folder)


def test_described_compared_ranked_and_matched_by_command(
    by_command: Command, octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(octopi, "doubts", ("no answer means anything",))

    def said(*words: object) -> str:
        found = by_command(*words)
        assert found.stderr.count("no answer means anything") == 1
        return found.stdout

    one, two, three = map(str, files)
    known, table = octopi.describe(one), said("describe", one)
    shares = (f"({max(found.values()):.0%})" for found in known.probabilities.values())
    assert all(word in table for word in (files[0].name, *known.levels, *known.levels.values(), *shares))
    assert said("compare", one, two, "hardness") == octopi.compare(one, two, "hardness").answer + "\n"
    ranked = octopi.rank([three, one, two], "roughness")
    scale, *lines, answer = said("rank", "roughness", three, one, two).rstrip("\n").split("\n")
    assert [line.split("  ")[1] for line in lines] == [[three, one, two][i] for i in ranked.order]
    assert answer == ranked.answer
    assert scale.endswith("0 smooth, 1 slightly rough, 2 rough")
    own = {"mug": ["hard", "smooth", "no bumps"], "rug": ["soft", "rough", "no bumps"]}
    typed = "mug: hard, smooth, no bumps; rug: soft, rough, no bumps"
    for named, given in (("rug, millet", ["rug", "millet"]), ("rug; millet", ["rug", "millet"]), (typed, own)):
        matched = octopi.match([one, two], given)
        *lines, answer = said("match", one, two, "--names", named).rstrip("\n").split("\n")
        assert answer == matched.answer
        assert [line.partition(": ")[2].partition(" (")[0] for line in lines] == list(matched.heads)


def test_nobody_speaks_of_heads_that_are_not_there(
    by_command: Command, octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Classes are then those of the model's sentences; where two videos are alike, either may be the hardest."""
    soft, hard = ("soft", "rough", "no bumps"), ("hard", "smooth", "no bumps")
    classes = dict(zip(map(str, files), (soft, hard, hard), strict=True))
    found = {
        file: Description(
            levels=dict(zip(octopi.properties, own, strict=True)), probabilities={}, sentence="", frames=(), notes=()
        )
        for file, own in classes.items()
    }
    monkeypatch.setattr(octopi, "config", octopi.config.model_copy(update={"heads": False}))
    monkeypatch.setattr(octopi, "describe", lambda video: found[str(video)])

    def said(answer: str, *words: object) -> Result:
        monkeypatch.setattr(octopi, "ask", mock.Mock(return_value=answer))
        result = by_command(*words)
        assert "property heads" not in result.output
        assert "by the model's sentences" in result.stdout
        return result

    for place, apart in (("a", True), ("b", False), ("c", False)):
        assert (DIVIDED in said(f"{place}) is the hardest.", "rank", "hardness", *files).stderr) == apart
    own = "a mug: hard, smooth, no bumps; a rug: soft, rough, no bumps"
    assert DIVIDED in said("a) is a mug and b) is a rug.", "match", *files[:2], "--names", own).stderr


def test_a_kill_loses_no_row(octopi: Octopi, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asking, "BATCH", 1)
    whole, out = tmp_path / "whole.csv", tmp_path / "out.csv"
    describe_folder(octopi, [folder], whole)
    text, describe_all = whole.read_text(), mock.Mock(wraps=octopi.describe_all)
    monkeypatch.setattr(octopi, "describe_all", describe_all)
    for end in (0, 5, len(text) // 2, len(text) - 1):
        out.write_text(text[:end])
        describe_all.reset_mock()
        assert describe_folder(octopi, [folder], out) == (5, 2)
        assert out.read_text() == text
        done = sum(".avi" in line and "broken" not in line for line in text[:end].split("\n")[:-1])
        assert sum(len(call.args[0]) for call in describe_all.mock_calls) == 3 - done


def test_a_row_never_stands_for_another_recording(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    one, other, out = tmp_path / "monday" / "press.avi", tmp_path / "tuesday" / "press.avi", tmp_path / "out.csv"
    for file, source in zip((one, other), files, strict=False):
        file.parent.mkdir()
        shutil.copy(source, file)
    describe_folder(octopi, [one.parent], out)
    content = out.read_bytes()
    with refused("out.csv: describes another recording as press.avi; delete its row, or name another file with --csv"):
        describe_folder(octopi, [other.parent], out)
    assert out.read_bytes() == content
    assert describe_folder(octopi, [one.parent], out) == (1, 0)


@pytest.mark.parametrize("content", [b"", b"file,object\n"], ids=["another training's", "begun alike"])
def test_what_another_model_or_somebody_else_wrote_stays(
    content: bytes, octopi: Octopi, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "notes.txt"
    if content:
        out.write_bytes(content)
    else:
        describe_folder(octopi, files[:1], out)
        content = out.read_bytes()
        monkeypatch.setattr(octopi, "config", octopi.config.model_copy(update={"files": {}}))
    with refused("is no description by finetuned-with-all-0.*name another file with --csv"):
        describe_folder(octopi, files[:1], out)
    assert out.read_bytes() == content
