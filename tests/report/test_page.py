"""The page over all reports: every figure on it is a cell of a file, it fetches nothing, and says what is missing."""

import base64
import hashlib
import json
import re
import shutil
from collections import Counter
from pathlib import Path

import pytest

from pipeline.report import page as module
from pipeline.report.page import LARGEST, PAGE, left_to_users, write_page
from pipeline.report.render import WORDS
from tests.checkpoints import edit
from tests.conftest import ROOT, octopi, refused
from tests.report.conftest import Page, report, rows_of, score, words, write_reports, write_rows

NUMBER = re.compile(r"[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]\d+)?")
HOSTILE = "</style><script>alert(1)</script><img src=//evil.example onerror=alert(1)>\"'&"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Reports of two scales, one of random models, and their page; not to be changed."""
    root = write_reports(tmp_path_factory.mktemp("page"), "smoke-scenes", "small-videos")
    assert write_page(root) == root / PAGE
    return root


@pytest.fixture
def page(made: Path) -> Page:
    return Page(made / PAGE)


@pytest.fixture
def changed(tmp_path: Path) -> Path:
    """One report that a test may spoil."""
    return write_reports(tmp_path, "small-videos")


def test_it_is_written_twice_alike_and_small(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (made / PAGE).read_bytes()
    assert write_page(made).read_bytes() == before
    assert len(before) < LARGEST <= 1.5e6
    monkeypatch.setattr(module, "LARGEST", len(before) - 1)
    with refused(f"over {len(before) - 1}"):
        write_page(made)


@pytest.mark.parametrize("committed", [False, True], ids=["written now", "in Git"])
def test_every_figure_is_a_cell_of_its_row(made: Path, committed: bool) -> None:
    """Also of the page in Git, beside the reports in Git: where it is older than them, run `octopi page`."""
    root = ROOT if committed else made
    page, folders = Page(root / PAGE), {file.parent.name for file in (root / "reports").glob("*/scores.csv")}
    assert folders <= {e.get("id") for e in page.all(kind="chapter")}
    published = rows_of(ROOT / "pipeline" / "report" / "published.csv")
    printed = [float(text) for row in published for name in ("value", "n") for text in NUMBER.findall(row[name])]
    files = {file: rows_of(file) for file in (root / "reports").rglob("*.csv")}
    seen: Counter[str] = Counter()
    for row in (e for e in page.all("tr") if re.search(r":\d+$", e.get("data-source", ""))):
        file, line = row.get("data-source", "").rsplit(":", 1)
        source = files[root / "reports" / file][int(line) - 2]
        numbers = [float(text.replace(",", "")) for value in source.values() for text in NUMBER.findall(value)]
        shares = [100 * float(source["unread"]) / float(source["n"])] if source.get("unread") else []
        cells = [*numbers, *(100 * number for number in numbers), *shares]
        for cell in row.iter("td"):
            allowed = printed if cell.get("class") == "published" and "dataset" not in file else cells
            for text in [] if cell.get("class") == "words" else NUMBER.findall(words(cell)):
                near = 0.5 * 10 ** -len(text.partition(".")[2]) if "e" not in text else 0.0
                shown = abs(float(text.replace(",", "")))
                assert any(abs(shown - abs(v)) <= max(near, 5e-4 * abs(v)) + 1e-9 for v in allowed), (text, source)
                seen[file.rpartition("/")[2]] += 1
    assert seen["scores.csv"] > 1000
    assert all(seen[f"{name}.csv"] >= 6 for name in ("effects", "dataset", "speed_error")), seen


def test_published_figures_stand_only_beside_their_data(page: Page, changed: Path) -> None:
    assert "other models on other questions" in words(page.named("small-videos"))
    edit(changed / "reports" / "small-videos" / "provenance.json", dataset="another")
    (changed / "reports" / "small-videos" / "dataset.csv").unlink()
    other = Page(write_page(changed))
    assert not [cell for cell in other.all(kind="published") if cell.tag == "td"]
    assert all("so none stand here" in words(other.named(name)) for name in ("small-videos", "together"))


def test_the_current_run_comes_first_then_real_videos_then_smoke(page: Page, changed: Path) -> None:
    chapters = [e.get("id") for e in page.all(kind="chapter")]
    assert chapters == ["together", "small-videos", "smoke-scenes", "speed", "stability", "missing"]
    few, _ = page.named("together").iter("table")
    assert [words(e) for e in few.findall("thead/tr/th")][3:] == ["Measured small-videos % [95 %] (n)"], (
        "not random ones"
    )
    shutil.copytree(ROOT / "reports" / "smoke-scenes", changed / "reports" / "smoke-scenes")
    shutil.copy(ROOT / "params.yaml", changed)
    page = Page(write_page(changed))
    assert [e.get("id") for e in page.all(kind="chapter")][1:3] == ["smoke-scenes", "small-videos"]
    assert ["that params.yaml names" in words(e) for e in page.all(kind="kind")] == [True, False]


def test_nothing_is_fetched_and_nothing_runs(page: Page) -> None:
    assert page.all("script", "iframe", "object", "embed", "form", "base", "video") == []
    for element in page.root.iter():
        assert not [name for name in element.attrib if name.startswith("on") or name in ("style", "srcset")]
        assert re.fullmatch(r"|[\w/-]+\.png", element.get("src", ""))
        assert element.get("href", "").partition(":")[0] not in ("http", "https", "javascript", "file")
    (style,) = page.all("style")
    assert not re.search(r"url\(|@import", str(style.text))
    policy = next(m.attrib["content"] for m in page.all("meta") if m.get("http-equiv"))
    digest = base64.b64encode(hashlib.sha256(str(style.text).encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; img-src 'self' data:; style-src 'sha256-{digest}'")


def test_links_and_pictures_lead_somewhere(page: Page, made: Path) -> None:
    ids = Counter(e.attrib["id"] for e in page.root.iter() if e.get("id"))
    assert [name for name, count in ids.items() if count > 1] == []
    for target in (e.get("href") or e.attrib["src"] for e in page.all("a", "img")):
        assert target.removeprefix("#") in ids if target[0] == "#" else (made / "reports" / target).is_file(), target


def test_hostile_text_stays_text(changed: Path) -> None:
    folder = changed / "reports" / "small-videos"
    columns = {
        "scores.csv": ("task", "encoder"),
        "effects.csv": ("part", "change"),
        "audit.csv": ("check", "item", "measured"),
        "../speed_error.csv": ("question", "setting", "unit", "error_of"),
        "../stability.csv": ("part", "case", "verdict"),
    }
    for file, names in columns.items():
        rows = rows_of(folder / file)
        write_rows(folder / file, [*rows, *({**row, **dict.fromkeys(names, HOSTILE)} for row in rows[:40])])
    sample = json.loads((folder / "samples.json").read_text())["samples"][0]
    told = dict.fromkeys(("question_id", "predicted", "expected"), HOSTILE)
    edit(folder / "samples.json", samples=[{**sample, **told, "asked": [HOSTILE], "answered": [HOSTILE]}])
    edit(folder / "provenance.json", split=HOSTILE, settings=f"{HOSTILE} [a](javascript:alert(1)) **bold**")
    page = Page(write_page(changed))
    test_nothing_is_fetched_and_nothing_runs(page)
    assert words(page.root).count("alert(1)</script>") >= 15
    assert "bold" in [words(e) for e in page.all("strong")]


def test_what_is_missing_is_said_with_the_reason(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("small-scenes", "smoke-scenes", "large-scenes")
    reports, more = changed / "reports", write_reports(changed / "more", *names) / "reports"
    for name in names:
        (more / name).rename(reports / name)
    for file in ("small-videos/effects.csv", "small-scenes/scores.csv", "speed_error.csv"):
        (reports / file).unlink()
    (reports / "stability.csv").write_text("part,case\n")
    (reports / "smoke-scenes" / "provenance.json").write_text('{"scale": "smoke", "source": "scenes"}')
    told = json.loads((reports / "large-scenes" / "provenance.json").read_text())
    del told["python"]  # Which a template alone reads.
    (reports / "large-scenes" / "provenance.json").write_text(json.dumps(told))
    scores = reports / "small-videos" / "scores.csv"
    write_rows(scores, [row for row in rows_of(scores) if row["task"] not in ("PSR", "heads_recall")])
    monkeypatch.chdir(changed)
    Path("dvc.yaml").touch()  # As in a project.
    assert octopi("page").startswith(f"{PAGE}: ")
    page = Page(changed / PAGE)
    said = {words(e[0]): words(e[1]) for e in page.named("missing").iter("div")}
    for what in ("effects.csv", "Scenario", "Recall of the property heads"):
        assert what in said["small-videos"]
    assert "scores.csv" in said["small-scenes"]
    assert all("lacks" in said[name] for name in ("smoke-scenes", "large-scenes"))
    assert "make bench" in words(page.named("speed"))
    assert "lacks format, finite" in said["stability"]
    scores.unlink()
    with refused("make repro"):
        octopi("page")


@pytest.mark.parametrize(
    ("said", "covered"),
    [
        ({"name": "avocado-scenes", "source": "scenes", "task": "RIPE"}, set()),
        ({"name": "avocado-videos", "task": "RIPE"}, {"RIPE"}),
        ({"name": "paper-7b-videos", "touch": "photos"}, {"paper-7b-videos", "avocados photos"}),
        ({"name": "paper-7b-videos", "touch": "photos", "dataset": "PhysiCLeAR"}, {"paper-7b-videos"}),
    ],
)
def test_what_only_users_can_measure_is_missing_until_they_have(said: dict[str, str], covered: set[str]) -> None:
    cells = {key: said[key] for key in ("task", "touch") if key in said}
    about = {"source": "videos", "dataset": "avocados", **{k: v for k, v in said.items() if k not in cells}}
    left = {what for _, what, _ in left_to_users([report([score(**cells)], **about)])}
    assert {key for key, what, _ in WORDS["by_user"] if what not in left} == covered


def test_the_papers_examples_are_shown_right_and_wrong(changed: Path) -> None:
    file = changed / "reports" / "small-videos" / "samples.json"
    told = json.loads(file.read_text())
    asked = {"task": "rice", "part": "train", "asked": ["Describe.", "Cooked?"], "answered": ["Rough.", "Uncooked."]}
    examples = [{**told["samples"][0], **asked, "right": right} for right in (True, False)]
    edit(file, samples=[], examples=examples, not_asked={"toothbrush": ["handle", "bristles"]})
    page = Page(write_page(changed))
    shown = page.all("article")
    assert [words(e[0]) for e in shown] == ["rice (train): right", "rice (train): wrong"]
    assert "Asked Describe. Answered Rough. Asked Cooked? Answered Uncooked." in words(shown[0][1])
    assert "toothbrush (of handle and bristles)" in words(page.named("small-videos"))
