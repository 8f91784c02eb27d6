"""The tables that tell of a cross-validation of encoders, and their folder in a report."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from pipeline.io import read_json, write_table
from pipeline.encoder.candidates import CONTESTANTS
from pipeline.videos.catalogue import Catalogue
from pipeline.records import Judged
from pipeline.reporting import write_report
from pipeline.reporting.encoder_report import write_encoder_report
from pipeline.reporting.encoders import encoder_tables
from pipeline.reporting.table import Table
from pipeline.review.readme import parse
from pipeline.statistics import Interval, Outcome, clustered, paired
from tests.fake_chain import fake_params, write_chain

UNANIMOUS, DISPUTED = ("controller_base", "ice_block", "pillow"), ("baseball", "bath_towel", "rug")
SKILL = {
    "trees": 0.5,
    "strong": 0.8,
    "strong-raw": 0.4,
    "strong-40-objects": 0.7,
    "strong-10-objects": 0.3,
    "paper": 0.2,
}


def made_up(catalogue: Catalogue, skill: Mapping[str, float], repeats: int = 2) -> dict[str, list[Judged]]:
    """Two or three videos an object, each property right so often; in no order."""
    rng = np.random.default_rng(3)
    judged: dict[str, list[Judged]] = {}
    for name, chance in skill.items():
        rows = [
            Judged(
                video_id=f"{o}_{i}",
                object_id=o,
                repeat=repeat,
                expected=catalogue.labels(o),
                predicted=tuple(c if rng.random() < chance else int(rng.integers(3)) for c in catalogue.labels(o)),
            )
            for position, o in enumerate(UNANIMOUS + DISPUTED)
            for i in range(2 + position % 2)
            for repeat in range(repeats)
        ]
        judged[name] = [rows[i] for i in rng.permutation(len(rows))]
    return judged


def right(judged: Sequence[Judged], position: int | None = None) -> dict[str, list[float]]:
    """By object, each video's share of right repeats."""
    videos: dict[str, list[Judged]] = {}
    for j in judged:
        videos.setdefault(j.video_id, []).append(j)
    objects: dict[str, list[float]] = {}
    for same in videos.values():
        hits = [
            j.predicted == j.expected if position is None else j.predicted[position] == j.expected[position]
            for j in same
        ]
        objects.setdefault(same[0].object_id, []).append(sum(hits) / len(hits))
    return objects


def outcomes(values: Mapping[str, Sequence[float]]) -> list[Outcome]:
    return [Outcome(float(v), (o,)) for o, every in values.items() for v in every]


def ends(interval: Interval | None) -> tuple[float, float]:
    assert interval is not None
    return interval.low, interval.high


def mean(values: Mapping[str, Sequence[float]]) -> float:
    flat = list(itertools.chain.from_iterable(values.values()))
    return sum(flat) / len(flat)


@pytest.fixture(scope="module")
def judged(catalogue: Catalogue) -> dict[str, list[Judged]]:
    return made_up(catalogue, SKILL)


@pytest.fixture(scope="module")
def tables(judged: dict[str, list[Judged]], catalogue: Catalogue) -> dict[str, Table]:
    found = encoder_tables(judged, catalogue, {"trees": 12.5, "strong": 3.25}, 5)
    return {table.name: table for table in found}


def rows(table: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv())))


def test_the_tables_are_these(tables: dict[str, Table]) -> None:
    assert list(tables) == ["cross_validation", "differences", "errors", "agreement", "learning_curve"]
    assert list(rows(tables["cross_validation"])[0]) == [
        "model",
        "property",
        "accuracy",
        "low",
        "high",
        "n",
        "ms_per_video",
    ]
    caption = tables["cross_validation"].caption
    assert "15 videos of 6 objects, 5 folds of objects, dealt 2 times" in caption


def test_accuracies_by_hand(tables: dict[str, Table], judged: dict[str, list[Judged]], catalogue: Catalogue) -> None:
    found = rows(tables["cross_validation"])
    names = ["combined", *catalogue.property_names]
    assert [(r["model"], r["property"]) for r in found] == [(m, p) for m in SKILL for p in names]
    for row in found:
        position = None if row["property"] == "combined" else catalogue.property_index(row["property"])
        values = right(judged[row["model"]], position)
        assert float(row["accuracy"]) == pytest.approx(mean(values), abs=6e-5)
        assert row["n"] == "15"
        assert row["ms_per_video"] == {"trees": "12.5", "strong": "3.25"}.get(row["model"], "")
    for model, position in (("strong", None), ("paper", 1)):
        (row,) = (
            r for r in found if r["model"] == model and r["property"] == names[0 if position is None else position + 1]
        )
        low, high = ends(clustered(outcomes(right(judged[model], position))))
        assert (float(row["low"]), float(row["high"])) == pytest.approx((low, high), abs=6e-5)


def test_a_person_reads_all_of_the_models_and_the_sum_of_variations(tables: dict[str, Table]) -> None:
    shown = tables["cross_validation"].markdown().splitlines()[2:]
    lines = Counter(line.split("|")[1].strip() for line in shown)
    assert lines == {m: 1 if CONTESTANTS[m].parent else 4 for m in SKILL}
    assert set(rows(tables["errors"])[0]) >= {"model", "property", "absolute_error", "kappa"}


def test_errors_by_hand(tables: dict[str, Table], judged: dict[str, list[Judged]], catalogue: Catalogue) -> None:
    for row in rows(tables["errors"]):
        position = catalogue.property_index(row["property"])
        pairs = [(j.expected[position], j.predicted[position]) for j in judged[row["model"]]]
        assert float(row["absolute_error"]) == pytest.approx(np.mean([abs(a - b) for a, b in pairs]), abs=6e-5)
        assert row["repeats"] == "2"
        most = Counter(a for a, _ in pairs).most_common(1)[0][1]
        assert float(row["majority"]) == pytest.approx(most / len(pairs), abs=6e-5)
        each = [
            np.mean([j.expected[position] == j.predicted[position] for j in judged[row["model"]] if j.repeat == r])
            for r in (0, 1)
        ]
        assert float(row["spread"]) == pytest.approx(np.std(each, ddof=1), abs=6e-5)


def test_agreement_splits_objects_by_their_ratings(tables: dict[str, Table], judged: dict[str, list[Judged]]) -> None:
    found = rows(tables["agreement"])
    assert [(r["model"], r["ratings"]) for r in found] == [(m, s) for m in SKILL for s in ("unanimous", "disputed")]
    for row in found:
        objects = UNANIMOUS if row["ratings"] == "unanimous" else DISPUTED
        values = {o: v for o, v in right(judged[row["model"]]).items() if o in objects}
        assert float(row["accuracy"]) == pytest.approx(mean(values), abs=6e-5)
        assert (float(row["low"]), float(row["high"])) == pytest.approx(ends(clustered(outcomes(values))), abs=6e-5)
        assert int(row["objects"]) == len(objects)
        assert int(row["videos"]) == sum(map(len, values.values()))


def test_differences_are_against_the_parent_or_the_baseline(
    tables: dict[str, Table], judged: dict[str, list[Judged]], catalogue: Catalogue
) -> None:
    found = rows(tables["differences"])
    assert [(r["model"], r["against"]) for r in found] == [
        ("strong", "trees"),
        ("strong-raw", "strong"),
        ("strong-40-objects", "strong"),
        ("strong-10-objects", "strong"),
        ("paper", "trees"),
    ]
    for row in found:
        own, other = right(judged[row["model"]]), right(judged[row["against"]])
        # Records come in no order, so that videos are matched by name here.
        gains = {
            o: [
                np.mean([j.predicted == j.expected for j in judged[row["model"]] if j.video_id == v])
                - np.mean([j.predicted == j.expected for j in judged[row["against"]] if j.video_id == v])
                for v in sorted({j.video_id for j in judged[row["model"]] if j.object_id == o})
            ]
            for o in own
        }
        assert float(row["difference"]) == pytest.approx(mean(own) - mean(other), abs=6e-5)
        assert row["what"] == CONTESTANTS[row["model"]].title
        if row["model"] == "paper":
            assert (float(row["low"]), float(row["high"])) == pytest.approx(
                ends(paired(outcomes(gains)).interval), abs=6e-5
            )
    alone = {n: records for n, records in judged.items() if n in ("paper", "strong-raw")}
    without = {t.name: t for t in encoder_tables(alone, catalogue, {}, 5)}
    assert "differences" not in without, "nothing to compare with"
    assert "learning_curve" not in without


def test_the_learning_curve_rises_in_objects(tables: dict[str, Table], judged: dict[str, list[Judged]]) -> None:
    """Four fifths of six objects are 4.8: nobody learns from 10 or 40."""
    found = rows(tables["learning_curve"])
    numbers = [float(r["objects"]) for r in found]
    assert numbers == pytest.approx([4.8] * 3)
    assert {r["model"] for r in found} == {"strong", "strong-40-objects", "strong-10-objects"}
    for row in found:
        assert float(row["accuracy"]) == pytest.approx(mean(right(judged[row["model"]])), abs=6e-5)


def test_the_learning_curve_is_sorted(catalogue: Catalogue) -> None:
    records = [
        Judged(video_id=f"{o}_0", object_id=o, repeat=0, expected=catalogue.labels(o), predicted=(0, 0, 0))
        for o in list(catalogue.objects)[:40]
    ]
    names = ("strong-30-objects", "strong", "strong-10-objects", "strong-40-objects", "constant")
    (curve,) = (
        t for t in encoder_tables(dict.fromkeys(names, records), catalogue, {}, 5) if t.name == "learning_curve"
    )
    found = [(r["model"], float(r["objects"])) for r in rows(curve)]
    assert [n for _, n in found] == [10, 30, 32, 32]
    assert {m for m, n in found if n == 32} == {"strong", "strong-40-objects"}, "of 40 objects folds leave 32"


def test_nothing_judged_leaves_no_table(catalogue: Catalogue) -> None:
    assert encoder_tables({}, catalogue, {}, 5) == []


def test_the_comparison_is_a_folder_that_says_where_it_comes_from(
    judged: dict[str, list[Judged]], tmp_path: Path
) -> None:
    params = fake_params("cross_validation.models=[trees,paper]")
    write_chain(tmp_path, params)
    shutil.rmtree(tmp_path / "data" / "cross_validation")
    assert write_encoder_report(params, tmp_path) == {}
    folder = tmp_path / "reports" / params.report_name / "encoder"
    assert "no model of `cross_validation.models`" in (folder / "README.md").read_text()
    for name in ("paper", "trees", "strong"):
        write_table(tmp_path / "data" / "cross_validation" / name / "judged.parquet", Judged, judged[name])
    found = write_encoder_report(params, tmp_path)
    assert set(found) == {"trees.combined", "paper.combined"}, "strong was not asked for"
    assert found["trees.combined"] == pytest.approx(mean(right(judged["trees"])), abs=1e-6)
    readme = parse((folder / "README.md").read_text())
    names = [section.file for section in readme.sections]
    assert names == ["cross_validation.csv", "differences.csv", "errors.csv", "agreement.csv"]
    assert all((folder / name).is_file() for name in names)
    assert (folder / "params.yaml").read_text() == (tmp_path / "params.yaml").read_text()
    origin = read_json(folder / "provenance.json")
    assert origin["params_sha256"] == hashlib.sha256((tmp_path / "params.yaml").read_bytes()).hexdigest()


def test_the_rest_of_a_report_neither_needs_nor_touches_the_comparison(tmp_path: Path) -> None:
    params = fake_params("cross_validation.models=[trees,probe]", "ablation.plan=single")
    write_chain(tmp_path, params)
    write_report(params, tmp_path)
    folder = tmp_path / "reports" / params.report_name
    assert not (folder / "encoder").exists()
    assert "(encoder/README.md)" in (folder / "README.md").read_text()
    (folder / "encoder").mkdir()
    (folder / "encoder" / "README.md").write_text("# Encoders\n")
    write_report(params, tmp_path)
    assert [file.name for file in (folder / "encoder").iterdir()] == ["README.md"]


def test_one_object_has_no_interval(catalogue: Catalogue) -> None:
    records = [
        Judged(video_id=f"rug_{i}", object_id="rug", repeat=0, expected=catalogue.labels("rug"), predicted=(0, 0, 0))
        for i in range(3)
    ]
    (table, *_) = encoder_tables({"constant": records}, catalogue, {}, 2)
    assert {(r["low"], r["high"]) for r in rows(table)} == {("", "")}
