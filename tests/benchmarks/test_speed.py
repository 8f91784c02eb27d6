"""Speed against error over all parts: every row is what its source says, and the rule recommends what it says."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.io import write_json
from pipeline.benchmarks import scenes, selection
from pipeline.errors import UserError
from pipeline.scenes.light import NOISE
from pipeline.speed.gather import picture_of, write_speed_error
from pipeline.speed.questions import POINTS, QUESTIONS, Answer, gather, recommended
from pipeline.speed.rows import SpeedRow
from tests.closure import ROOT

COLUMNS = "question,setting,cost,unit,ratio,frames,tokens,flops,bytes,error,low,high,recommended"
WITHOUT_ERROR = {"language model, training"}
"""Questions whose settings compute the same: only what they cost differs."""
Cells = Mapping[str, str]


@pytest.fixture(autouse=True)
def no_drawing(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots have tests of their own; here one test draws them."""
    if "drawn" not in request.keywords:
        monkeypatch.setattr(
            "pipeline.speed.gather.draw_pareto",
            lambda points, path, *_: (path.parent.mkdir(exist_ok=True), path.write_bytes(b"plot")),
        )


def case(name: str, cost: float, ratio: float = 1.0, error: float | None = None, **columns: object) -> dict[str, Any]:
    return {"case": name, "cost": cost, "unit": "ms", "baseline": "x", "ratio": ratio, "error": error, **columns}


def answers(reports: Path) -> dict[str, Answer]:
    found, _ = gather(reports)
    return {answer.question.key: answer for answer in found}


def reasons(reports: Path) -> dict[str, str]:
    _, missing = gather(reports)
    return {m.question.key: m.reason for m in missing}


def row(ratio: float, error: float | None, setting: str = "s") -> SpeedRow:
    return SpeedRow(question="q", setting=setting, cost=ratio, unit="ms", ratio=ratio, error=error)


# --- The rule


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(0, 20)), min_size=1, max_size=12), st.integers(0, 5))
def test_the_cheapest_that_is_good_enough_is_recommended(points: list[tuple[int, int]], margin: int) -> None:
    rows = [row(cost, error / 100, str(i)) for i, (cost, error) in enumerate(points)]
    lowest = min(error for _, error in points)
    good = sorted((cost, error, i) for i, (cost, error) in enumerate(points) if error - lowest <= margin)
    assert recommended([*rows, row(0.1, None)], margin / 100).setting == str(good[0][2])


def test_without_errors_the_cheapest_is_recommended() -> None:
    assert recommended([row(2, None, "a"), row(1, None, "b"), row(3, None, "c")], 0.02).setting == "b"
    with pytest.raises(ValueError, match="empty"):
        recommended([], 0.02)


def test_a_margin_met_exactly_is_met() -> None:
    assert recommended([row(1, 0.3 + 0.02, "cheap"), row(2, 0.3, "best")], 0.02).setting == "cheap"
    assert recommended([row(1, 0.3201, "cheap"), row(2, 0.3, "best")], 0.02).setting == "best"


# --- The table in Git


@pytest.fixture(scope="module")
def table() -> list[Cells]:
    text = (ROOT / "reports" / "speed_error.csv").read_text()
    assert text.splitlines()[0] == COLUMNS
    return list(csv.DictReader(text.splitlines()))


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Sources of the table in Git, without pictures."""
    skip = shutil.ignore_patterns("*.png", "index.html", "speed_error*")
    shutil.copytree(ROOT / "reports", tmp_path / "reports", ignore=skip)
    return tmp_path


def test_the_table_in_git_is_that_of_the_reports_in_git(copied: Path) -> None:
    write_speed_error(copied)
    for name in ("speed_error.csv", "speed_error.md"):
        own = (ROOT / "reports" / name).read_text()
        assert (copied / "reports" / name).read_text() == own, "reports/ changed: run `octopi page`"


def of(table: Iterable[Cells], question: str) -> list[Cells]:
    return [cells for cells in table if cells["question"] == question]


def same(cells: Cells, expected: Mapping[str, float | str | None]) -> None:
    for name, value in expected.items():
        if isinstance(value, str):
            assert cells[name] == value, (cells, name)
        elif value is None:
            assert cells[name] == "", (cells, name)
        else:
            assert float(cells[name]) == pytest.approx(value, rel=6e-4, abs=6e-5), (cells, name, value)


BENCHES = [
    ("frames", "selection", "{}", "uniform, 5 frames", "error"),
    ("encoder frames", "encoder", "frames a video, {}", "strong, default", "error"),
    ("frame size", "encoder", "side of a frame, {}", "strong, default", "error"),
    ("prompts", "encoder", "prompts, {}", "prompts, 8 at all layers", "error"),
    ("number format, strong encoder", "encoder", "number format, {}", "strong, default", "error"),
    ("number format, CLIP", "encoder", "CLIP's number format, {}", "CLIP's number format, float32", "error"),
    ("contact tier", "scenes", "{}", "winkler", "image"),
    ("contact tier, for a classifier", "scenes", "labels, {}", "labels, layer, every pixel", "error"),
]


@pytest.mark.parametrize(("question", "section", "name", "baseline", "error"), BENCHES, ids=lambda x: str(x)[:24])
def test_rows_of_a_bench_are_its_cases(
    table: list[Cells], question: str, section: str, name: str, baseline: str, error: str
) -> None:
    """Looked up by the case's whole name, ratios taken from costs where the section's are to another case."""
    cases = {c["case"]: c for c in json.loads((ROOT / "reports" / "bench" / f"{section}.json").read_text())}
    base = cases[baseline]
    rows = of(table, question)
    assert len(rows) > 1
    for cells in rows:
        found = cases.get(name.format(cells["setting"]), base)
        assert found is not base or float(cells["ratio"]) == 1
        megabytes = found.get("megabytes")
        same(
            cells,
            {
                "cost": found["cost"],
                "unit": found["unit"],
                "ratio": found["ratio"] / base["ratio"],
                "frames": found.get("frames"),
                "flops": found.get("flops"),
                "bytes": None if megabytes is None else 1e6 * megabytes,
                "error": found[error],
                "low": found["low"] if error == "error" else found.get("image_low"),
                "high": found["high"] if error == "error" else found.get("image_high"),
            },
        )


def test_encoders_have_the_errors_of_the_fullest_cross_validation(table: list[Cells]) -> None:
    cases = {c["case"]: c for c in json.loads((ROOT / "reports" / "bench" / "encoder.json").read_text())}
    files = [*(ROOT / "reports").glob("*/encoder/cross_validation.csv")]
    tables = [[x for x in csv.DictReader(f.open()) if x["property"] == "combined"] for f in files]

    def fullness(lines: list[dict[str, str]]) -> tuple[int, int]:
        return sum(f"model, {x['model']}" in cases for x in lines), max(int(x["n"]) for x in lines)

    largest = {x["model"]: x for x in max(tables, key=fullness)}
    rows = of(table, "encoder")
    assert {cells["setting"] for cells in rows} == {c.removeprefix("model, ") for c in cases if c.startswith("model, ")}
    for cells in rows:
        judged = largest.get(cells["setting"])
        shares = {"error": "accuracy", "low": "high", "high": "low"}
        errors = {name: 1 - float(judged[share]) if judged else None for name, share in shares.items()}
        found = cases[f"model, {cells['setting']}"]
        same(cells, {"cost": found["cost"], "ratio": found["ratio"], "frames": found["frames"], **errors})


def test_more_models_count_for_more_than_more_videos_and_those_for_more_than_names(reports: Path) -> None:
    write_json(reports / "bench" / "encoder.json", [case(f"model, {m}", 9) for m in ("strong", "trees", "probe")])

    def compared(report: str, videos: int, **accuracies: float) -> None:
        (reports / report / "encoder").mkdir(parents=True)
        rows = [f"{model},combined,{value},,,{videos}" for model, value in accuracies.items()]
        text = "\n".join(["model,property,accuracy,low,high,n", *rows])
        (reports / report / "encoder" / "cross_validation.csv").write_text(text)

    def errors() -> dict[str, float | None]:
        return {found.setting: found.error for found in answers(reports)["encoder"].rows}

    compared("a", 900, constant=0.1, other=0.2, trees=0.5)
    assert errors() == {"strong": None, "trees": 0.5, "probe": None}
    compared("b", 300, strong=0.6, trees=0.4)
    assert errors() == {"strong": 0.4, "trees": 0.6, "probe": None}, "two of the benchmark's models, not one of three"
    compared("c", 400, strong=0.7, probe=0.3)
    assert errors() == {"strong": 0.3, "trees": None, "probe": 0.7}, "as many models and more videos"
    compared("d", 400, strong=0.9, probe=0.9)
    assert errors()["strong"] == 0.3, "of equals the first by name"


def test_every_question_has_one_recommendation_and_its_baseline(table: list[Cells]) -> None:
    keys = list(dict.fromkeys(cells["question"] for cells in table))
    assert keys == [question.key for question in QUESTIONS if question.key in keys]
    assert {"frames", "encoder", "OPD", "contact tier", "number format, strong encoder"} <= set(keys)
    for question in QUESTIONS:
        rows = of(table, question.key)
        if not rows:
            continue
        (chosen,) = [cells for cells in rows if cells["recommended"] == "True"]
        assert {cells["recommended"] for cells in rows} == {"True", "False"}
        assert [float(c["ratio"]) for c in rows if c["setting"] == question.source.baseline] == [1.0]
        errors = [float(cells["error"]) for cells in rows if cells["error"]]
        assert errors or question.key in WITHOUT_ERROR
        lowest = min(errors, default=0.0)
        for cells in rows:
            if cells["error"] and float(cells["ratio"]) < float(chosen["ratio"]):
                assert float(cells["error"]) > lowest + question.margin
            assert not cells["low"] or float(cells["low"]) <= float(cells["error"]) <= float(cells["high"])
    margins = {question.key: question.margin for question in QUESTIONS}
    assert margins.pop("contact tier") == NOISE
    assert set(margins.values()) == {POINTS}


def test_plots_in_git_are_those_of_the_table(table: list[Cells]) -> None:
    judged = {cells["question"] for cells in table if cells["error"]}
    drawn = {path.relative_to(ROOT / "reports").as_posix() for path in (ROOT / "reports/speed_error").iterdir()}
    assert drawn == {picture_of(key) for key in judged}
    text = (ROOT / "reports" / "speed_error.md").read_text()
    assert all(f"]({picture})" in text for picture in drawn)


# --- Sources that may come


@pytest.fixture
def reports(tmp_path: Path) -> Path:
    (tmp_path / "reports" / "bench").mkdir(parents=True)
    return tmp_path / "reports"


LANGUAGE = [
    case("training, published way", 50.0, samples=64, tokens=6400, flops=64e9),
    case("training, and of like length", 200.0, 4.0, samples=64, tokens=6400, flops=32e9, megabytes=600.5),
    case("training, the pipeline's Trainer", 160.0, 3.2, samples=256, tokens=25600, flops=128e9),
    case("answering, published way", 2.0, 1.0, 0.0, samples=64, tokens=640, low=1.9, high=2.1, error_low=0.0),
    case(
        *("answering, the pipeline's way, 32 at a time", 10.0, 5.0, 0.0156),
        samples=64,
        tokens=640,
        low=9.0,
        high=11.0,
        error_low=0.002,
        error_high=0.09,
    ),
    case("answering, the pipeline's way, 8 at a time", 8.0, 4.0, 0.05, samples=64, tokens=640),
    case("answering, weights in float32, 16 at a time", 9.0, 1.0, 0.0, samples=64),
    case("answering, weights in bfloat16, 16 at a time", 3.0, 0.3333, 0.25, samples=64),
    case("paper-7b on H100 SXM, answering, 16 at a time", 3.0, 9.0, samples=64),
]


def test_rates_become_costs_and_counts_are_for_one_sample(reports: Path) -> None:
    write_json(reports / "bench" / "language.json", LANGUAGE)
    found = answers(reports)
    assert [*found] == ["number format, language model", "language model, answering", "language model, training"]
    asked = {r.setting: r for r in found["language model, answering"].rows}
    assert [*asked] == ["published way", "the pipeline's way, 32 at a time", "the pipeline's way, 8 at a time"]
    fast = asked["the pipeline's way, 32 at a time"]
    assert (fast.cost, fast.unit, fast.ratio, fast.tokens) == (100.0, "ms an answer", 0.2, 10.0)
    assert (fast.error, fast.low, fast.high) == (0.0156, 0.002, 0.09)
    assert found["language model, answering"].chosen == fast
    assert asked["published way"].high is None, "the range of rates is no interval of the error"
    trained = {r.setting: r for r in found["language model, training"].rows}
    like = trained["and of like length"]
    assert (like.cost, like.ratio, like.flops, like.bytes) == (5.0, 0.25, 5e8, 600_500_000)
    assert trained["the pipeline's Trainer"].flops == 5e8
    assert {(r.error, r.low, r.high) for r in trained.values()} == {(None, None, None)}
    assert found["language model, training"].chosen == like
    formats = found["number format, language model"]
    assert (formats.chosen.setting, [r.ratio for r in formats.rows]) == ("float32", [1.0, 3.0])


def test_without_an_error_nothing_is_drawn_and_the_table_stands(reports: Path) -> None:
    write_json(reports / "bench" / "language.json", LANGUAGE)
    write_speed_error(reports.parent)
    assert sorted(p.name for p in (reports / "speed_error").iterdir()) == [
        "language-model-answering.png",
        "number-format-language-model.png",
    ]
    text = (reports / "speed_error.md").read_text()
    assert "**Recommended: and of like length** (0.25 times the cost of `published way`), the cheapest." in text


def test_the_benches_names_are_those_that_are_read() -> None:
    from pipeline.benchmarks import encoder, encoder_training, language, language_formats
    from pipeline.benchmarks.language_ways import WAYS

    sources = {question.key: question.source for question in QUESTIONS}
    assert sources["frames"].baseline in [s.case for s in selection.settings()]
    assert sources["contact tier"].baseline in scenes.ways()
    assert sources["contact tier, for a classifier"].baseline in scenes.ways()
    cases = [s.case for s in encoder.settings()]
    names = [c["case"] for c in json.loads((ROOT / "reports/bench/encoder.json").read_text())]
    assert set(cases) <= set(names), "encoder.json stands for the section in the other tests"
    assert f"prompts, {sources['prompts'].baseline}" == encoder_training.USUAL
    asked = [language.ASKED_PUBLISHED, language.LEAN, *map(language.batched, language.BATCHES)]
    trained = [f"training, {way.case}" for way in WAYS] + [language.TRAINER]
    for key, names, count in (
        ("language model, answering", asked, 5),
        ("language model, training", trained, len(WAYS) + 1),
        ("number format, language model", [language_formats.case_of(f) for f in language_formats.FORMATS], 2),
    ):
        pattern = sources[key].pattern  # type: ignore[attr-defined]
        settings = [m[1] for name in asked + trained + names if (m := re.fullmatch(pattern, name))]
        assert len(set(settings)) == count
        assert sources[key].baseline in settings


def test_what_was_not_measured_is_named_with_its_command(reports: Path) -> None:
    found = reasons(reports)
    assert [*found] == [question.key for question in QUESTIONS]
    assert found["frames"].endswith("`make bench SECTION=selection` measures it")
    assert found["contact tier"].endswith("`make bench SECTION=scenes` measures it")
    assert "make bench SECTION=encoder" in found["encoder"]
    assert "ablation.plan=factorial" in found["OPD"]
    write_json(reports / "bench" / "encoder.json", [case("model, strong", 9), case("model, trees", 20, 2)])
    found = reasons(reports)
    assert "cross_validation.models" in found["encoder"]
    assert "does not have `default`" in found["frame size"]
    write_speed_error(reports.parent)
    assert (reports / "speed_error.csv").read_text() == f"{COLUMNS}\n"
    assert (
        "- **Which frames, and how many?** There is no `reports/bench/selection.json`"
        in (reports / "speed_error.md").read_text()
    )


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"case": 1}', "selection.json: not a list of rows"),
        ('[{"case": "a", "unit": "ms", "ratio": 1}]', "selection.json, row 1: cost: Field required"),
        ('[{"case": "a", "unit": "ms", "ratio": 1, "cost": NaN}]', "row 1: cost: Input should be a finite number"),
        ("[", "selection.json: not JSON"),
    ],
)
def test_a_broken_file_is_named(content: str, said: str, reports: Path) -> None:
    (reports / "bench" / "selection.json").write_text(content)
    with pytest.raises(UserError, match=said):
        write_speed_error(reports.parent)


def test_without_reports_one_line_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="make repro"):
        write_speed_error(tmp_path)


# --- Describing


def ablation(reports: Path, name: str, lines: Iterable[tuple[str, int, str, float, float, str]], n: int = 20) -> None:
    """Rows of OPD, seed, task, accuracy, tokens and gate, of the full system and, all wrong, of a lesser one."""
    folder = reports / name / "language"
    folder.mkdir(parents=True)
    text = "source,encoder,lora,opd,seed,task,accuracy,low,high,n,chance,unparsed,truncated,tokens,gate\n"
    for opd, seed, task, accuracy, tokens, gate in lines:
        ends = f"{accuracy - 0.1:.4f},{accuracy + 0.2:.4f},{n},0.3,0.0,0.0,{tokens},{gate}"
        text += f"videos,finetuned,with,{opd},{seed},{task},{accuracy},{ends}\n"
        text += f"videos,base,with,{opd},{seed},{task},0.0,0.0,0.1,{n},0.3,0.0,0.0,{tokens},{gate}\n"
    (folder / "ablation.csv").write_text(text)


def test_describing_is_the_mean_over_seeds_and_tasks(reports: Path) -> None:
    lines = [
        *(("all", s, "PC", a, t, "passed") for s, a, t in ((0, 0.5, 80), (1, 0.7, 100))),
        *(("all", s, "PSS", a, 40, "") for s, a in ((0, 0.4), (1, 0.2))),
        *(("none", s, "PC", 0.5, 8, "passed") for s in (0, 1)),
        *(("none", s, "PSS", 0.3, 6, "") for s in (0, 1)),
        *(("needed", s, "PC", 0.6, 30, "passed") for s in (0, 1)),
        *(("needed", s, "PSS", 0.3, 20, "") for s in (0, 1)),
        ("all", 0, "POM", 0.9, 500, "not passed, facts told"),
        ("none", 0, "POM", 0.1, 5, "not passed, facts told"),
        ("needed", 0, "POM", 0.1, 5, "not passed, facts told"),
        ("all", 0, "PSR", 0.9, 500, ""),  # not under `none`
        ("all", 0, "OPD", 0.0, 500, ""),
    ]
    ablation(reports, "small-videos", lines)
    # More answers, but fewer kinds of describing.
    two = [(opd, 0, "PC", 0.9, 9, "") for opd in ("all", "none")]
    ablation(reports, "large-videos", two, n=10_000)
    found = answers(reports)["OPD"]
    assert [r.setting for r in found.rows] == ["none", "needed", "all"]
    none, needed, everything = found.rows
    assert (everything.tokens, everything.ratio) == (65, 1)
    assert (none.tokens, none.ratio) == (7, round(7 / 65, 4))
    assert everything.error == pytest.approx(1 - fmean([fmean([0.5, 0.7]), fmean([0.4, 0.2])]))
    assert (everything.low, everything.high) == (pytest.approx(0.55 - 0.2), pytest.approx(0.55 + 0.1))
    assert needed.error == pytest.approx(0.55)
    assert none.error == pytest.approx(0.6)
    assert found.chosen == needed, "as good as all, and cheaper; none is five points worse"
    assert "small-videos/language/ablation.csv`, mean over PC, PSS; the base" in found.origin
    assert found.origin.endswith("Guessing evenly is wrong in 0.700.")


def test_of_as_many_kinds_of_describing_the_most_answers_count(reports: Path) -> None:
    ablation(reports, "a", [(opd, 0, "PC", 0.9, 9, "not passed") for opd in ("all", "none")], n=10)
    ablation(reports, "b", [(opd, 0, "PC", 0.5, 9, "not passed") for opd in ("all", "none")], n=11)
    found = answers(reports)["OPD"]
    assert {r.error for r in found.rows} == {0.5}, "where the gate passes nothing, all tasks count"
    assert "`reports/b/" in found.origin


def test_what_is_no_better_than_guessing_says_so(reports: Path) -> None:
    ablation(reports, "a", [(opd, 0, "PC", 0.3, 9, "") for opd in ("all", "none")])
    assert answers(reports)["OPD"].origin.endswith(
        "is wrong in 0.700, and no setting is better: what is recommended is cheap, and that is all."
    )


def test_a_task_without_an_interval_leaves_the_mean_without(reports: Path) -> None:
    lines = [(opd, 0, task, 0.5, 9.0, "") for opd in ("all", "none") for task in ("PC", "PSS")]
    ablation(reports, "a", lines)
    file = reports / "a" / "language" / "ablation.csv"
    text = file.read_text().replace("all,0,PSS,0.5,0.4000,0.7000", "all,0,PSS,0.5,,")
    file.write_text(text)
    none, everything = answers(reports)["OPD"].rows
    assert (none.low, none.high) == (pytest.approx(0.3), pytest.approx(0.6))
    assert (everything.error, everything.low, everything.high) == (0.5, None, None)


def test_one_kind_of_describing_is_no_comparison(reports: Path) -> None:
    ablation(reports, "a", [("all", seed, "PC", 0.9, 9, "") for seed in (0, 1)])
    assert "two kinds of OPD" in reasons(reports)["OPD"]


# --- Writing


@pytest.mark.drawn
def test_writing_twice_gives_equal_bytes_and_stale_plots_go(reports: Path) -> None:
    write_json(reports / "bench" / "language.json", LANGUAGE)
    write_speed_error(reports.parent)
    files = {path: path.read_bytes() for path in reports.rglob("*") if path.is_file()}
    assert sum(path.suffix == ".png" for path in files) == 2
    (reports / "speed_error" / "gone.png").write_bytes(b"of a question that is gone")
    write_speed_error(reports.parent)
    assert {path: path.read_bytes() for path in reports.rglob("*") if path.is_file()} == files
