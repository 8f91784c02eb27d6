"""The page over all reports: every figure on it is a cell of a file, it fetches nothing, and it says what is missing."""

from __future__ import annotations

import base64
import csv
import hashlib
import itertools
import json
import re
import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.errors import UserError
from pipeline.report import page as module
from pipeline.report.drawing import SIZE, place_points, span
from pipeline.report.page import LARGEST, PAGE, write_page
from pipeline.tasks import TASKS
from tests.closure import ROOT
from tests.report.shared import Element, Page, named, read_csv, score, write_csv, write_reports

NUMBER = re.compile(r"[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]\d+)?")
HOSTILE = "</style><script>alert(1)</script><img src=//evil.example onerror=alert(1)>\"'&"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Reports of three scales; not to be changed."""
    return write_reports(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def page(made: Path) -> Element:
    return Page(write_page(made)).root


@pytest.fixture
def changed(made: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(made / "reports", tmp_path / "reports")
    return tmp_path


def test_it_is_written_twice_alike_and_small(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = write_page(made).read_bytes()
    assert write_page(made).read_bytes() == before
    assert len(before) < LARGEST <= 1.5e6
    monkeypatch.setattr(module, "LARGEST", 1000)
    with pytest.raises(UserError, match="over 1000"):
        write_page(made)


def test_the_page_in_git_is_that_of_the_reports_in_git(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "reports", tmp_path / "reports")
    assert write_page(tmp_path).read_bytes() == (ROOT / PAGE).read_bytes(), "reports/ changed: run `octopi page`"


def candidates(row: dict[str, str]) -> list[float]:
    """What a row of a CSV may be shown as: its numbers, percent of them, and unread answers as a share."""
    numbers = {name: float(value) for name, value in row.items() if NUMBER.fullmatch(value)}
    shares = [100 * numbers["unread"] / numbers["n"]] if "unread" in numbers else []
    return [*numbers.values(), *(100 * number for number in numbers.values()), *shares]


def test_every_figure_is_a_cell_of_its_row(page: Element, made: Path) -> None:
    with (ROOT / "pipeline" / "report" / "published.csv").open(newline="") as stream:
        printed = [float(row[name]) for row in csv.DictReader(stream) for name in ("value", "n") if row[name]]
    seen: Counter[str] = Counter()
    for row in (e for e in page.find("tr") if re.search(r":\d+$", e.attributes.get("data-source", ""))):
        file, line = row.attributes["data-source"].rsplit(":", 1)
        source = read_csv(made / "reports" / file)[int(line) - 2]
        for cell in row.find("td"):
            allowed = printed if "published" in cell.kinds() else candidates(source)
            for text in [] if "words" in cell.kinds() else NUMBER.findall(cell.text):
                digits = len(text.partition("e")[0].partition(".")[2])
                near = 0.5 * 10**-digits if "published" in cell.kinds() or digits < 4 else 1e-3
                assert any(abs(abs(float(text.replace(",", ""))) - abs(v)) <= near + 1e-9 for v in allowed), (text, source)
                seen[file.rpartition("/")[2]] += 1
    assert seen["scores.csv"] > 500
    assert min(seen[name] for name in ("effects.csv", "dataset.csv", "speed_error.csv", "stability.csv")) >= 2


def test_no_table_holds_a_figure_without_its_file(page: Element) -> None:
    for cell in page.find("td"):
        assert any("data-source" in e.attributes for e in cell.above()) or not NUMBER.search(cell.text), cell.text


def test_lines_are_drawn_where_the_figures_are(page: Element, made: Path) -> None:
    for file, middle in (("scores", False), ("effects", True)):
        rows = read_csv(made / "reports" / "small-videos" / f"{file}.csv")
        drawn = [r for r in page.find("tr") if f"small-videos/{file}.csv" in r.attributes.get("data-source", "") and r.find("svg")]
        assert len(drawn) == (5 if file == "scores" else len(rows))
        half = span(max(100 * abs(float(r[end])) for r in rows for end in ("low", "high"))) if middle else 0
        for row in drawn:
            source = rows[int(row.attributes["data-source"].rsplit(":", 1)[1]) - 2]
            (dot,), (interval,) = row.find("circle"), [e for e in row.find("line") if "interval" in e.kinds()]
            shown = [dot.attributes["cx"], interval.attributes["x1"], interval.attributes["x2"]]
            for text, name in zip(shown, ("difference" if middle else "accuracy", "low", "high"), strict=True):
                value = float(source[name])
                assert float(text.strip("%")) == pytest.approx(50 + 5000 * value / half if middle else 100 * value, abs=0.01)
            assert len([e for e in row.find("path") if "diamond" in e.kinds()]) == (0 if middle else 2)


def test_published_figures_stand_in_cells_of_their_own_and_only_beside_their_data(page: Element, changed: Path) -> None:
    for row in named(page, "small-videos").find("tr"):
        kinds = [cell.kinds() & {"measured", "published"} for cell in row.find("td")]
        assert all(len(kind) <= 1 for kind in kinds)
    assert "other models on other questions" in named(page, "small-videos").text
    file = changed / "reports" / "small-videos" / "provenance.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "dataset": "another"}))
    report = named(Page(write_page(changed)).root, "small-videos")
    assert not [cell for cell in report.find("td") if "published" in cell.kinds() and cell.text]
    assert "so none stand here" in report.text


def test_the_first_screen_comes_first_and_real_videos_before_scenes_before_smoke(page: Element) -> None:
    chapters = [e.attributes["id"] for e in page.find("section") if "chapter" in e.kinds()]
    assert chapters == ["small-videos", "small-scenes", "smoke-scenes", "speed", "stability", "missing"]
    order = [e.attributes["id"] for e in named(page, "small-videos").find("h3")]
    assert [i.removeprefix("small-videos-") for i in order] == ["tasks", "effects", "stands-on", "origin", "tables", "files"]
    finding = next(e for e in named(page, "small-videos").walk() if "finding" in e.kinds())
    assert "stand-in" in finding.find("p")[0].text
    assert "only that the chain runs" in named(page, "smoke-scenes").text


def test_nothing_is_fetched_and_nothing_runs(page: Element, made: Path) -> None:
    assert page.find("script", "iframe", "object", "embed", "img", "form", "base", "video") == []
    for element in page.walk():
        assert not [name for name in element.attributes if name.startswith("on") or name in ("style", "src", "srcset")]
        assert element.attributes.get("href", "").partition(":")[0] not in ("http", "https", "javascript", "file")
    (style,) = page.find("style")
    assert "url(" not in str(style.children)
    assert "@import" not in str(style.children)
    policy = next(m.attributes["content"] for m in page.find("meta") if "http-equiv" in m.attributes)
    digest = base64.b64encode(hashlib.sha256("".join(map(str, style.children)).encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'")


def test_it_can_be_read_aloud_and_links_lead_somewhere(page: Element, made: Path) -> None:
    ids = Counter(e.attributes["id"] for e in page.walk() if "id" in e.attributes)
    assert [name for name, count in ids.items() if count > 1] == []
    for link in (e for e in page.find("a") if not e.text.endswith((".md", "params.yaml"))):
        target = link.attributes["href"]
        assert target.removeprefix("#") in ids if target.startswith("#") else (made / "reports" / target).is_file(), target
    levels = [int(e.tag[1]) for e in page.find("h1", "h2", "h3", "h4")]
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    for table in page.find("table"):
        assert len(table.find("caption")) == 1
        assert all("scope" in head.attributes for head in table.find("th"))
    for drawing in page.find("svg"):
        hidden = any(e.attributes.get("aria-hidden") == "true" for e in drawing.above())
        assert hidden or (drawing.attributes["role"] == "img" and len(drawing.attributes["aria-label"]) > 20)
    assert all(e.attributes["tabindex"] == "0" for e in page.walk() if "scroll" in e.kinds())


def test_colours_have_contrast() -> None:
    style = (ROOT / "pipeline" / "report" / "templates" / "style.css").read_text()
    themes = [dict(re.findall(r"--([\w-]+): (#\w{6});", block)) for block in re.findall(r":root \{(.*?)\}", style, re.S)]
    assert len(themes) == 2
    for theme, ground, ink in itertools.product(themes, ("bg", "surface", "tint"), ("text", "muted", "measured", "published")):
        dark, light = sorted(luminance(theme[name]) for name in (ground, ink))
        assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, ground)


def luminance(colour: str) -> float:
    """By the WCAG's formula."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_hostile_text_stays_text(changed: Path) -> None:
    folder = changed / "reports" / "small-videos"
    for file, columns in (("effects.csv", ("part", "change")), ("audit.csv", ("check", "item", "severity")), ("scores.csv", ("task",)), ("../speed_error.csv", ("question", "setting", "unit")), ("../stability.csv", ("part", "format", "case"))):  # fmt: skip
        rows: list[dict[str, Any]] = list(read_csv(folder / file))
        write_csv(folder / file, [*rows, {**rows[0], **dict.fromkeys(columns, HOSTILE)}])
    samples = json.loads((folder / "samples.json").read_text())
    samples["samples"][0] |= {"question_id": HOSTILE, "asked": [HOSTILE], "answered": [HOSTILE], "predicted": HOSTILE}
    (folder / "samples.json").write_text(json.dumps(samples))
    said = json.loads((folder / "provenance.json").read_text())
    (folder / "provenance.json").write_text(json.dumps({**said, "settings": f"{HOSTILE} [x](javascript:alert(1))", "split": HOSTILE}))
    page = Page(write_page(changed)).root
    test_nothing_is_fetched_and_nothing_runs(page, changed)
    assert page.text.count("alert(1)</script>") >= 15


def test_what_is_missing_is_said_with_the_reason(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reports = changed / "reports"
    for file in ("small-videos/effects.csv", "small-videos/samples.json", "small-videos/audit.csv", "small-scenes/scores.csv", "speed_error.csv", "stability.csv"):  # fmt: skip
        (reports / file).unlink()
    (reports / "smoke-scenes" / "provenance.json").write_text('{"scale": "smoke", "source": "scenes"}')
    rows = [row for row in read_csv(reports / "small-videos" / "scores.csv") if row["task"] not in ("PSR", "heads")]
    write_csv(reports / "small-videos" / "scores.csv", [dict(row) for row in rows])
    page = Page(write_page(changed)).root
    said = {e.find("dt")[0].text: e.find("dd")[0].text for e in named(page, "missing").find("div")}
    for words in ("effects.csv", "samples.json", "Property Scenario Reasoning", "Property heads of the tactile encoder"):
        assert words in said["small-videos"]
    assert "scores.csv" in said["small-scenes"]
    assert "lacks" in said["smoke-scenes"]
    assert "make bench" in said["speed"]
    assert "make stability" in said["stability"]
    assert "not measured" in named(page, "small-videos").text
    for file in reports.glob("*/scores.csv"):
        file.unlink()
    monkeypatch.chdir(changed)
    assert "make repro" in str(CliRunner().invoke(app, ["page"]).exception)


def test_a_task_is_on_the_page_once_its_scores_are_there(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TASKS, "TOY", SimpleNamespace(title="Telling toys apart", trained=True, measure="choice"))
    file = changed / "reports" / "small-videos" / "scores.csv"
    write_csv(file, [*(dict(row) for row in read_csv(file)), score("TOY", 4)])
    monkeypatch.chdir(changed)
    assert CliRunner().invoke(app, ["page"]).output.startswith(f"{PAGE}: ")
    report = named(Page(changed / PAGE).root, "small-videos")
    assert "Telling toys apart" in report.find("table")[0].text
    for table in ("understanding", "variants"):
        assert "Telling toys apart" in named(report, f"small-videos-{table}").text
    assert "not asked" in named(Page(changed / PAGE).root, "missing").text, "the other reports lack it"


def test_speed_and_stability_are_told(page: Element) -> None:
    plot = next(e for e in named(page, "speed").find("svg") if "plot" in e.kinds())
    assert [e.text for e in plot.find("text") if "on" in e.kinds()] == ["1", "2"]
    assert [e.text.partition(":")[0] for e in named(page, "speed").find("li")] == ["1 frames", "0 frames"]
    assert "2 hard cases, 1 failed" in named(page, "stability").text


@given(st.lists(st.tuples(st.floats(0.01, 100), st.floats(0, 5), st.floats(0, 1)), min_size=2, max_size=9))
def test_points_lie_in_the_frame_and_keep_their_order(points: list[tuple[float, float, float]]) -> None:
    rows = pd.DataFrame(
        [{"setting": "s", "cost_ratio": c, "error": e, "low": e - w, "high": e + w, "front": True} for c, e, w in points]
    )
    placed = place_points(rows)
    assert placed is not None
    for dot in placed.dots:
        assert SIZE["left"] <= dot["x"] <= SIZE["width"] - SIZE["right"]
        assert SIZE["top"] <= dot["high"] <= dot["y"] <= dot["low"] <= SIZE["bottom"]
    assert [dot["number"] for dot in placed.dots] == list(range(1, len(points) + 1))
    costs = [dot["x"] for dot in placed.dots]
    assert costs == sorted(costs)
    for (_, one, _), (_, other, _) in itertools.combinations(points, 2):
        heights = {error: dot["y"] for (_, error, _), dot in zip(sorted(points, key=lambda p: p[0]), placed.dots, strict=True)}
        assert (heights[one] - heights[other]) * (one - other) <= 0, "more error stands higher"
    assert len(placed.up) >= 2
