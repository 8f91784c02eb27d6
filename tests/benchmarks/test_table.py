"""The table of costs and errors, the figures drawn from it, and every section in a reduced form, whole."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import __main__ as command
from benchmarks import contact, encoder, frames, serving, systems, training
from benchmarks.figures import FOLDER
from benchmarks.table import CSV, Error, Row, front, make_rows, mean_of, merge, read_rows, share_of
from pipeline.core.io import write_csv, write_json
from pipeline.core.records import Encoder, Lora, Opd, Variant
from pipeline.core.runtime import PORTABLE
from pipeline.encoder import frame_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.evaluation.rows import ScoreRow
from pipeline.scales import compose, write_params
from pipeline.scenes.light import make_sensor, shade
from pipeline.training.trainable import save_trainable
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.film import write_film
from tests.conftest import ROOT, refused
from tests.use.shared import make

POINTS = st.lists(st.tuples(st.integers(1, 6), st.integers(0, 6)), min_size=1, max_size=12)


@given(POINTS)
def test_the_front_is_what_no_other_beats(points: list[tuple[int, int]]) -> None:
    costs, errors = zip(*points, strict=True)
    found = front(costs, errors)
    # A second way: in order of cost, then error, only what has less error than all before stays, and its equals.
    lowest, expected = float("inf"), set()
    for cost, error in sorted(points):
        if error < lowest:
            expected.add((cost, error))
            lowest = error
    assert [point in expected for point in points] == found


def test_ratios_are_within_a_repeat() -> None:
    """A slow repeat slows all alike, and changes no ratio."""
    found = make_rows("q", {"a": [2.0, 300.0, 4.0], "b": [1.0, 100.0, 2.0]}, unit="ms", baseline="b")
    assert [(row.cost, row.cost_ratio) for row in found] == [(4, 2), (2, 1)]


def rows(question: str, *points: tuple[str, float, float | None]) -> list[Row]:
    return make_rows(
        question,
        {name: [cost] for name, cost, _ in points},
        unit="ms",
        baseline=points[0][0],
        errors={name: Error(e, e / 2, min(1.0, 2 * e), 9) for name, _, e in points if e is not None},
        error_of="share wrong",
        counts={points[0][0]: {"frames": 5}},
        machine="any",
    )


def test_merging_keeps_other_questions_and_their_order(tmp_path: Path) -> None:
    table = tmp_path / "speed_error.csv"
    kept, old = rows("kept", ("a", 1, 0.1), ("b", 3, 0.12345)), rows("old", ("a", 1, 0.5), ("gone", 2, 0.4))
    merge(table, [*old, *kept])
    assert read_rows(table) == [*old, *kept]
    fresh, new = rows("old", ("a", 7, None), ("b", 5, None)), rows("new", ("a", 1, 0.1))
    assert merge(table, [*new, *fresh]) == [*fresh, *kept, *new] == read_rows(table)
    before = table.read_bytes()
    merge(table, fresh)
    assert table.read_bytes() == before
    table.write_text("question,setting\nq,s\n")
    with refused("not a table"):
        read_rows(table)


def test_errors_have_intervals_over_objects() -> None:
    one = mean_of([1.0, 3.0, 2.0, 2.0], ["a", "a", "b", "b"])
    assert (one.error, one.low, one.high) == (2, 2, 2)
    two = mean_of([1.0, 3.0], ["a", "b"])
    # Student's t with one degree of freedom: 12.706, deviation sqrt 2 over sqrt 2.
    assert two.high == pytest.approx(2 + 12.706, abs=1e-3)
    assert two.low == 0
    assert mean_of([1.0], ["a"]) == Error(1.0, n=1)
    share = share_of([1, 0, 0, 1], [(o,) for o in "abcd"])
    assert share.low < share.error == 0.5 < share.high
    named = {"task": "t", "measure": "m", "encoder": "e", "seed": "all"}
    counted = {"right": 4, "unread": 0, "chance": 0.1, "n": 9, "sets": 4}
    score = ScoreRow.model_validate({**named, **counted, "accuracy": 0.5, "low": 0.4, "high": 0.7})
    assert vars(Error.of(score)) == pytest.approx({"error": 0.5, "low": 0.3, "high": 0.6, "n": 9})
    assert Error.of(score.model_copy(update={"low": None, "high": None})) == Error(0.5, n=9)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    merge(CSV, rows("other", ("a", 1, 0.2)))
    monkeypatch.setattr(contact, "measure", lambda root: rows("contact", ("x", 1, 0.1), ("y", 2, 0.05)))
    command.main(["contact"])
    assert [row.question for row in read_rows(CSV)] == ["other", "contact", "contact"]
    assert (CSV.parent / FOLDER / "contact.png").is_file()
    assert "x 2  error 0.05 (front)" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="frames, encoder, contact, systems, serving, training"):
        command.main(["startup"])


@pytest.fixture(scope="module")
def project(catalogue: Catalogue, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with tiny models, and a video each of balls of twelve sizes."""
    root = tmp_path_factory.mktemp("project")
    write_params(compose("smoke", ["data.source=videos", "data.dir=films"], ROOT / "conf"), root / "params.yaml")
    (root / "pipeline").symlink_to(ROOT / "pipeline")
    (root / "films").mkdir()
    sensor = make_sensor(96, 72, 0)
    y, x = np.mgrid[:72, :96]
    known = sorted(catalogue.objects.values(), key=lambda o: o.object_id)
    parts = {part: [o.object_id for o in known if o.splits["paper"] == part] for part in ("train", "validation")}
    for place, name in enumerate([*parts["train"][:10], *parts["validation"][:2]]):
        ball = np.exp(-((x - 48) ** 2 + (y - 36) ** 2) / (60 + 25 * place)).astype(np.float32)
        skins = [np.float32(max(0, np.sin(t / 4 - 0.5))) * ball for t in range(20)]
        pictures = [shade(skin, sensor, 0.3, seed * 977) for seed, skin in enumerate(skins)]
        write_film(root / "films" / f"{name}_0.avi", pictures, 10.0)
    return root


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OCTOPI_DATA_DIR", raising=False)
    for name, value in (("STRENGTHS", (1e-3,)), ("FOLDS", 2), ("ROUNDS", 5)):
        monkeypatch.setattr(frame_classifier, name, value)


def by_question(rows: list[Row], folder: Path) -> dict[str, dict[str, Row]]:
    """Rows by question and setting, after a way through the file."""
    merge(folder / "table.csv", rows)
    found: dict[str, dict[str, Row]] = {}
    for row in read_rows(folder / "table.csv"):
        found.setdefault(row.question, {})[row.setting] = row
    for own in found.values():
        assert all(row.cost > 0 for row in own.values())
        assert 1 in [row.cost_ratio for row in own.values()]
        measured = [row for row in own.values() if row.error is not None]
        assert any(row.front for row in measured) == bool(measured)
    return found


@pytest.fixture
def trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a tiny trained model, in a project with videos, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    made = make(tmp_path, Variant(Encoder.FINETUNED, Lora.WITH, Opd.ALL, 0))
    write_params(compose("smoke", ["data.source=videos", "data.dir=videos"], ROOT / "conf"))
    return made.folder


def test_frames(project: Path, tmp_path: Path) -> None:
    rules = by_question(frames.measure(project, folds=2, deals=1), tmp_path)["frames"]
    assert [row.frames for row in rules.values()] == [1, 3, 5, 10]
    assert all(row.n == 12 and row.low is not None for row in rules.values())
    with refused("videos of 40 objects"):
        frames.measure(project, folds=20)


def test_encoder(project: Path, tmp_path: Path) -> None:
    reduced = {"folds": 2, "deals": 1}
    with refused("repro pretrain"):
        encoder.measure(project, **reduced)
    torch.manual_seed(0)
    save_trainable(SceneEncoder(), project / encoder.PRETRAINED)
    found = by_question(encoder.measure(project, **reduced), tmp_path)
    assert list(found["frame size"]) == ["120 pixels", "90 pixels", "60 pixels", "30 pixels"]
    assert all((row.n, row.frames) == (12, 5) for row in found["frame size"].values())


def test_systems_by_report_and_shipped_model(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(systems, "SHIPPED", trained)
    with refused("scores.csv: has no answers of the shipped model; run `make repro` first"):
        systems.measure(tmp_path)
    usual = {"encoder": trained.name, "measure": "choice", "opd": "all", "seed": "all", "chance": 0.1}
    usual |= {"right": 9, "unread": 0, "n": 8, "sets": 8}
    scores = [
        ScoreRow(task=task, touch=touch, accuracy=right, low=right - 0.1, high=right + 0.2, **usual)
        for touch, right in (("touch", 0.5), ("classes", 0.75))
        for task in systems.COMPARING
    ]
    (tmp_path / "reports" / "smoke-videos").mkdir(parents=True)
    scores += [row.model_copy(update={"seed": "0"}) for row in scores]  # The same answers.
    write_csv(tmp_path / "reports" / "smoke-videos" / "scores.csv", ScoreRow, scores)
    rules, model, *tokens = systems.measure(tmp_path, triples=1, batch=2)
    assert (rules.error, rules.low, rules.high, rules.n) == (0.25, 0.05, 0.35, 32)
    assert (model.error, model.cost_ratio) == (0.5, 1)
    assert [row.setting for row in tokens] == ["1 at a time", "2 at a time"]


def test_contact(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = {name: contact.models()[name] for name in ("layer, every pixel", "winkler", "layer, 64 cells")}
    chosen["layer, every pixel"] = chosen["layer, every pixel"].model_copy(update={"cells": 96})
    monkeypatch.setattr(contact, "models", lambda: chosen)
    monkeypatch.setattr(contact, "FRAMES", 12)
    found = by_question(contact.measure(project, objects=6, videos=1), tmp_path)
    finest, springs, coarse = (found["contact"][name].error for name in chosen)
    assert finest == 0 < coarse < springs
    assert all(row.n == 6 for row in found["contact"].values())


def test_serving_by_a_process_and_a_server(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in PORTABLE.items():  # In half precision an answer depends on its batch, where AMX sums it.
        monkeypatch.setenv(name, value)
    rows = {row.setting: row for row in serving.measure(tmp_path, clients=3, each=2)}
    once, crowded = rows["a server, one client: median"], rows["a server, 3 clients: median"]
    assert once.cost_ratio == 1
    assert "a fresh process, first answer" in rows
    assert crowded.cost <= rows["a server, 3 clients: 95 % are quicker"].cost
    assert "6 requests, none lost, 0 unlike the one alone" in crowded.machine
    monkeypatch.setattr(serving, "COMMAND", ["sh", "-c", "echo octopi: no such model >&2; exit 1"])
    with refused("octopi: no such model"):
        serving.measure(tmp_path)


def test_trainings_are_read_from_what_the_stages_left(tmp_path: Path) -> None:
    """Only where dvc.lock has what they made: the outputs of y come from another run, which DVC restored."""
    write_params(compose("smoke", conf=ROOT / "conf"), tmp_path / "params.yaml")
    (tmp_path / "dvc.yaml").symlink_to(ROOT / "dvc.yaml")
    known = {"align@x-0": (60, 100), "lora@x-0": (120, 300), "lora@y-0": (7, 7), "embed": (9, 9), "pretrain": (30, 50)}
    stages = {name: {"outs": [{"path": name, "md5": "restored" if "y" in name else "0"}]} for name in known}
    (tmp_path / "dvc.lock").write_text(yaml.safe_dump({"stages": stages}))
    with refused("no training ran here; run `make repro` first"):
        training.measure(tmp_path)
    for name, (seconds, peak) in known.items():
        run = dict.fromkeys(("started", "ended"), "2024-05-01") | {"device": "a card", "outs": {name: "0"}}
        run |= {"seconds": seconds, "startup_seconds": 1, "peak_memory_mb": peak, "metrics": {}}
        write_json(tmp_path / "runs" / f"{name}.json", run)
    theirs, pretrained, seven, thirteen, model = training.measure(tmp_path)
    assert theirs.question == pretrained.question != seven.question == thirteen.question == model.question
    assert [row.cost_ratio for row in (theirs, seven, thirteen)] == [1, 1, 1.3], "each to the paper's own"
    assert (model.setting, model.cost, model.machine) == ("smoke-scenes, x-0", 3, "a card")
    assert model.cost_ratio == 0.01
    assert model.megabytes == pytest.approx(300 * 1.048576, rel=1e-3)
    assert (pretrained.setting, pretrained.cost) == ("smoke-scenes, pretrain", 0.5)
