"""The tables about the language model: every seed, paired effects, counterfactuals, and the base model's gate."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from pathlib import Path
from statistics import fmean

import pytest

from pipeline.artifacts import read_table, write_table, write_text
from pipeline.config import Params
from pipeline.errors import UserError
from pipeline.records import Score, Task
from pipeline.reporting import write_report
from pipeline.reporting.answered import FAILED
from pipeline.statistics import Outcome, clustered
from tests.fake_chain import fake_params, write_chain

Rows = list[dict[str, str]]
GATE = """task,accuracy,low,high,n,goal,passed
PC,0.99,0.97,1.0,500,0.95,True
PC from slots,0.2,0.1,0.3,500,0.95,no
POM,0.3,0.25,0.35,500,0.7,False
"""


@pytest.fixture(scope="module")
def params() -> Params:
    return fake_params(
        "ablation.plan=factorial",
        "ablation.seeds=[0,3]",
        "ablation.counterfactuals=[removed,swapped]",
        "language.weights=base/llama",
    )


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, params: Params) -> Path:
    folder = tmp_path_factory.mktemp("language")
    write_chain(folder, params)
    write_text(folder / "base" / "gate.csv", GATE)
    write_report(params, folder)
    return folder


def rows(root: Path, params: Params, name: str) -> Rows:
    file = root / "reports" / params.report_name / "language" / f"{name}.csv"
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def graded(root: Path, key: str, task: Task, measure: str = "choice") -> dict[str, Score]:
    scores = read_table(root / "data" / "scores" / key / "scores.parquet", Score)
    return {s.question_id: s for s in scores if (s.task, s.measure) == (task, measure)}


def test_the_ablation_has_every_variant_seed_and_task_once(root: Path, params: Params) -> None:
    table = rows(root, params, "ablation")
    keys = [(r["encoder"], r["lora"], r["opd"], r["seed"], r["task"]) for r in table]
    assert len(set(keys)) == len(keys)
    assert {k[:4] for k in keys} == {
        (v.encoder, v.lora, v.opd, str(v.seed)) for v in params.plan.variants.values() if v.touch == "real"
    }
    assert {k[4] for k in keys if k[2] == "all"} == {
        *("PC", "PSS", "POM", "PSR", "OPD", "OPD hardness", "OPD roughness", "OPD bumpiness")
    }
    assert {k[4] for k in keys if k[2] == "none"} == {"PC", "PSS", "POM", "PSR"}, "without OPD nothing is described"
    assert {r["source"] for r in table} == {"scenes"}
    for row in table:
        task, _, measure = row["task"].partition(" ")
        measure = measure or ("combined" if task == "OPD" else "choice")
        key = "-".join(row[axis] for axis in ("encoder", "lora", "opd", "seed"))
        scores = graded(root, key, Task(task), measure).values()
        assert float(row["accuracy"]) == pytest.approx(fmean(s.correct for s in scores), abs=1e-4)
        assert int(row["n"]) == len(scores)
        assert float(row["unparsed"]) == pytest.approx(1 - fmean(s.parsed for s in scores), abs=1e-4)
        assert float(row["tokens"]) == 9
        interval = clustered([Outcome(s.correct, s.objects) for s in scores])
        assert interval is not None
        assert (float(row["low"]), float(row["high"])) == pytest.approx((interval.low, interval.high), abs=1e-4)


def test_effects_are_paired_by_question_and_pooled_over_seeds(root: Path, params: Params) -> None:
    table = rows(root, params, "effects")
    assert {r["others"] for r in table} == {"full system", "all"}
    effect = next(r for r in table if (r["axis"], r["others"], r["task"]) == ("LoRA", "full system", "PC"))
    gains = defaultdict(list)
    for seed in (0, 3):
        one, other = (graded(root, f"finetuned-{lora}-all-{seed}", Task.PC) for lora in ("with", "without"))
        for q in one:
            gains[q].append(one[q].correct - other[q].correct)
    assert float(effect["difference"]) == pytest.approx(fmean(map(fmean, gains.values())), abs=1e-4)
    assert int(effect["n"]) == len(gains)
    assert int(effect["pairs"]) == 2
    every = next(r for r in table if (r["axis"], r["others"], r["task"]) == ("LoRA", "all", "PC"))
    assert int(every["pairs"]) == 2 * 2 * 3, "seeds, encoders, ways of describing"
    none = [r for r in table if r["task"] == "OPD" and "none" in r["change"]]
    assert not none, "a system that never describes cannot be compared in describing"
    for row in table:
        assert float(row["low"]) <= float(row["difference"]) <= float(row["high"])
        assert float(row["p"]) <= float(row["p_holm"]) <= 1
        clear = float(row["low"]) > 0 or float(row["high"]) < 0
        assert clear or float(row["p"]) > 0.049


def test_describing_sets_needed_beside_all(root: Path, params: Params) -> None:
    table = {r["task"]: r for r in rows(root, params, "describing")}
    assert set(table) == {"PC", "PSS", "POM", "PSR", "OPD"}
    for task, row in table.items():
        errors = {}
        for mode in ("needed", "all"):
            measure = "combined" if task == "OPD" else "choice"
            keys = [f"finetuned-with-{mode}-{seed}" for seed in (0, 3)]
            scores = [s for key in keys for s in graded(root, key, Task(task), measure).values()]
            errors[mode] = 1 - fmean(s.correct for s in scores)
            assert float(row[f"error_{mode}"]) == pytest.approx(errors[mode], abs=1e-4)
        assert float(row["difference"]) == pytest.approx(errors["needed"] - errors["all"], abs=2e-4)


def test_touch_is_compared_with_the_same_variant_on_its_videos(root: Path, params: Params) -> None:
    table = rows(root, params, "touch")
    assert list(dict.fromkeys(r["touch"] for r in table)) == ["real", "removed", "swapped"]
    assert all(r["difference"] == r["unchanged"] == "" for r in table if r["touch"] == "real")
    row = next(r for r in table if (r["touch"], r["task"]) == ("swapped", "PSS"))
    same, gains = [], []
    for seed in (0, 3):
        real, swapped = (graded(root, f"finetuned-with-all-{seed}{touch}", Task.PSS) for touch in ("", "-swapped"))
        same += [real[q].predicted == swapped[q].predicted for q in real]
        gains += [real[q].correct - swapped[q].correct for q in real]
    assert float(row["unchanged"]) == pytest.approx(fmean(same), abs=1e-4)
    assert float(row["difference"]) == pytest.approx(fmean(gains), abs=1e-4)


def test_counterfactuals_are_in_no_other_table(root: Path, params: Params) -> None:
    metrics = json.loads((root / "reports" / params.report_name / "metrics.json").read_text())
    assert not [name for name in metrics if "swapped" in name or "removed" in name]
    real = [v for v in params.plan.variants.values() if v.touch == "real"]
    assert len(real) == 24
    assert len(params.plan.variants) == 24 + 2 * 2


def test_a_task_that_the_base_model_cannot_do_is_marked_everywhere(root: Path, params: Params) -> None:
    for name in ("ablation", "effects", "describing", "touch"):
        marks = {(r["task"].split()[0], r["gate"]) for r in rows(root, params, name)}
        assert marks == {("PC", "passed"), ("PSS", ""), ("POM", f"{FAILED}, facts told"), ("PSR", ""), ("OPD", "")}, (
            name
        )
    page = (root / "reports" / params.report_name / "README.md").read_text()
    assert FAILED in page
    with (root / "reports" / params.report_name / "tables" / "understanding.csv").open(newline="") as stream:
        notes = {r["row"]: r["note"] for r in csv.DictReader(stream)}
    assert "gate" in notes["POM"]
    assert "questions.facts" in notes["POM"]
    assert notes["PC"] == ""


def test_a_broken_gate_is_named(tmp_path: Path, params: Params) -> None:
    write_chain(tmp_path, params)
    write_text(tmp_path / "base" / "gate.csv", "task,accuracy\nPC,high\n")
    with pytest.raises(UserError, match=r"gate.csv: not a table of GateRow"):
        write_report(params, tmp_path)


def test_one_seed_and_one_variant_leave_out_what_cannot_be_compared(tmp_path: Path) -> None:
    params = fake_params("ablation.plan=single", "ablation.counterfactuals=[]")
    write_chain(tmp_path, params)
    write_report(params, tmp_path)
    folder = tmp_path / "reports" / params.report_name / "language"
    assert sorted(p.name for p in folder.glob("*.csv")) == ["ablation.csv"]


def test_missing_answers_leave_rows_out(tmp_path: Path, params: Params) -> None:
    write_chain(tmp_path, params)
    write_table(tmp_path / "data" / "scores" / "base-with-all-3" / "scores.parquet", Score, [])
    write_report(params, tmp_path)
    table = rows(tmp_path, params, "ablation")
    assert not [r for r in table if (r["encoder"], r["lora"], r["opd"], r["seed"]) == ("base", "with", "all", "3")]
    effect = next(
        r for r in rows(tmp_path, params, "effects") if (r["axis"], r["others"]) == ("encoder", "full system")
    )
    assert int(effect["pairs"]) == 1
