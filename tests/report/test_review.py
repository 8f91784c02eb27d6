"""The page over all reports: every figure on it is traced to a file, it fetches nothing, and it can be read by all."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import itertools
import json
import re
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from pipeline.io import write_json
from pipeline.cli import app
from pipeline.errors import UserError
from pipeline.reporting import write_report
from pipeline.reporting.encoder_report import write_encoder_report
from pipeline.reporting.samples import NO_PICTURES
from pipeline.review import PAGE, write_page
from pipeline.review.graph import HEIGHT, WIDTH, draw_chain
from pipeline.review.traced import Grid, fill
from pipeline.speed.gather import write_speed_error
from pipeline.speed.questions import QUESTIONS
from tests.closure import ROOT
from tests.fake_chain import fake_params, write_chain
from tests.web import Element, Sources, parse_html, says

LARGEST = 6 * 2**20
REPORTS = ("smoke-scenes", "smoke-videos")
NUMBER = re.compile(r"\d")
MEASURED = re.compile(r"\d\.\d")


def page_of(root: Path) -> Element:
    return parse_html(write_page(root).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Reports of two made-up chains: one with every variant, one with two seeds and of videos that are called real."""
    root = tmp_path_factory.mktemp("reports")
    shutil.copy(ROOT / "dvc.yaml", root)
    for name, overrides, skill in (
        ("factorial", ("ablation.plan=factorial",), 0.7),
        ("real", ("ablation.plan=single", "ablation.seeds=[0,3]"), 0.5),
    ):
        params = fake_params(*overrides)
        chain = root / f"chain-{name}"
        write_chain(chain, params, skill=skill)
        if name == "real":
            params = params.model_copy(update={"data": params.data.model_copy(update={"source": "videos"})})
        with pytest.MonkeyPatch.context() as patch:
            if name == "real":
                # Drawing figures takes seconds, and the other report has all of them.
                patch.setattr("pipeline.reporting.report._draw", lambda *_: [])
            write_report(params, chain)
        write_encoder_report(params, chain)
        shutil.move(chain / "reports" / params.report_name, root / "reports" / params.report_name)
    shutil.copytree(ROOT / "reports" / "bench", root / "reports" / "bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.speed.gather.draw_pareto", copy_plot)
        write_speed_error(root)
    return root


def copy_plot(_: object, path: Path, *__: object) -> None:
    """In the place of drawing, which takes seconds."""
    path.parent.mkdir(exist_ok=True)
    shutil.copy(ROOT / "reports" / "bench" / "selection.png", path)


@pytest.fixture(scope="module")
def own() -> Element:
    return parse_html((ROOT / PAGE).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def fresh(made: Path) -> Element:
    return page_of(made)


@pytest.fixture(params=["own", "fresh"])
def page(request: pytest.FixtureRequest) -> Element:
    """The page in Git, and one of made-up reports."""
    found: Element = request.getfixturevalue(request.param)
    return found


@pytest.fixture
def reports(request: pytest.FixtureRequest) -> Path:
    """The folder that `page` is about."""
    root: Path = ROOT if request.node.callspec.params["page"] == "own" else request.getfixturevalue("made")
    return root / "reports"


def test_the_page_in_git_is_that_of_the_reports_in_git(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "reports", tmp_path / "reports")
    shutil.copy(ROOT / "dvc.yaml", tmp_path)
    before = (ROOT / PAGE).read_bytes()
    assert write_page(tmp_path).read_bytes() == before, "reports/ or dvc.yaml changed: run `octopi page`"


def test_every_figure_is_what_its_file_says(page: Element, reports: Path) -> None:
    sources, wrong, figures = Sources(reports), [], 0
    for element in page.walk():
        source = element.attributes.get("data-source", "")
        if not source or element.tag == "img":
            continue
        value = sources.value(source)
        if source.endswith("#"):
            right = plain_of(element) in value
        else:
            right = says(element.text, value, float(element.attributes.get("data-factor", 1)))
            figures += bool(NUMBER.search(element.text))
        if not right:
            wrong.append((element.text, source, value))
    assert wrong == []
    assert figures > 1000


def plain_of(element: Element) -> str:
    return " ".join(re.sub(r"[*`>]", "", element.text).split())


def test_no_figure_stands_on_the_page_without_a_file(page: Element, reports: Path) -> None:
    names = {path.relative_to(reports).as_posix() for path in reports.rglob("*")}
    orphans = []
    for text, element in page.texts():
        if NUMBER.search(text) and not element.within("data-source") and text.strip() not in names:
            outside = {e.tag for e in element.above} & {"style", "title", "thead"} or element.within("data-prose")
            if not outside or (MEASURED.search(text) and element.tag != "style"):
                orphans.append(text)
    assert orphans == []


def test_cells_of_tables_hold_nothing_that_was_typed_in(page: Element) -> None:
    for cell in page.find("td"):
        if not {e.tag for e in cell.above} & {"thead"}:
            for text, element in cell.texts():
                assert element.within("data-source") or not NUMBER.search(text), text
                assert not element.within("data-prose")


def test_published_figures_are_marked_and_measured_ones_are_not_from_the_paper(page: Element) -> None:
    with (ROOT / "pipeline" / "reporting" / "published.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    printed = {float(line["value"]) for line in lines}
    # What a part brings: one printed cell less another of the same row and model.
    brought = {
        round(float(one["value"]) - float(other["value"]), 2)
        for one, other in itertools.permutations(lines, 2)
        if all(one[name] == other[name] for name in ("table", "row", "model"))
    }
    published = 0
    for cell in page.find("td"):
        kind = cell.attributes.get("class", "").split()
        columns = {e.attributes["data-source"].split(":")[-1] for e in cell.walk() if "data-source" in e.attributes}
        assert ("published" in kind) == any(c.startswith("published") for c in columns) or not columns
        for element in cell.walk():
            source = element.attributes.get("data-source", "")
            if re.search(r":published(_7b|_13b|_percent)?$", source):
                published += 1
                if "directions.csv" in source:
                    assert round(float(element.text), 2) in brought
                else:
                    assert any(abs(float(element.text) - value) < 0.5 for value in printed)
    assert published > 50


def test_pictures_are_those_of_the_reports_and_have_texts(page: Element, reports: Path) -> None:
    pictures = page.find("img")
    assert pictures
    for picture in pictures:
        kind, _, data = picture.attributes["src"].partition(",")
        assert kind == "data:image/webp;base64"
        files = io.BytesIO(base64.b64decode(data)), reports / picture.attributes["data-source"]
        shown, stored = (np.asarray(Image.open(file).convert("RGBA")) for file in files)
        np.testing.assert_array_equal(shown, stored)
        assert len(picture.attributes["alt"]) > 10
        assert int(picture.attributes["width"]) > 0


def test_nothing_is_fetched_and_nothing_runs(page: Element) -> None:
    assert page.find("script", "iframe", "object", "embed", "video", "audio", "form", "base") == []
    for element in page.walk():
        assert not [name for name in element.attributes if name.startswith("on") or name in ("style", "srcset")]
        assert element.attributes.get("src", "data:").startswith("data:")
    (style,) = page.find("style")
    assert "url(" not in style.text
    assert "@import" not in style.text
    policy = next(m.attributes["content"] for m in page.find("meta") if "http-equiv" in m.attributes)
    digest = base64.b64encode(hashlib.sha256(style.text.encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'")
    assert [e.attributes["href"] for e in page.find("link")] == ["data:,"]


def test_links_lead_somewhere(page: Element, reports: Path) -> None:
    ids = [e.attributes["id"] for e in page.walk() if "id" in e.attributes]
    assert [name for name, count in Counter(ids).items() if count > 1] == []
    for link in page.find("a"):
        target = link.attributes["href"]
        assert target.removeprefix("#") in ids if target.startswith("#") else (reports / target).is_file(), target
    for element in page.walk():
        for name in element.attributes.get("aria-labelledby", "").split():
            assert name in ids


def test_the_page_can_be_read_aloud(page: Element) -> None:
    (html,) = page.find("html")
    assert html.attributes["lang"] == "en"
    for landmark in ("header", "nav", "main", "footer", "h1", "title"):
        assert len(page.find(landmark)) == 1, landmark
    levels = [int(e.tag[1]) for e in page.find("h1", "h2", "h3", "h4", "h5")]
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    links = page.find("a")
    assert (links[0].attributes["class"], links[0].attributes["href"]) == ("skip", "#content")
    for table in page.find("table"):
        assert len(table.find("caption")) == 1
        assert all("scope" in head.attributes for head in table.find("th"))
        rows = [row for row in table.find("tr") if any(e.tag == "tbody" for e in row.above)]
        assert rows
        assert all(row.find("th") for row in rows)
        widths = {len(row.find("td", "th")) for row in rows} | {len(table.find("thead")[0].find("tr")[-1].find("th"))}
        assert len(widths) == 1, table.text[:80]
    for region in page.walk():
        if "scroll" in region.attributes.get("class", "").split():
            assert region.attributes["tabindex"] == "0", "what scrolls can be scrolled by keys"
    for drawing in page.find("svg"):
        labelled = drawing.attributes.get("role") == "img" and drawing.attributes.get("aria-label")
        assert (
            labelled
            or drawing.attributes.get("aria-hidden") == "true"
            or drawing.parent is None
            or "legend" in (drawing.parent.parent.attributes.get("class", "") if drawing.parent.parent else "")
        )


def test_colours_have_contrast() -> None:
    style = (ROOT / "pipeline" / "review" / "templates" / "style.css").read_text()
    light, dark = (
        dict(re.findall(r"--([\w-]+): (#\w+);", block)) for block in re.findall(r":root \{(.*?)\}", style, re.S)[:2]
    )
    for theme in (light, dark):
        for ground in ("bg", "surface", "tint"):
            for ink in ("text", "muted", "measured", "published", "good", "bad"):
                assert contrast(theme[ink], theme[ground]) >= 4.5, (ink, ground)
        assert contrast(theme["warn"], theme["warn-bg"]) >= 4.5


def contrast(one: str, other: str) -> float:
    """By the WCAG's formula."""

    def luminance(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_the_page_is_small_and_has_no_date() -> None:
    text = (ROOT / PAGE).read_text(encoding="utf-8")
    assert len(text) < LARGEST
    assert not re.search(r"\b20\d\d-\d\d-\d\d\b", text)


def test_equal_reports_give_equal_bytes(made: Path) -> None:
    assert write_page(made).read_bytes() == write_page(made).read_bytes()


def test_all_parts_are_there(fresh: Element) -> None:
    text = fresh.words
    for title in (
        "At a glance",
        "The chain",
        "Is touch used?",
        "What each part brings",
        "Main effects and interactions",
        "Why results differ from run to run",
        "Describing what is needed, or everything",
        "Sample answers",
        "Map of the embeddings",
        "Training curves",
        "Data audit",
        "Speed against error",
        "Numerical stability",
        "What is missing, and why",
    ):
        assert title in text, title
    assert len([t for t in fresh.find("table") if "matrix" in t.attributes.get("class", "")]) == 6
    assert "projection all zero bfloat16 True 3.1e-03 1.0e-02 passed" in fresh.words
    assert "4 passed" in fresh.text
    assert "0 failed" in fresh.text
    assert "There are no rows in float16" in text
    assert "nothing has written a stability.csv" not in text


def test_the_comparison_of_encoders_says_where_it_comes_from_itself(fresh: Element) -> None:
    sources = [e.attributes.get("data-source", "") for e in fresh.walk()]
    assert sources.count("smoke-scenes/encoder/provenance.json#revision") == 1
    captions = [e for e in fresh.walk() if e.attributes.get("data-source") == "smoke-scenes/encoder/README.md#"]
    assert any(e.text.startswith("Grouped cross-validation: ") for e in captions)
    assert not [s for s in sources if "smoke-scenes/README.md" in s and "cross-validation" in s]


def test_real_videos_have_no_picture_and_the_page_says_why(fresh: Element, made: Path) -> None:
    assert not list((made / "reports" / "smoke-videos" / "samples").glob("*.png"))
    (chapter,) = [e for e in fresh.walk() if e.attributes.get("id") == "smoke-videos-samples"]
    assert NO_PICTURES in chapter.text
    assert chapter.find("article")
    assert chapter.find("img") == []
    (scenes,) = [e for e in fresh.walk() if e.attributes.get("id") == "smoke-scenes-samples"]
    assert scenes.find("img")


@pytest.mark.parametrize(
    ("figure", "template", "shown"),
    [
        ("30.625", "{x:.2f}", "30.63"),
        ("2.675", "{x:.2f}", "2.68"),
        ("0.5965", "{x:p.2f}", "59.65"),
        ("-0.0004", "{x:p+.2f}", "-0.04"),
        ("1.0", "{x:p.2f}", "100.00"),
        ("6.5", "{x:g}", "6.5"),
        ("4.0", "{x:g}", "4"),
        ("0: 33.33", "{x}", "0: 33.33"),
        ("none", "{x:.2f}", "none"),
        ("", "{x:.2f}", ""),
        ("3.1e-05", "{x:.5f}", "0.00003"),
    ],
)
def test_figures_are_rounded_as_one_learns_at_school(figure: str, template: str, shown: str) -> None:
    grid = Grid("some.csv", ("x",), ((figure,),))
    assert "".join(piece.text for piece in fill(template, grid, 0)) == shown


def test_a_single_run_shows_no_deviation_and_two_do(fresh: Element) -> None:
    one, two = (
        next(t for t in fresh.find("table") if t.attributes.get("id") == f"{name}-why-results-differ-from-run-to-run")
        for name in ("smoke-scenes", "smoke-videos")
    )
    heads = [table.find("thead")[0].words for table in (one, two)]
    assert "over seeds" not in heads[0]
    assert "at the most" in heads[0]
    assert "one run says nothing of others" in one.words
    assert "± over seeds" in heads[1]
    assert "± by answers alone" in heads[1]
    assert "at the most" not in heads[1]


def test_an_empty_cell_says_why(fresh: Element) -> None:
    empty = [e for e in fresh.find("td") if "empty" in e.attributes.get("class", "").split()]
    assert "variant not in the plan `single`" in {e.words for e in empty}
    assert all("measured" in e.attributes["class"] for e in empty)
    for cell in empty:
        assert cell.parent is not None
        assert cell.parent.find("circle") == [], "what was not measured is not drawn"


def test_samples_show_right_and_wrong_answers(fresh: Element, made: Path) -> None:
    sheet = json.loads((made / "reports" / "smoke-scenes" / "samples" / "samples.json").read_text())
    (chapter,) = [e for e in fresh.walk() if e.attributes.get("id") == "smoke-scenes-samples"]
    cards = chapter.find("article")
    assert [c.attributes["class"].split()[1] == "good" for c in cards] == [s["right"] for s in sheet["samples"]]
    for card, sample in zip(cards, sheet["samples"], strict=True):
        for text in (*sample["asked"], *sample["answered"], *sample["reference"], sample["question_id"]):
            assert " ".join(text.split()) in card.words


@pytest.fixture
def changed(made: Path, tmp_path: Path) -> Path:
    """A copy of the made-up reports to spoil."""
    shutil.copytree(made / "reports", tmp_path / "reports")
    shutil.copy(made / "dvc.yaml", tmp_path)
    return tmp_path


def test_what_a_model_says_is_never_markup(changed: Path) -> None:
    file = changed / "reports" / "smoke-scenes" / "samples" / "samples.json"
    sheet = json.loads(file.read_text())
    sheet["samples"][0]["answered"] = ["<script>alert(1)</script><img src=x onerror=alert(1)> & so on"]
    write_json(file, sheet)
    page = page_of(changed)
    assert page.find("script") == []
    assert "<script>alert(1)</script><img src=x onerror=alert(1)> & so on" in page.text


def test_columns_that_no_view_knows_are_shown(changed: Path) -> None:
    table = changed / "reports" / "smoke-scenes" / "tables" / "understanding.csv"
    lines = table.read_text().splitlines()
    table.write_text(
        "\n".join([lines[0] + ",smallest_effect", *(f"{line},0.{i}7" for i, line in enumerate(lines[1:]))])
    )
    (shown,) = [
        e for e in page_of(changed).find("table") if e.attributes.get("id") == "smoke-scenes-physical-understanding"
    ]
    assert "smallest effect" in shown.find("thead")[0].text
    assert "0.17" in shown.text


def test_tables_that_no_view_knows_are_shown(changed: Path) -> None:
    (changed / "reports" / "smoke-scenes" / "language" / "interactions.csv").write_text(
        "pair,difference\nencoder x OPD,0.25\n"
    )
    (changed / "reports" / "speed_error.csv").write_text("question,setting,ratio\nwhich frames,uniform,1.5\n")
    text = page_of(changed).words
    assert "encoder x OPD" in text
    assert "Interactions" in text
    assert "which frames" in text
    assert "uniform 1.500" in text, "without a recommendation, captions and plots as well"


def test_of_simulated_coverage_what_the_reports_use_is_shown_the_worst_first(fresh: Element) -> None:
    used = [row for row in json.loads((ROOT / "reports" / "bench" / "coverage.json").read_text()) if row["reported"]]
    short = sum("liberal" in row["verdict"] for row in used)
    assert 0 < short < len(used)
    (block,) = [e for e in fresh.find("section") if e.words.startswith("Do intervals hold what they promise?")]
    rows = [row.words for row in block.find("tr")[1:]]
    assert len(rows) == len(used)
    assert ["liberal" in words for words in rows] == [True] * short + [False] * (len(used) - short)


def test_variants_of_several_seeds_are_summed_up_and_left_to_their_file(fresh: Element, made: Path) -> None:
    one, two = (next(e for e in fresh.walk() if e.attributes.get("id") == f"{name}-parts") for name in REPORTS)
    title = "Language model: every variant"
    assert title in {caption.words for caption in one.find("caption")}
    assert title not in {caption.words for caption in two.find("caption")}
    (block,) = [e for e in two.find("section") if e.words.startswith(title)]
    file = "smoke-videos/language/ablation.csv"
    with (made / "reports" / file).open(newline="") as stream:
        rows = len(list(csv.DictReader(stream)))
    assert [a.attributes["href"] for a in block.find("a")] == [file]
    assert [e.text for e in block.walk() if e.attributes.get("data-source") == f"{file}#count"] == [str(rows)]


def test_a_table_that_several_reports_share_is_shown_once(changed: Path) -> None:
    text = "part,case,dtype,finite,error,bound,verdict\nloss,logits of 0,float64,True,0.0,1e-15,{}\n"
    files = [changed / "reports" / name / "tables" / "stability.csv" for name in REPORTS]
    for verdict, shown in (("ok", 1), ("failed", 2)):
        files[0].write_text(text.format("ok"))
        files[1].write_text(text.format(verdict))
        (chapter,) = [e for e in page_of(changed).walk() if e.attributes.get("id") == "stability"]
        assert len(chapter.find("table")) == shown
        links = [a.attributes["href"] for a in chapter.find("a")]
        assert links == [f"{name}/tables/stability.csv" for name in REPORTS]


def test_speed_against_error_has_a_recommendation_a_plot_and_a_table_each(page: Element, reports: Path) -> None:
    with (reports / "speed_error.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    (chapter,) = [e for e in page.walk() if e.attributes.get("id") == "speed"]
    titles = {question.key: question.title for question in QUESTIONS}
    first, *blocks = [e for e in chapter.find("section") if "block" in e.attributes.get("class", "")]
    chosen = [line for line in lines if line["recommended"] == "True"]
    rows = [row.words for row in first.find("tr")[1:]]
    assert len(rows) == len(chosen)
    assert all(words.startswith(f"{c['question']} {c['setting']} ") for words, c in zip(rows, chosen, strict=True))
    for block, line in zip(blocks, chosen, strict=False):
        assert block.find("h3")[0].words == titles[line["question"]]
        settled = [other for other in lines if other["question"] == line["question"]]
        own = [other["setting"] for other in settled]
        assert len(block.find("img")) == any(other["error"] for other in settled), "without an error, nothing to plot"
        settings = [row.find("th")[0].words for row in block.find("tr")[1:]]
        assert settings == own, "all of them, none folded away"
        assert block.find("details") == []
        flagged = [row for row in block.find("tr")[1:] if any(c.words == "True" for c in row.find("td"))]
        assert [row.find("th")[0].words for row in flagged] == [line["setting"]]
        (caption,) = [p for p in block.find("p") if p.attributes.get("class") == "caption"]
        assert caption.text.startswith(f"Recommended: {line['setting']} ")


def test_what_speed_is_not_measured_is_among_what_is_missing(page: Element, reports: Path) -> None:
    with (reports / "speed_error.csv").open(newline="") as stream:
        there = {line["question"] for line in csv.DictReader(stream)}
    (missing,) = [e for e in page.walk() if e.attributes.get("id") == "missing"]
    rows = [row.words for row in missing.find("tr")]
    for question in QUESTIONS:
        named = [row for row in rows if row.startswith(f"speed {question.title} ")]
        assert len(named) == (question.key not in there)
        assert all("make bench SECTION=" in row or "dvc repro" in row for row in named)


def test_what_is_missing_is_named_with_the_reason(changed: Path) -> None:
    folder = changed / "reports" / "smoke-scenes"
    (folder / "language" / "describing.csv").unlink()
    (folder / "language" / "touch.csv").unlink()
    (folder / "language" / "seeds.csv").unlink()
    shutil.rmtree(folder / "samples")
    shutil.rmtree(folder / "encoder")
    for file in (changed / "reports").rglob("stability.csv"):
        file.unlink()
    readme = (folder / "README.md").read_text()
    (folder / "README.md").write_text(
        re.sub(r"!\[[^]]*\]\(figures/embedding_map.png\)\n\n(.*)\n", r"\1\n\nNot drawn: one video alone.\n", readme)
    )
    write_json(changed / "reports" / "bench" / "frames.json", [])
    page = page_of(changed)
    (missing,) = [e for e in page.walk() if e.attributes.get("id") == "missing"]
    rows = [row.words for row in missing.find("tr")]
    for said in (
        "smoke-scenes Map of the embeddings one video alone.",
        "smoke-scenes Is touch used? the report is older than this table",
        "smoke-scenes Sample answers the report is older",
        "smoke-videos Describing what is needed, or everything its plan has no variant with OPD needed",
        "smoke-videos Main effects and interactions its plan crosses no two parts",
        "smoke-scenes Encoders over all objects its models have not been cross-validated; ",
        "smoke-scenes Why results differ from run to run the report is older than this table",
        "speed Section frames its run measured nothing",
        "all reports Numerical stability nothing has written a stability.csv yet",
    ):
        assert any(row.startswith(said) for row in rows), (said, rows)
    assert any("OPD questions are not put to a system that never describes" in row for row in rows)


def test_a_report_of_little_more_than_a_title_has_its_place(changed: Path) -> None:
    bare = changed / "reports" / "small-scenes"
    bare.mkdir()
    (bare / "README.md").write_text("# Report: scale small\n\nTested on nothing.\n")
    page = page_of(changed)
    assert "Tested on nothing." in page.text


def test_without_a_report_one_line_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="make repro"):
        write_page(tmp_path)
    (tmp_path / "reports" / "bench").mkdir(parents=True)
    shutil.copy(ROOT / "dvc.yaml", tmp_path)
    with pytest.raises(UserError, match="no report yet"):
        write_page(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert isinstance(CliRunner().invoke(app, ["page"]).exception, UserError)


def test_the_command_names_the_page(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(changed)
    monkeypatch.setattr("pipeline.speed.gather.draw_pareto", copy_plot)
    (changed / "reports" / "speed_error.csv").unlink()
    result = CliRunner().invoke(app, ["page"])
    assert result.exit_code == 0, result.output
    assert result.output.startswith("reports/index.html: ")
    assert (changed / "reports" / "speed_error.csv").is_file()
    assert "octopi page" in (ROOT / "Makefile").read_text()


def test_the_chain_is_drawn_as_dvc_has_it() -> None:
    drawing = draw_chain(ROOT / "dvc.yaml")
    names = [node.name for node in drawing.nodes]
    assert set(names) == {file.stem for file in (ROOT / "stages").glob("*.py")}
    place = {node.name: node for node in drawing.nodes}
    ways = ["synthesize", "extract_frames", "split", "audit", "questions", "align", "lora", "answer", "grade", "report"]
    heights = [place[name].y for name in (*ways, "publish")]
    assert heights == sorted(heights)
    assert len(set(heights)) == len(heights)
    for name in ("finetune_encoder", "cross_validate"):
        assert place["pretrain"].y < place[name].y < place["report"].y
    assert place["finetune_encoder"].y < place["embed"].y < place["align"].y
    for one in drawing.nodes:
        assert WIDTH / 2 <= one.x <= drawing.width - WIDTH / 2
        assert HEIGHT / 2 <= one.y <= drawing.height - HEIGHT / 2
        for other in drawing.nodes:
            assert one is other or abs(one.x - other.x) >= WIDTH or abs(one.y - other.y) >= HEIGHT
    assert {node.plan for node in drawing.nodes if node.name == "answer"} == {"plan.variants"}
