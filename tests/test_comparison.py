"""`octopi compare`: what it names, what it leaves out, and whether its tests are the tests that they are called."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.comparison import compare
from pipeline.comparison.accuracies import Accuracy
from pipeline.comparison.figures import Figure, moved_figures
from pipeline.comparison.locked import Change, read_locked
from pipeline.errors import UserError
from pipeline.records import Task
from pipeline.revisions import Disk, find_commit
from tests.closure import ROOT
from tests.history import REPORT, Asked, History

OBJECTS = [f"object{i}" for i in range(6)]
ASKED = [
    *(Asked(f"OPD-{i:02}", (OBJECTS[i % 6],)) for i in range(24)),
    *(Asked(f"PC-{i:02}", (OBJECTS[i % 6], OBJECTS[(i + 1 + i // 6) % 6]), task=Task.PC) for i in range(12)),
]
BEFORE = {q.name: i % 3 == 0 for i, q in enumerate(ASKED)}
AFTER = {q.name: i % 3 == 0 or i % 6 in (1, 2, 4) for i, q in enumerate(ASKED)}
OTHER_ASKED = [*(replace(q, video=1) if q.name == "OPD-05" else q for q in ASKED[1:]), Asked("OPD-99", ("object0",))]
METRICS = '{"full.PC": 0.25, "base.PC": 0.5}\n'
TABLE = "row,system,value,seeds\nPC,full,25.0,1\nPC,base,50.0,1\nPSS,full,10.0,1\n"


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    """Tags: `first`; `again`, a reproduction done twice; `longer`, with one parameter changed; `asked`, other
    questions.
    """
    found = History(tmp_path_factory.mktemp("history") / "a clone")
    found.begin()
    found.params(epochs=4, encoder={"recipe": "paper", "sizes": [1, 2]}, plan={"variants": {"full": {"seed": 0}}})
    found.questions(ASKED)
    for variant in ("full", "base"):
        found.scores(variant, ASKED, BEFORE)
    found.made("metrics.json", METRICS)
    found.made("understanding.csv", TABLE)
    found.commit("first")
    shutil.rmtree(found.folder / "data")
    shutil.rmtree(found.folder / REPORT)
    found.commit("again")
    found.params(epochs=5, encoder={"recipe": "paper", "sizes": [1, 2]}, plan={"variants": {"full": {"seed": 7}}})
    found.scores("full", ASKED, AFTER)
    found.made("metrics.json", METRICS.replace("0.25", "0.75"))
    found.made("understanding.csv", TABLE.replace("25.0", "75.0"))
    found.commit("longer")
    found.questions(OTHER_ASKED)
    found.scores("full", OTHER_ASKED, {**BEFORE, "OPD-99": True})
    found.commit("asked")
    return found


@pytest.fixture
def copy(history: History, tmp_path: Path) -> History:
    """One to change."""
    shutil.copytree(history.folder, tmp_path / "copy", symlinks=True)
    return History(tmp_path / "copy", history.commits)


def test_a_reproduction_done_twice_differs_in_nothing(history: History) -> None:
    assert history.commits["first"] != history.commits["again"]
    found = compare(history.folder, "first", "again")
    assert not found.differs
    assert found.tested.same == ("full", "base")
    assert found.tested.accuracies == found.tested.notes == ()
    assert not compare(history.folder, "asked").differs, "the working tree is as committed"


def test_one_changed_parameter_is_named_with_what_it_moved(history: History) -> None:
    found = compare(history.folder, "again", "longer")
    assert found.differs
    assert found.parameters == (Change("epochs", "4", "5"),), "the plan follows from it"
    assert {c.name for c in found.inputs} == {"made", "made/full.parquet"}
    assert (found.appeared, found.vanished) == ((), ())
    moved = {stage.stage: [c.name for c in stage.outs] for stage in found.stages}
    assert moved == {
        "grade@full": ["data/scores/full"],
        "grade@base": [],
        "report": [f"{REPORT}/metrics.json", f"{REPORT}/tables"],
    }
    assert next(s.params for s in found.stages if s.stage == "grade@base") == (Change("epochs", "4", "5"),)
    assert found.figures.moved == (
        Figure(f"{REPORT}/metrics.json", "full.PC", "", "0.25", "0.75"),
        Figure(f"{REPORT}/tables/understanding.csv", "PC, full", "value", "25.0", "75.0"),
    )
    back = compare(history.folder, "longer", "again")
    assert back.parameters == (Change("epochs", "5", "4"),)
    assert [(f.old, f.new) for f in back.figures.moved] == [(f.new, f.old) for f in found.figures.moved]
    assert [row.difference for row in back.tested.accuracies] == [-row.difference for row in found.tested.accuracies]


def flipped(gains: Sequence[tuple[str, int]]) -> float:
    """Two-sided p of the sign-flip test, by going through all signs of the objects' sums."""
    sums = [sum(gain for o, gain in gains if o == name) for name in sorted({o for o, _ in gains})]
    ways = [abs(sum(s * v for s, v in zip(signs, sums, strict=True))) for signs in itertools.product((1, -1), repeat=6)]
    return sum(way >= abs(sum(sums)) for way in ways) / len(ways)


def test_the_paired_test_is_on_the_same_questions_and_over_objects(history: History) -> None:
    found = compare(history.folder, "again", "longer").tested
    assert found.same == ("base",)
    assert [(row.variant, row.task) for row in found.accuracies] == [("full", "OPD"), ("full", "PC")]
    for row in found.accuracies:
        names = [q.name for q in ASKED if q.task == row.task]
        assert (row.n, row.left_out) == (len(names), 0)
        assert row.old == pytest.approx(sum(BEFORE[n] for n in names) / len(names), abs=1e-12)
        assert row.new == pytest.approx(sum(AFTER[n] for n in names) / len(names), abs=1e-12)
        assert row.changed == sum(BEFORE[n] != AFTER[n] for n in names)
        assert row.mcnemar == pytest.approx(2 * 0.5**row.changed), "all discordant questions go one way"
        assert row.low is not None
        assert row.high is not None
        assert row.low <= row.difference <= row.high
    described = found.accuracies[0]
    gains = [(q.objects[0], AFTER[q.name] - BEFORE[q.name]) for q in ASKED if q.task is Task.OPD]
    assert described.p == pytest.approx(flipped(gains), abs=1e-12)
    assert_holm(found.accuracies)


def assert_holm(rows: Sequence[Accuracy]) -> None:
    """Two tests: the smaller p counts double, the larger is at least that."""
    small, large = sorted(rows, key=lambda row: row.p or 0)
    assert small.p is not None
    assert large.p is not None
    assert small.p_holm == pytest.approx(min(1, 2 * small.p))
    assert large.p_holm == pytest.approx(max(large.p, min(1, 2 * small.p)))


def test_other_questions_are_left_out_and_named(history: History) -> None:
    found = compare(history.folder, "longer", "asked").tested
    described = next(row for row in found.accuracies if row.task == "OPD")
    # OPD-00 is gone, OPD-99 came, OPD-05 shows another video.
    names = [q.name for q in ASKED if q.task is Task.OPD and q.name not in ("OPD-00", "OPD-05")]
    assert (described.n, described.left_out) == (len(names), 3)
    assert described.old == pytest.approx(sum(AFTER[n] for n in names) / len(names))
    assert described.new == pytest.approx(sum(BEFORE[n] for n in names) / len(names))
    assert found.notes == ("the questions differ: 36 before, 36 now; the 34 that are the same are compared",)


def test_without_a_cache_all_but_the_paired_test_is_there(history: History, tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", str(history.folder), str(clone)], check=True)
    found = compare(clone, "again", "longer")
    assert found.parameters == (Change("epochs", "4", "5"),)
    assert len(found.figures.moved) == 2
    assert found.tested.accuracies == ()
    assert len(found.tested.notes) == 2, "a line for each revision"
    assert all(re.search(r"cache lacks the scores of 1 .*dvc pull.*dvc repro", n) for n in found.tested.notes)
    assert not compare(clone, "first", "again").differs


def test_a_cache_that_lacks_one_revision_says_which(copy: History) -> None:
    old, new = (
        read_locked(find_commit(copy.folder, tag).read(["dvc.lock"])["dvc.lock"], tag)["grade@full"].outs[
            "data/scores/full"
        ]
        for tag in ("again", "longer")
    )
    assert old != new
    cached = copy.folder / ".dvc" / "cache" / "files" / "md5" / old[:2] / old[2:]
    cached.chmod(0o600)
    cached.unlink()
    (note,) = compare(copy.folder, "again", "longer").tested.notes
    assert "again" in note
    assert "longer" not in note


def test_the_working_tree_is_what_lies_on_disk(copy: History) -> None:
    file = copy.folder / "params.yaml"
    file.write_text(file.read_text().replace("epochs: 5", "epochs: 6"))
    (copy.folder / REPORT / "metrics.json").write_text('{"full.PC": 0.75, "base.PC": 0.5, "new.PC": 1.0}')
    (copy.folder / REPORT / "tables" / "more.csv").write_text("row,value\na,1\n")
    found = compare(copy.folder, "HEAD")
    assert found.parameters == (Change("epochs", "5", "6"),)
    assert found.figures.moved == (Figure(f"{REPORT}/metrics.json", "new.PC", "", None, "1.0"),)
    more = f"{REPORT}/tables/more.csv"
    assert found.figures.files == (Change(more, None, more),)
    assert found.stages == ()


def test_the_project_may_stand_below_the_repository(tmp_path: Path) -> None:
    project = tmp_path / "repository" / "below"
    (project / "reports" / "smoke").mkdir(parents=True)
    (project / "params.yaml").write_text("a: 1\n")
    (project / "reports" / "smoke" / "metrics.json").write_text('{"x": 1}')
    repository = History(project.parent)
    (project.parent / "params.yaml").write_text("a: 3\n")
    repository.git("init", "--quiet")
    repository.git("add", "--all")
    repository.git("commit", "--quiet", "--message", "x")
    assert not compare(project, "HEAD").differs
    (project / "params.yaml").write_text("a: 2\n")
    assert compare(project, "HEAD").parameters == (Change("a", "1", "2"),)


def tables(tmp_path: Path, old: str, new: str) -> Sequence[Figure]:
    for name, text in (("old", old), ("new", new)):
        (tmp_path / name / "reports" / "r").mkdir(parents=True)
        (tmp_path / name / "reports" / "r" / "t.csv").write_text(text)
    return moved_figures(Disk(tmp_path / "old"), Disk(tmp_path / "new")).moved


@pytest.mark.parametrize(
    ("old", "new", "moved"),
    [
        # A row that came in between, and another order, move no other.
        ("a,v\nx,1\ny,2\n", "a,v\ny,2\nz,3\nx,1\n", [("z", "row", None, "there")]),
        ("a,v\nx,1\ny,2\n", "a,v\ny,2\n", [("x", "row", "there", None)]),
        # Numbers are labels where rows differ in them alone.
        ("a,seed,v\nx,0,1\nx,1,2\n", "a,seed,v\nx,0,1\nx,1,5\n", [("x, 1", "v", "2", "5")]),
        # A column that came.
        ("a,v\nx,1\n", "a,w,v\nx,9,1\n", [("x", "w", None, "9")]),
        # Rows that nothing tells apart.
        ("a,v\nx,1\nx,1\n", "a,v\nx,1\n", [("x, 1 #2", "row", "there", None)]),
        # Quoted commas and empty cells.
        ('a,v\n"x, y",\n', 'a,v\n"x, y",3\n', [("x, y", "v", "", "3")]),
        ("", "a,v\nx,1\n", [("x", "row", None, "there")]),
    ],
)
def test_rows_are_found_again(tmp_path: Path, old: str, new: str, moved: list[tuple[object, ...]]) -> None:
    assert [(f.row, f.column, f.old, f.new) for f in tables(tmp_path, old, new)] == moved


def test_rows_of_all_committed_tables_can_be_told_apart(tmp_path: Path) -> None:
    files = [f for f in sorted((ROOT / "reports").rglob("*.csv")) if f.parent.name != "bench"]
    assert len(files) > 20
    for number, file in enumerate(files):
        first, *rows = file.read_text().splitlines(keepends=True)
        assert tables(tmp_path / str(number), "".join([first, *rows]), "".join([first, *reversed(rows)])) == (), file


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("params.yaml", "{", "params.yaml of working tree: not YAML"),
        ("params.yaml", "- 1\n", "params.yaml of working tree: not a mapping"),
        ("dvc.lock", "{", "dvc.lock of working tree: not YAML"),
        ("dvc.lock", "stages: {a: 3}\n", "dvc.lock of working tree: not as DVC writes it"),
        (f"{REPORT}/metrics.json", "{", "metrics.json of working tree: not JSON"),
        (
            f"{REPORT}/tables/understanding.csv",
            "a,b\n1\n",
            "understanding.csv of working tree: a row has more or fewer",
        ),
    ],
)
def test_a_broken_file_is_named(copy: History, file: str, text: str, says: str) -> None:
    (copy.folder / file).write_text(text)
    with pytest.raises(UserError, match=re.escape(says)):
        compare(copy.folder, "HEAD")


@pytest.mark.parametrize("revision", ["nowhere", "--all", "", "HEAD:params.yaml", "first..again"])
def test_an_unknown_revision_is_refused(history: History, revision: str) -> None:
    with pytest.raises(UserError, match="no commit of this repository"):
        compare(history.folder, revision)
    if revision:
        with pytest.raises(UserError, match="no commit of this repository"):
            compare(history.folder, "HEAD", revision)


def test_outside_of_git_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))
    with pytest.raises(UserError, match="in no Git repository"):
        compare(tmp_path, "HEAD")


def test_what_a_person_sees(history: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(history.folder)
    same = CliRunner().invoke(app, ["compare", "first", "again"])
    assert same.exit_code == 0, same.output
    assert same.output.startswith("Nothing differs between first")
    assert len(same.output.splitlines()) == 1
    file = tmp_path / "out" / "compared.json"
    other = CliRunner().invoke(app, ["compare", "again", "longer", "--json", str(file)])
    assert other.exit_code == 0, other.output
    for words in (r"epochs +4 +5", r"full\.PC +0\.25 +0\.75", r"PC, full +value +25\.0 +75\.0", r"full +OPD +\d"):
        assert re.search(words, other.output), words
    written = json.loads(file.read_text())
    assert written["differs"] is True
    assert written["parameters"] == [{"name": "epochs", "old": "4", "new": "5"}]
    assert [row["task"] for row in written["tested"]["accuracies"]] == ["OPD", "PC"]
    assert yaml.safe_load((history.folder / "params.yaml").read_text())["epochs"] == 5, "nothing is checked out"
    assert history.git("status", "--porcelain") == ""
