"""The tables about the language model: every seed, paired effects, counterfactuals, and the base model's gate."""

from __future__ import annotations

import csv
import itertools
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest

from pipeline.io import read_table, write_table, write_text
from pipeline.params import Params
from pipeline.errors import UserError
from pipeline.records import Score, Task
from pipeline.reporting import write_report
from pipeline.reporting.answered import FAILED
from pipeline.reporting.directions import verdict
from pipeline.reporting.seeds import ONE_RUN
from pipeline.statistics import Outcome, clustered, holm
from tests.fake_chain import fake_params, write_chain

Rows = list[dict[str, str]]
AXES = [
    "-".join(axes) for axes in itertools.product(("base", "finetuned"), ("without", "with"), ("none", "needed", "all"))
]
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


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory, params: Params) -> Path:
    """The paper's four variants under one seed; the report's name is that of `params`."""
    folder = tmp_path_factory.mktemp("single")
    paper = fake_params("language.weights=base/llama")
    assert paper.report_name == params.report_name
    write_chain(folder, paper)
    write_report(paper, folder)
    return folder


def rows(root: Path, params: Params, name: str) -> Rows:
    file = root / "reports" / params.report_name / "language" / f"{name}.csv"
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def graded(root: Path, key: str, task: Task, measure: str = "choice") -> dict[str, Score]:
    scores = read_table(root / "data" / "scores" / key / "scores.parquet", Score)
    return {s.question_id: s for s in scores if (s.task, s.measure) == (task, measure)}


def runs(
    root: Path, variants: Sequence[str], task: Task, seeds: Sequence[int] = (0, 3)
) -> dict[tuple[int, str], tuple[int, ...]]:
    """Whether each of some variants was right, by seed and question."""
    found: dict[tuple[int, str], list[int]] = defaultdict(list)
    for seed in seeds:
        for variant in variants:
            for q, score in graded(root, f"{variant}-{seed}", task).items():
                found[seed, q].append(score.correct)
    return {place: tuple(values) for place, values in found.items()}


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


def test_effects_are_paired_by_question_over_seeds(root: Path, params: Params) -> None:
    table = rows(root, params, "effects")
    assert len({(r["axis"], r["change"], r["task"]) for r in table}) == len(table) == 4 * 4 + 1 + 5 + 1
    effect = next(r for r in table if (r["axis"], r["task"]) == ("LoRA", "PC"))
    found = runs(root, ("finetuned-with-all", "finetuned-without-all"), Task.PC)
    gains = {(s, q): a - b for (s, q), (a, b) in found.items()}
    assert float(effect["difference"]) == pytest.approx(fmean(gains.values()), abs=1e-4)
    assert (int(effect["n"]), int(effect["pairs"])) == (len(gains) // 2, 2)
    none = [r for r in table if r["task"] == "OPD" and "none" in r["change"]]
    assert not none, "a system that never describes cannot be compared in describing"
    for row in table:
        assert float(row["low"]) <= float(row["difference"]) <= float(row["high"])
        assert float(row["p"]) <= float(row["p_holm"]) <= 1
        clear = float(row["low"]) > 0 or float(row["high"]) < 0
        assert clear or float(row["p"]) > 0.049
        assert float(row["smallest_effect"]) > 0
        assert min(float(row["sd_objects"]), float(row["sd_questions"])) >= 0


def test_directions_are_the_papers_beside_the_same_effects(root: Path, params: Params) -> None:
    table, found = rows(root, params, "directions"), rows(root, params, "effects")
    assert [(r["part"], r["task"]) for r in table] == [
        *(("OPD", task) for task in ("PC", "PSS", "POM", "PSR")),
        *(("encoder", task) for task in ("PC", "PSS", "POM", "OPD")),
        *(("LoRA", task) for task in ("PC", "PSS", "POM", "OPD")),
    ]
    for row in table:
        key = (row["part"], row["change"], row["task"])
        (effect,) = [e for e in found if (e["axis"], e["change"], e["task"]) == key]
        assert [row[c] for c in ("difference", "low", "high", "gate")] == [
            effect[c] for c in ("difference", "low", "high", "gate")
        ]
        low, high = float(row["low"]), float(row["high"])
        assert row["verdict"] == ("holds" if low > 0 else "reversed" if high < 0 else "not shown")
    # By hand from the paper's tables, in percent: 48.10 - 46.51, 55.06 - 40.70, 47.37 - 39.47, 55.26 - 50.00.
    printed = {(r["part"], r["task"]): (float(r["published_7b"]), float(r["published_13b"])) for r in table}
    assert printed["OPD", "PC"] == pytest.approx((0.0159, 0.1436), abs=1e-9)
    assert printed["OPD", "PSR"] == pytest.approx((0.0653, 0.2826), abs=1e-9)
    assert printed["encoder", "OPD"] == pytest.approx((0.0790, 0.0526), abs=1e-9)
    assert printed["LoRA", "PC"] == pytest.approx((0.0759, 0.0253), abs=1e-9)


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (0.001, 0.4, "holds"),
        (0.0, 0.4, "not shown"),
        (-0.2, 0.3, "not shown"),
        (-0.3, 0.0, "not shown"),
        (-0.3, -0.001, "reversed"),
        (None, None, "not shown"),
    ],
)
def test_a_direction_holds_where_its_interval_is_clear_of_zero(
    low: float | None, high: float | None, said: str
) -> None:
    assert verdict(low, high) == said


def test_mcnemar_is_exact_one_seed_at_a_time(root: Path, params: Params, single: Path) -> None:
    from scipy.stats import binomtest

    def p(folder: Path, seed: int) -> float:
        found = runs(folder, ("finetuned-with-all", "finetuned-without-all"), Task.PSS, (seed,))
        better, worse = sum(a > b for a, b in found.values()), sum(a < b for a, b in found.values())
        return float(binomtest(better, better + worse).pvalue)

    several, one = (
        next(r for r in rows(folder, params, "effects") if (r["axis"], r["task"]) == ("LoRA", "PSS"))
        for folder in (root, single)
    )
    assert float(several["p_mcnemar"]) == pytest.approx(min(1.0, 2 * min(p(root, 0), p(root, 3))), abs=1e-4)
    assert float(one["p_mcnemar"]) == pytest.approx(p(single, 0), abs=1e-4)


def test_the_factorial_view_is_over_all_variants(root: Path, params: Params) -> None:
    table = {(r["factors"], r["change"], r["task"]): r for r in rows(root, params, "factorial")}
    kinds = {"main": 4 * 5 + 3, "interaction": 4 * 7 + 3}
    assert {k: sum(r["effect"] == k for r in table.values()) for k in kinds} == kinds
    answers = {key: runs(root, (key,), Task.PC) for key in AXES}
    means = {tuple(key.split("-")): fmean(v for (v,) in found.values()) for key, found in answers.items()}

    def over(place: int, level: str, **fixed: str) -> float:
        return fmean(
            m
            for axes, m in means.items()
            if axes[place] == level and all(axes[int(i[1])] == v for i, v in fixed.items())
        )

    lora = table["LoRA", "with minus without", "PC"]
    assert float(lora["difference"]) == pytest.approx(over(1, "with") - over(1, "without"), abs=1e-4)
    assert (lora["cells"], lora["seeds"]) == ("12", "2")
    crossed = table["encoder x OPD", "finetuned minus base x needed minus none", "PC"]
    gain = [over(0, "finetuned", a2=opd) - over(0, "base", a2=opd) for opd in ("needed", "none")]
    assert float(crossed["difference"]) == pytest.approx(gain[0] - gain[1], abs=1e-4)
    assert crossed["cells"] == "8"
    for row in table.values():
        assert float(row["low"]) <= float(row["difference"]) <= float(row["high"])
        assert float(row["p"]) <= float(row["p_holm"]) <= 1
    for kind in kinds:
        family = [r for r in table.values() if r["effect"] == kind]
        assert [float(r["p_holm"]) for r in family] == pytest.approx(holm([float(r["p"]) for r in family]), abs=1e-3)


def test_seeds_say_why_runs_differ(root: Path, params: Params) -> None:
    table = {(r["encoder"], r["lora"], r["opd"], r["task"]): r for r in rows(root, params, "seeds")}
    assert len(table) == 12 * 4 + 8
    row = table["finetuned", "with", "all", "PSS"]
    found = runs(root, ("finetuned-with-all",), Task.PSS)
    by_seed = [np.array([v for (s, _), (v,) in sorted(found.items()) if s == seed], float) for seed in (0, 3)]
    means = [values.mean() for values in by_seed]
    assert row["by_seed"] == f"0: {means[0]:.4f}, 3: {means[1]:.4f}"
    assert float(row["accuracy"]) == pytest.approx(np.mean(means), abs=1e-4)
    assert float(row["deviation"]) == pytest.approx(np.std(means, ddof=1), abs=1e-4)
    # With two runs, half the variance of their answers' differences is what single answers bring to each.
    alone = np.var(by_seed[0] - by_seed[1], ddof=1) / 2
    assert float(row["sd_answers"]) == pytest.approx(alone**0.5, abs=1e-4)
    assert float(row["expected"]) == pytest.approx((alone / len(by_seed[0])) ** 0.5, abs=1e-4)
    whole = max(0.0, np.var(means, ddof=1) - alone / len(by_seed[0]))
    assert float(row["sd_seeds"]) == pytest.approx(whole**0.5, abs=1e-4)
    for row in table.values():
        assert float(row["low"]) <= float(row["accuracy"]) <= float(row["high"])
        assert (row["seeds"], row["note"], row["most"]) == ("2", "", "")


def test_a_single_run_says_what_it_cannot(single: Path, params: Params) -> None:
    ablation = {
        tuple(r[c] for c in ("encoder", "lora", "opd", "task")): r
        for r in rows(single, params, "ablation")
        if len(r["task"].split()) == 1
    }
    table = rows(single, params, "seeds")
    assert len(table) == len(ablation)
    for row in table:
        assert row["note"] == ONE_RUN
        assert {row[c] for c in ("deviation", "expected", "sd_seeds", "sd_objects", "sd_questions", "sd_answers")} == {
            ""
        }
        share, n = float(row["accuracy"]), int(row["n"])
        assert float(row["most"]) == pytest.approx((share * (1 - share) / n) ** 0.5, abs=1e-4)
        same = ablation[tuple(row[c] for c in ("encoder", "lora", "opd", "task"))]
        assert (row["low"], row["high"]) == (same["low"], same["high"]), "new objects alone"
    text = (single / "reports" / params.report_name / "language" / "seeds.md").read_text()
    assert "± over seeds |" not in text, "a column without any figure"


def test_changes_made_in_one_setting_stand_among_the_effects_alone(single: Path, params: Params) -> None:
    folder = single / "reports" / params.report_name
    assert (folder / "language" / "effects.csv").is_file()
    assert not (folder / "language" / "factorial.csv").exists()
    assert "Not drawn: the plan's variants cross no two parts" in (folder / "README.md").read_text()


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
    for name in ("ablation", "directions", "effects", "factorial", "seeds", "describing", "touch"):
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
    assert sorted(p.name for p in folder.glob("*.csv")) == ["ablation.csv", "reasoning.csv", "seeds.csv"]


def test_missing_answers_leave_rows_out(tmp_path: Path, params: Params) -> None:
    write_chain(tmp_path, params)
    write_table(tmp_path / "data" / "scores" / "base-with-all-3" / "scores.parquet", Score, [])
    write_report(params, tmp_path)
    table = rows(tmp_path, params, "ablation")
    assert not [r for r in table if (r["encoder"], r["lora"], r["opd"], r["seed"]) == ("base", "with", "all", "3")]
    effect = next(r for r in rows(tmp_path, params, "effects") if r["axis"] == "encoder")
    assert int(effect["pairs"]) == 1
    gone = next(
        r for r in rows(tmp_path, params, "seeds") if (r["encoder"], r["lora"], r["opd"]) == ("base", "with", "all")
    )
    assert (gone["seeds"], gone["note"]) == ("1", ONE_RUN)
    main = {r["factors"]: r for r in rows(tmp_path, params, "factorial") if r["effect"] == "main" and r["task"] == "PC"}
    assert main["encoder"]["seeds"] == main["LoRA"]["seeds"] == "1", "means are over seeds that all variants have"
