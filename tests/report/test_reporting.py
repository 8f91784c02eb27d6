"""The report: measured cells come from scores alone, empty ones say why, equal input gives equal bytes."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.io import read_csv, read_table
from pipeline.params import Params
from pipeline.errors import UserError
from pipeline.videos.catalogue import load_catalogue
from pipeline.plan import Encoder, Lora
from pipeline.records import Assignment, Finding, Opd, Part, Score, Severity, Task
from pipeline.reporting import write_report
from pipeline.reporting.audit import MOST_ALIKE, audit_table
from pipeline.reporting.encoder_report import write_encoder_report
from pipeline.reporting.figures import project
from pipeline.reporting.inputs import read_inputs, why_empty
from pipeline.reporting.provenance import provenance
from pipeline.reporting.published import find, published
from pipeline.reporting.stability import stability_table
from pipeline.stability.record import Judgement, StabilityRow
from pipeline.statistics import Outcome, resampled
from tests.closure import ROOT
from tests.fake_chain import HARD_CASES, fake_params, write_chain

TABLES = {
    "all_variants",
    "annotator_agreement",
    "audit",
    "confusion_matrices",
    "encoder_property",
    "encoder_understanding",
    "lora_property",
    "lora_understanding",
    "property_combinations",
    "property_counts",
    "property_description",
    "scenario_reasoning",
    "stability",
    "understanding",
    "video_lengths",
}
TRAINING_OBJECTS = ("baseball", "cotton_ball", "pillow", "potato", "rug")


def report(root: Path, params: Params) -> Path:
    write_report(params, root)
    write_encoder_report(params, root)
    return root / "reports" / params.report_name


def rows(folder: Path, table: str) -> list[dict[str, str]]:
    with (folder / "tables" / f"{table}.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def params() -> Params:
    return fake_params()


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory, params: Params) -> Path:
    """A finished chain with its report; tests that change it copy it."""
    root = tmp_path_factory.mktemp("chain")
    write_chain(root, params)
    report(root, params)
    return root


@pytest.fixture
def copy(chain: Path, tmp_path: Path) -> Path:
    shutil.copytree(chain, tmp_path / "copy")
    return tmp_path / "copy"


def test_every_table_and_figure_is_there(chain: Path, params: Params) -> None:
    folder = chain / "reports" / params.report_name
    written = set(files(folder))
    strips = {f for f in written if f.startswith("samples/") and f.endswith(".png")}
    assert strips
    assert written - strips == {
        *(f"tables/{name}.{ending}" for name in TABLES for ending in ("csv", "md")),
        *(
            f"language/{name}.{ending}"
            for name in ("ablation", "directions", "effects", "reasoning", "seeds", "touch")
            for ending in ("csv", "md")
        ),
        *(f"figures/{name}.png" for name in ("confusion_matrices", "effects", "embedding_map", "training_curves")),
        *("README.md", "metrics.json", "params.yaml", "provenance.json", "samples/samples.json"),
        *(f"encoder/{file}" for file in ("README.md", "params.yaml", "provenance.json")),
        *(
            f"encoder/{name}.{ending}"
            for name in ("agreement", "cross_validation", "differences", "errors")
            for ending in ("csv", "md")
        ),
    }
    page = (folder / "README.md").read_text()
    linked = re.findall(r"\]\(([^)#]+)\)", page)
    assert linked
    assert set(linked) <= written
    assert "prove nothing but that the chain runs" in page
    assert "Test objects without videos: clothes_peg, hairbrush_handle, microfiber_cloth." in page
    headings = {re.sub(r"[:'?,]", "", h.lower().replace(" ", "-")) for h in re.findall(r"^## (.+)$", page, re.M)}
    assert set(re.findall(r"\]\(#([^)]+)\)", page)) <= headings


def test_markdown_tables_are_rectangular(chain: Path, params: Params) -> None:
    for file in (chain / "reports" / params.report_name / "tables").glob("*.md"):
        lines = [line for line in file.read_text().splitlines() if line.startswith("|")]
        assert len({line.count(" | ") for line in lines}) == 1, file.name


def test_measured_cells_are_what_the_scores_say(chain: Path, params: Params) -> None:
    folder = chain / "reports" / params.report_name
    scores = read_table(chain / "data" / "scores" / "finetuned-with-all-0" / "scores.parquet", Score)
    metrics = json.loads((folder / "metrics.json").read_text())
    for task in (Task.PC, Task.PSS, Task.POM):
        graded = [s for s in scores if s.task == task]
        row = next(r for r in rows(folder, "understanding") if (r["row"], r["system"]) == (task, "Octopi"))
        right = sum(s.correct for s in graded)
        assert (float(row["k"]), int(row["n"])) == (right, len(graded))
        assert float(row["value"]) == pytest.approx(100 * right / len(graded), abs=1e-3)
        assert metrics[f"finetuned-with-all.{task}"] == pytest.approx(right / len(graded), abs=1e-6)
        assert float(row["unparsed"]) == pytest.approx(100 - float(row["value"]), abs=1e-3)
        assert float(row["low"]) <= float(row["value"]) <= float(row["high"])
        again = resampled([Outcome(s.correct, s.objects) for s in graded])
        assert again is not None
        assert float(row["resampled_low"]) == pytest.approx(100 * again.low, abs=1e-4)
        assert float(row["resampled_high"]) == pytest.approx(100 * again.high, abs=1e-4)
        assert row["note"] == (
            "the question says what the named objects are like (questions.facts)" if task is Task.POM else ""
        )


def test_majority_is_learnt_from_training_objects(chain: Path, params: Params) -> None:
    catalogue = load_catalogue(Path(params.data.catalogue))
    assignments = read_table(chain / "data" / "splits.parquet", Assignment)
    trained = sorted({a.object_id for a in assignments if a.part == Part.TRAIN})
    levels = [catalogue.labels(o)[0] for o in trained]
    mode = max(range(3), key=lambda level: (levels.count(level), -level))
    tested = [catalogue.labels(a.object_id)[0] for a in assignments if a.part == Part.TEST]
    table = rows(chain / "reports" / params.report_name, "property_description")
    row = next(r for r in table if (r["row"], r["system"]) == ("hardness", "Majority class"))
    assert (float(row["k"]), int(row["n"])) == (tested.count(mode), len(tested))


def test_no_scores_leave_cells_empty_with_a_note(copy: Path, params: Params) -> None:
    shutil.rmtree(copy / "data" / "scores" / "finetuned-with-none-0")
    shutil.rmtree(copy / "data" / "encoder")
    folder = report(copy, params)
    for row in rows(folder, "understanding"):
        empty = row["system"] == "Octopi (no OPD)"
        assert (row["note"] == "not graded yet: finetuned-with-none-0") == empty
        assert all((row[c] == "") == empty for c in ("value", "k", "n", "low", "resampled_low", "unparsed", "seeds"))
        assert row["published_7b"] != ""
    heads = [r for r in rows(folder, "property_description") if r["system"] == "FT CLIP"]
    assert all(r["value"] == "" and r["note"].startswith("no classifications") for r in heads)
    assert not (folder / "figures" / "confusion_matrices.png").exists()
    assert not any(
        key.startswith(("finetuned-with-none", "ft-clip")) for key in json.loads((folder / "metrics.json").read_text())
    )


def test_without_test_videos_every_accuracy_is_empty(copy: Path, params: Params, tmp_path: Path) -> None:
    root = tmp_path / "training only"
    write_chain(root, params, objects=TRAINING_OBJECTS)
    shutil.copytree(copy / "reports", root / "reports")
    folder = report(root, params)
    for name in TABLES:
        for row in rows(folder, name):
            if "chance" in row:
                assert (row["value"], row["n"]) == ("", "")
                assert row["note"].startswith(("no video of any test object: bath_towel, clothes_peg", "OPD questions"))
    assert [f.name for f in (folder / "figures").iterdir()] == ["training_curves.png"]
    assert "Not drawn: no video of any test object" in (folder / "README.md").read_text()
    assert json.loads((folder / "metrics.json").read_text()) == {}


def test_reasons_for_empty_cells(chain: Path, params: Params) -> None:
    inputs = read_inputs(params, chain)
    assert why_empty(inputs, (Encoder.BASE, Lora.WITHOUT, Opd.ALL), Task.PC) == "variant not in the plan `paper`"
    silent = (Encoder.FINETUNED, Lora.WITH, Opd.NONE)
    assert why_empty(inputs, silent, Task.OPD) == "OPD questions are not put to a system that never describes"
    assert "allow no PC question" in why_empty(inputs, silent, Task.PC)
    (chain / "nothing").mkdir(exist_ok=True)
    with pytest.raises(UserError, match=r"videos\.parquet: no such file"):
        read_inputs(params, chain / "nothing")


def test_the_audit_stands_on_the_page_grouped_and_whole_in_the_csv(chain: Path, params: Params) -> None:
    folder = chain / "reports" / params.report_name
    findings = read_csv(chain / "data" / "audit" / "audit.csv", Finding)
    columns = ("check", "item", "measured", "expected", "severity")
    assert [tuple(row) for row in rows(folder, "audit")] == [columns] * len(findings)
    assert [Finding.model_validate(row) for row in rows(folder, "audit")] == findings
    section = (folder / "README.md").read_text().split("\n## Data audit\n")[1].split("\n## ")[0]
    assert f"0 errors (they stop the chain), {len(findings) - 1} warnings, 1 other findings" in section
    shown = [line for line in section.splitlines() if line.startswith("| warning")]
    assert len(shown) == 2
    contact = [f for f in findings if f.check == "contact"]
    assert len(contact) > MOST_ALIKE
    assert f"| {len(contact)} items: {', '.join(f.item for f in contact[:MOST_ALIKE])}, ... |" in shown[0]
    assert "the first: not found: strength 0.10" in shown[0]
    assert "soft \\| low" in shown[1]
    assert "same content" not in section


def finding(check: str, item: str, severity: Severity = Severity.WARNING) -> Finding:
    return Finding(check=check, item=item, measured=f"measured {item}", severity=severity)


@pytest.mark.parametrize(("count", "shown"), [(1, 1), (MOST_ALIKE, MOST_ALIKE), (MOST_ALIKE + 1, 1)])
def test_only_many_findings_of_one_check_are_grouped(count: int, shown: int) -> None:
    table = audit_table([finding("contact", f"rug_{i}.avi") for i in range(count)])
    assert len(table.rows) == count
    assert table.markdown().count("\n| warning") == shown


def test_errors_come_first_and_are_never_grouped_with_warnings() -> None:
    many = [finding("same content", f"rug_{i}.avi") for i in range(MOST_ALIKE)]
    table = audit_table([*many, finding("same content", "potato_0.avi", Severity.ERROR)])
    lines = table.markdown().splitlines()[2:]
    assert len(lines) == MOST_ALIKE + 1
    assert lines[0].startswith("| error")
    assert "1 errors (they stop the chain), 12 warnings, 0 other findings" in table.caption


def test_an_audit_without_warnings_says_so() -> None:
    table = audit_table([finding("contact", "all", Severity.INFO)])
    assert table.markdown() == "Nothing.\n"
    assert table.csv().splitlines() == ["check,item,measured,expected,severity", "contact,all,measured all,,info"]


def test_hard_cases_stand_on_the_page_by_part_and_format_and_whole_in_the_csv(chain: Path, params: Params) -> None:
    folder = report(chain, params)
    written = rows(folder, "stability")
    assert [StabilityRow.model_validate(row) for row in written] == HARD_CASES
    section = (folder / "README.md").read_text().split("\n## Numerical stability\n")[1].split("\n## ")[0]
    assert "4 rows, 0 of them failed" in section
    assert "no rows in float16" in section
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if line.startswith("|")]
    assert lines[0] == ["Part", "Format", "Cases", "Failed", "Nearest to its bound", "Error", "Bound"]
    assert lines[2:] == [
        ["projection", "float64", "1", "0", "", "", ""],
        ["projection", "bfloat16", "2", "0", "all zero", "3.1e-03", "1.0e-02"],
        ["frames", "uint8", "1", "0", "black", "0", "0"],
    ]


def test_a_failed_hard_case_is_counted_and_outweighs_all_that_have_bounds() -> None:
    red = HARD_CASES[3].model_copy(update={"error": 1e-9, "verdict": Judgement.FAILED, "dtype": "float16"})
    table = stability_table([red, red.model_copy(update={"case": "near", "bound": 2e-9, "error": 1.9e-9})])
    assert "2 rows, 2 of them failed" in table.caption
    assert "float16 ran on a CUDA device" in table.caption
    assert "| frames | float16 | 2 | 2 | black | 1.0e-09 | 0 |" in table.markdown()


def test_a_chain_that_was_not_audited_has_no_audit_section(copy: Path, params: Params) -> None:
    (copy / "data" / "audit" / "audit.csv").unlink()
    folder = report(copy, params)
    assert "Data audit" not in (folder / "README.md").read_text()
    (copy / "data" / "audit" / "audit.csv").write_text("check,item\na,b\n")
    with pytest.raises(UserError, match=r"audit\.csv: not a table of Finding"):
        report(copy, params)


def test_several_seeds_are_pooled_by_question(tmp_path: Path, params: Params) -> None:
    several = fake_params("ablation.seeds=[0,3]", "ablation.plan=factorial")
    write_chain(tmp_path, several)
    folder = report(tmp_path, several)
    graded = {
        seed: [
            s.correct
            for s in read_table(tmp_path / "data" / "scores" / f"finetuned-with-all-{seed}" / "scores.parquet", Score)
            if s.task == Task.PC
        ]
        for seed in (0, 3)
    }
    row = next(r for r in rows(folder, "understanding") if (r["row"], r["system"]) == ("PC", "Octopi"))
    shares = [100 * sum(values) / len(values) for values in graded.values()]
    assert int(row["n"]) == len(graded[0])
    assert float(row["value"]) == pytest.approx(sum(shares) / 2, abs=1e-3)
    assert (row["seeds"], row["seed_values"]) == ("2", f"0: {shares[0]:.2f}, 3: {shares[1]:.2f}")
    assert float(row["seed_sd"]) == pytest.approx(float(np.std(shares, ddof=1)), abs=1e-3)
    assert len(rows(folder, "all_variants")) == 12 * 8


def test_equal_input_gives_equal_bytes(copy: Path, chain: Path, params: Params) -> None:
    shutil.rmtree(copy / "reports")
    code = (
        "import sys; from pathlib import Path; from pipeline.params import load_params;"
        "from pipeline.reporting import write_report;"
        "from pipeline.reporting.encoder_report import write_encoder_report;"
        "root = Path(sys.argv[1]); params = load_params(root / 'params.yaml');"
        "write_report(params, root); write_encoder_report(params, root)"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", code, str(copy)], check=True, cwd=ROOT, env=environment)
    first, second = (files(root / "reports" / params.report_name) for root in (chain, copy))
    assert first == second


def test_importing_is_quick() -> None:
    heavy = {"torch", "pandas", "matplotlib", "sklearn", "scipy", "mlflow", "pyarrow", "numpy"}
    code = f"import sys, pipeline.reporting; print(sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("count", "methods"), [(2, ["PCA"]), (4, ["PCA"]), (5, ["PCA", "t-SNE"]), (40, ["PCA", "t-SNE"])]
)
def test_videos_are_projected(count: int, methods: list[str]) -> None:
    features = np.random.default_rng(0).normal(size=(count, 8))
    maps = project(features)
    assert list(maps) == methods
    for places in maps.values():
        assert places.shape == (count, 2)
        assert np.isfinite(places).all()
    centred = features - features.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    wanted = np.abs(centred @ axes[: min(2, count - 1)].T)
    np.testing.assert_allclose(np.abs(maps["PCA"][:, : wanted.shape[1]]), wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("cell", "value", "n"),
    [
        (("understanding", "PC", "octopi", "7b"), 48.10, 158),
        (("understanding", "PSS", "no_opd", "13b"), 39.88, 163),
        (("understanding", "POM", "random"), 16.67, None),
        (("scenario_reasoning", "PSR", "no_opd", "13b"), 39.13, 46),
        (("property_description", "combined", "ft_clip"), 57.89, 38),
        (("encoder_property", "hardness", "base_clip", "7b"), 81.58, 38),
        (("encoder_understanding", "PSR", "base_clip", "13b"), 45.65, 46),
        (("lora_property", "hardness", "without_lora", "13b"), 36.84, 38),
        (("lora_understanding", "POM", "without_lora", "7b"), 12.30, 187),
        (("property_counts", "moderately hard", "percent"), 18.92, 74),
        (("property_combinations", "hard, smooth, no bumps", "count"), 17, 74),
        (("video_lengths", "maximum", "frames"), 126, 408),
        (("annotator_agreement", "bumpiness", "icc3k"), 0.792, 74),
    ],
)
def test_published_cells(cell: tuple[str, ...], value: float, n: int | None) -> None:
    found = find(*cell)
    assert found is not None
    assert (found.value, found.n) == (value, n)


def test_published_accuracies_are_whole_numbers_of_answers() -> None:
    accuracies = [p for p in published() if p.n and p.system not in ("count", "percent", "frames", "icc3k")]
    assert len(accuracies) == 92
    for cell in accuracies:
        assert cell.n is not None
        right = round(cell.value * cell.n / 100)
        assert 100 * right / cell.n == pytest.approx(cell.value, abs=0.0051), cell
        interval = cell.wilson
        assert interval is not None
        assert interval.low < cell.value < interval.high


def test_provenance_tells_weights_of_one_name_apart(tmp_path: Path, params: Params) -> None:
    (tmp_path / "params.yaml").write_text("scale: smoke\n")
    (tmp_path / "llm" / "part").mkdir(parents=True)
    (tmp_path / "llm" / "part" / "a.bin").write_bytes(b"one")

    def digests() -> dict[str, str]:
        return {w.folder: w.sha256 for w in provenance(params, [], ["llm", "absent"], tmp_path).weights}

    line = f"part/a.bin {hashlib.sha256(b'one').hexdigest()}\n"
    assert digests() == {"llm": hashlib.sha256(line.encode()).hexdigest(), "absent": "unknown"}
    (tmp_path / "llm" / "part" / "a.bin").write_bytes(b"two")
    second = digests()["llm"]
    assert second != hashlib.sha256(line.encode()).hexdigest()
    (tmp_path / "llm" / ".cache").mkdir()
    (tmp_path / "llm" / ".cache" / "when").write_text("today")
    assert digests()["llm"] == second, "what a download leaves about itself are no weights"
    (tmp_path / "llm" / "part" / "a.bin").rename(tmp_path / "llm" / "b.bin")
    assert digests()["llm"] != second, "another name is another folder"


def test_provenance_names_the_code_not_the_report(tmp_path: Path, params: Params) -> None:
    (tmp_path / "params.yaml").write_text("a: 1\n")
    assert provenance(params, [], [], tmp_path).revision == "unknown"

    def git(*arguments: str) -> None:
        who = ["-c", "user.name=n", "-c", "user.email=e@e", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True)

    for folder in ("pipeline", "reports"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "file").write_text("1")
    git("init")
    git("add", "pipeline")
    git("commit", "-m", "code")
    committed = provenance(params, [], [], tmp_path)
    assert re.fullmatch("[0-9a-f]{40}", committed.revision)
    git("add", "reports")
    git("commit", "-m", "report")
    assert provenance(params, [], [], tmp_path) == committed
    assert committed.dirty is False
    (tmp_path / "pipeline" / "file").write_text("2")
    assert provenance(params, [], [], tmp_path).dirty is True


def test_the_params_beside_the_report_are_the_runs(chain: Path, params: Params) -> None:
    copied = (chain / "reports" / params.report_name / "params.yaml").read_text()
    assert Params.model_validate(yaml.safe_load(copied)) == params
