"""Reports over folds: what is pooled, and what is said of missing folds, spoilt test objects and a taught base."""

from collections import defaultdict
from pathlib import Path
from statistics import fmean

import pandas as pd
import pytest

from pipeline.core.io import read_table
from pipeline.core.records import Part
from pipeline.evaluation.records import Graded
from pipeline.report.build import write_report
from pipeline.report.load import load_report
from pipeline.videos.records import Assignment
from tests.fake_run import fake_params, write_run


def run(root: Path, seeds: str) -> Path:
    """The folder of a report over these seeds of three folds, without its figures."""
    few = ("ablation.lora=[with]", "ablation.opd=[all]", "ablation.touch=[]")
    params = write_run(root, fake_params("split.name=kfold", "split.folds=3", f"ablation.seeds={seeds}", *few))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.report.build.draw_figures", lambda *_: [])
        write_report(params, root)
    return root / "reports" / params.report_name


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of two replicates of three folds."""
    return run(tmp_path_factory.mktemp("folds"), "[0,1,2,3,4,5]")


def rows(report_folder: Path, **named: str) -> list[dict[str, float]]:
    every = pd.read_csv(report_folder / "scores.csv", dtype={"seed": str}).to_dict("records")
    return [row for row in every if all(row[column] == value for column, value in named.items())]


def test_two_replicates_of_three_folds_test_each_object_twice(twice: Path) -> None:
    """An accuracy is the mean over all six models' answers; a replicate's that over its three."""
    folder, root = twice, twice.parents[1]
    graded = read_table(root / "data" / "graded.parquet", Graded)
    full = [g for g in graded if g.variant.full and g.touch == "real" and (g.task, g.measure) == ("PC", "choice")]
    assert {(g.trained, g.seed) for g in full} == {(s, s // 3) for s in range(6)}
    for seed, kept in (("0", {0, 1, 2}), ("1", {3, 4, 5}), ("all", set(range(6)))):
        mine = [g for g in full if g.trained in kept]
        (row,) = rows(folder, task="PC", encoder="finetuned", lora="with", opd="all", touch="real", seed=seed)
        assert row["n"] == len({g.question_id for g in mine})
        assert row["accuracy"] == pytest.approx(fmean(g.correct for g in mine), abs=1e-6)
    splits = [read_table(root / "data" / "splits" / f"{seed}.parquet", Assignment) for seed in range(3)]
    tested = [a.video_id for assignments in splits for a in assignments if a.part is Part.TEST]
    assert len(tested) == len(set(tested)) == len(splits[0])
    (heads,) = rows(folder, task="heads", measure="combined", seed="0")
    assert heads["n"] == len(tested)
    validated = [a.video_id for assignments in splits for a in assignments if a.part is Part.VALIDATION]
    assert len(set(validated)) < len(validated), "an object may validate several folds"
    for seed in ("0", "all"):
        (heads,) = rows(folder, task="heads_validation", measure="combined", seed=seed)
        assert heads["n"] == len(validated)
    confusion = pd.read_csv(folder / "confusion.csv")
    assert (confusion.groupby(["seed", "property"]).size() == len(tested)).all()
    said = load_report(folder).provenance
    assert (said["replicates"], said["folds"]) == (2, {"of": 3, "tested": [0, 1, 2], "trained": 0})
    assert len(said["test_objects"]) * 2 == said["test_videos"] == len(tested)


def test_effects_are_paired_within_a_fold(twice: Path) -> None:
    """The reference: the mean difference of two systems, question by question, whatever fold a question is of."""
    graded = read_table(twice.parents[1] / "data" / "graded.parquet", Graded)
    right: dict[str, dict[tuple[int, str], bool]] = defaultdict(dict)
    for g in graded:
        if (g.task, g.measure, g.lora, g.opd, g.touch) == ("PC", "choice", "with", "all", "real"):
            right[g.encoder][g.seed, g.question_id] = g.correct
    effects = pd.read_csv(twice / "effects.csv").to_dict("records")
    (row,) = [e for e in effects if (e["part"], e["task"]) == ("encoder", "PC")]
    assert right["finetuned"].keys() == right["base"].keys()
    assert (row["n"], row["seeds"]) == (len({question for _, question in right["base"]}), 2)
    expected = fmean(right["finetuned"].values()) - fmean(right["base"].values())
    assert row["difference"] == pytest.approx(expected, abs=1e-6)


def test_one_fold_of_three_is_reported_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "notes.yaml").write_text("PhysiCLeAR:\n  smoke-scenes/kfold: of this one\n")
    monkeypatch.setattr("pipeline.report.provenance.NOTES", tmp_path / "notes.yaml")
    folder = run(tmp_path, "[1]")
    assert load_report(folder).provenance["settings"] == "of this one"
    (tmp_path / "notes.yaml").write_text("others:\n  smoke-scenes/kfold: of this one\n")
    assert load_report(run(tmp_path / "other", "[1]")).provenance["settings"] == ""
    assert load_report(folder).provenance["folds"] == {"of": 3, "tested": [1], "trained": 0}
    graded = read_table(tmp_path / "data" / "graded.parquet", Graded)
    assert {(g.seed, g.trained) for g in graded} == {(0, 1)}
    counts = pd.read_csv(folder / "dataset.csv").query("table == 'property_counts'")
    assert (counts["train"] + counts["validation"] + counts["test"] == counts["with_videos"]).all()
