"""`octopi diff` in a small Git and DVC repository: what it names, what it leaves out, and its paired test."""

import itertools
import json
import re
import shutil
import subprocess
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

import pytest
from dvc.repo import Repo

from pipeline.cli.diff import compare
from pipeline.core.io import write_table
from pipeline.evaluation.records import Graded
from tests.conftest import octopi, refused
from tests.evaluation.conftest import graded

REPORT = "reports/smoke-scenes"
CHAIN = f"""
stages:
  questions:
    cmd: mkdir -p data/questions/0 && cp made/evaluation.jsonl data/questions/0/
    deps: [made/evaluation.jsonl]
    outs: [data/questions]
  grade:
    cmd: cp made/graded.parquet data/
    deps: [made/graded.parquet, data/questions]
    params: [epochs]
    outs: [data/graded.parquet]
  report:
    cmd: mkdir -p {REPORT} && cp made/metrics.json {REPORT}/
    deps: [made/metrics.json, data/graded.parquet]
    metrics: [{REPORT}/metrics.json: {{cache: false}}]
"""
BEFORE = [i % 3 == 0 for i in range(18)]
AFTER = [i % 3 == 0 or i % 6 in (1, 2, 4) for i in range(18)]


@dataclass
class History:
    """The repository; every `commit` reproduces before it commits."""

    folder: Path

    def git(self, *arguments: str) -> str:
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=True).stdout.strip()

    def write(self, name: str, text: str) -> None:
        (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / name).write_text(text)

    def answers(self, right: list[bool], videos: str = "0", metric: float = 0.25) -> None:
        """The full system's and the base encoder's descriptions; the latter never change."""
        answers = graded("OPD", right, measure="combined")
        answers += graded("OPD", BEFORE, measure="combined", encoder="base")
        write_table(self.folder / "made" / "graded.parquet", Graded, answers)
        asked = [(f"OPD-{i:03}", f"o_{videos if i < 3 else 0}") for i in range(18)]
        rows = [json.dumps({"question_id": name, "videos": [video], "gold": "x"}) for name, video in asked]
        self.write("made/evaluation.jsonl", "\n".join(rows) + "\n")
        self.write("made/metrics.json", json.dumps({"OPD": metric}))

    def commit(self, tag: str) -> None:
        with chdir(self.folder), Repo() as repo:
            repo.reproduce()
        self.git("add", "--all")
        self.git("commit", "--quiet", "--allow-empty", "--message", tag)
        self.git("tag", tag)


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    """Tags: `first`; `again`, the same reproduced; `longer`, one parameter and the answers changed; `asked`, three
    questions about other videos.
    """
    found = History(tmp_path_factory.mktemp("history") / "a clone")
    (found.folder / "made").mkdir(parents=True)
    found.git("init", "--quiet")
    Repo.init(str(found.folder)).close()
    found.write(".dvc/config", "[core]\n    analytics = false\n")
    found.write("dvc.yaml", CHAIN)
    found.write(".gitignore", "/data/\n")
    found.write("params.yaml", "epochs: 4\nencoder: {sizes: [1, 2]}\n")
    found.answers(BEFORE)
    found.commit("first")
    shutil.rmtree(found.folder / "data")
    found.commit("again")
    found.write("params.yaml", "epochs: 5\nencoder: {sizes: [1, 2]}\n")
    found.answers(AFTER, metric=0.75)
    found.commit("longer")
    found.answers(BEFORE, videos="1", metric=0.75)
    found.commit("asked")
    return found


@pytest.fixture
def copy(history: History, tmp_path: Path) -> History:
    return History(shutil.copytree(history.folder, tmp_path / "copy", symlinks=True))


def test_what_changed_is_named_with_what_it_moved(history: History) -> None:
    same = compare(history.folder, "first", "again")
    assert not same["differs"], "a reproduction done twice"
    assert same["tested"] == same["notes"] == []
    assert not compare(history.folder, "asked")["differs"], "the working tree is as committed"
    found = compare(history.folder, "again", "longer")
    assert found["parameters"] == [{"name": "epochs", "old": "4", "new": "5"}]
    assert found["metrics"] == [{"name": "smoke-scenes.OPD", "old": "0.25", "new": "0.75"}]
    # The base encoder answered as before, so that one system is tested; p by going through all signs.
    (row,), (back,) = found["tested"], compare(history.folder, "longer", "again")["tested"]
    assert back["difference"] == -row["difference"]
    assert (row["part"], row["task"], row["n"], row["objects"]) == ("finetuned with all real", "OPD", 18, 6)
    assert row["difference"] == pytest.approx((sum(AFTER) - sum(BEFORE)) / 18, abs=1e-6)
    sums = [sum(AFTER[i] - BEFORE[i] for i in range(o, 18, 6)) for o in range(6)]
    ways = [abs(sum(s * v for s, v in zip(signs, sums, strict=True))) for signs in itertools.product((1, -1), repeat=6)]
    assert row["p"] == row["p_holm"] == pytest.approx(sum(way >= abs(sum(sums)) for way in ways) / 64, abs=1e-6)
    assert row["low"] <= row["difference"] <= row["high"]


def test_other_questions_are_left_out_and_counted(history: History) -> None:
    found = compare(history.folder, "longer", "asked")
    (row,) = found["tested"]
    assert row["n"] == 15
    assert row["difference"] == pytest.approx((sum(BEFORE[3:]) - sum(AFTER[3:])) / 15, abs=1e-6)
    assert found["notes"] == ["15 questions are compared; 3 were asked by one side only, or differ."]


def test_without_a_cache_all_but_the_paired_test_is_there(history: History, tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", str(history.folder), str(clone)], check=True)
    found = compare(clone, "again", "longer")
    assert (len(found["parameters"]), len(found["metrics"])) == (1, 1)
    (note,) = found["notes"]
    assert re.search(r"graded.parquet of again \(\w+\) and longer \(\w+\) is not at hand; `dvc pull`", note)


def test_the_working_tree_is_what_lies_on_disk(copy: History) -> None:
    copy.write("params.yaml", "epochs: 6\nencoder: {sizes: [1, 2]}\n")
    copy.write(f"{REPORT}/metrics.json", '{"OPD": 0.75, "PC": 1.0}')
    found = compare(copy.folder, "HEAD")
    assert found["new"] == "working tree"
    assert found["parameters"] == [{"name": "epochs", "old": "5", "new": "6"}]
    assert found["metrics"] == [{"name": "smoke-scenes.PC", "old": "None", "new": "1.0"}]
    assert found["tested"] == []
    (note,) = found["notes"]
    assert re.search(r"stale \(.*grade changed since\); `octopi repro`", note), (
        "epochs is a parameter of what is graded"
    )


def test_a_broken_file_is_named(copy: History) -> None:
    broken = [(name, "{") for name in ("params.yaml", f"{REPORT}/metrics.json", "dvc.lock")]
    for name, text in (*broken, ("dvc.lock", "stages: [align]\n"), ("dvc.lock", "stages: {align: 3}\n")):
        good = (copy.folder / name).read_text()
        copy.write(name, text)
        with refused(f"^workspace: .*{re.escape(Path(name).name)}.*; restore it from Git$"):
            compare(copy.folder, "HEAD")
        copy.write(name, good)


def test_an_address_is_shown_without_its_password(copy: History) -> None:
    copy.write("dvc.yaml", f"{CHAIN}params: [params.yaml]\n")
    copy.write("params.yaml", "epochs: 4\ntracking: {uri: 'http://ada:S3cret@host'}\n")
    found = json.dumps(compare(copy.folder, "HEAD"))
    assert "tracking.uri" in found
    assert "S3cret" not in found


def test_unknown_revisions_are_refused(history: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for revision in ("nowhere", "--all", "HEAD:params.yaml", "first..again"):
        with refused(f"^{revision}: no commit of a Git repository"):
            compare(history.folder, revision)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    with refused(f"^{tmp_path}: .*not a git repository; go to a clone of the project$"):
        compare(tmp_path, "HEAD")


def test_what_a_person_sees(history: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(history.folder)
    assert octopi("diff", "first", "again").strip() == "No parameter, metric or answer differs"
    file = tmp_path / "out" / "compared.json"
    told = octopi("diff", "again", "longer", "--json", file)
    for words in (r"epochs +4 +5", r"smoke-scenes\.OPD +0\.25 +0\.75", r"finetuned with all real +new - old +OPD"):
        assert re.search(words, told), words
    history.git("update-ref", "refs/exps/ab/cdef/odd-name", "longer")
    assert re.search(r"epochs +4 +5", octopi("diff", "again", "odd-name"))
    written = json.loads(file.read_text())
    assert written["differs"] is True
    assert written["tested"][0]["task"] == "OPD"
    assert history.git("status", "--porcelain") == "", "nothing is checked out"
