"""The dashboard answers a reviewer: what changed, which variant is best, is it the committed one."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.request import urlopen

import pyarrow.parquet as pq
import pytest
import yaml

from pipeline.params import Params
from pipeline.records import Score, Task
from pipeline.reporting.accuracy import Cell, accuracy_row
from pipeline.tracking.committed import Check, Committed, committed
from pipeline.tracking.dashboard import NOTE, REPRODUCTIONS, VARIANTS, VIEW, Dashboard, Reproduction
from pipeline.tracking.notes import Facts, note
from pipeline.tracking.publishing import publish
from pipeline.tracking.standings import Standing, standings
from pipeline.tracking.store import LONGEST_TAG, STAGE, local_uri
from tests.fake_chain import fake_params, write_chain, write_lock

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
FULL = "finetuned-with-all-0"


def write_report(root: Path, params: Params, **metrics: float) -> None:
    folder = root / "reports" / params.report_name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").write_text(json.dumps(metrics))


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Params, Params]:
    """Two reproductions, the second with other parameters and published twice."""
    root = tmp_path_factory.mktemp("published") / "a clone"
    first, second = fake_params(), fake_params("encoder.epochs=2", "ablation.plan=single")
    write_chain(root, first)
    for params, figure in ((first, 0.25), (second, 0.5)):
        (root / "params.yaml").write_text(yaml.safe_dump(params.model_dump(mode="json"), sort_keys=False))
        write_lock(root, params)
        write_report(root, params, **{"full.PC": figure, "full.POM": 0.125})
        made = publish(params, root)
        assert made.created > 0
    again = publish(params, root)
    assert (again.created, again.updated, again.unchanged) == (0, 0, made.created)
    return root, first, second


def client_of(root: Path) -> tuple[MlflowClient, Any]:
    from mlflow import MlflowClient

    client = MlflowClient(local_uri(root))
    return client, client.get_experiment_by_name("octopi")


def parents(root: Path) -> list[Run]:
    """The oldest first."""
    client, experiment = client_of(root)
    found = client.search_runs([experiment.experiment_id], "tags.`octopi.kind` = 'reproduction'")
    return sorted(found, key=lambda run: str(run.data.tags["octopi.published"]))


def test_variants_have_figures_of_the_same_names(published: tuple[Path, Params, Params]) -> None:
    root, first, _ = published
    client, experiment = client_of(root)
    key = parents(root)[0].data.tags["octopi.key"]
    query = f"tags.`octopi.kind` = 'variant' and tags.`octopi.key` = '{key}'"
    found = {
        run.data.tags[STAGE].removeprefix("grade@"): run
        for run in client.search_runs([experiment.experiment_id], query)
    }
    assert set(found) == set(first.plan.variants)
    for variant, run in found.items():
        rows = pq.read_table(root / "data" / "scores" / variant / "scores.parquet").to_pylist()
        for task in {row["task"] for row in rows}:
            whole = [row for row in rows if row["task"] == task and row["measure"] in ("choice", "combined")]
            share = sum(row["correct"] for row in whole) / len(whole)
            assert run.data.metrics[f"accuracy.{task}"] == pytest.approx(share, abs=5e-5)
            # The report comes to the same interval on its own way.
            cell = accuracy_row(Cell(task, "", 0, (None, None)), {0: [Score.model_validate(row) for row in whole]})
            for end, value in (("low", cell.clustered_low), ("high", cell.clustered_high)):
                assert value is not None
                assert run.data.metrics[f"accuracy.{task}.{end}"] == pytest.approx(value / 100, abs=5e-5)


def test_a_variant_without_scores_has_no_standing(tmp_path: Path) -> None:
    assert standings(tmp_path, "nothing") == []


def test_publishing_again_leaves_every_figure_once(published: tuple[Path, Params, Params]) -> None:
    root, *_ = published
    client, _ = client_of(root)
    for run in parents(root):
        assert set(run.data.metrics) == {"full.PC", "full.POM"}
        assert all(len(client.get_metric_history(run.info.run_id, name)) == 1 for name in run.data.metrics)


def test_the_second_says_what_changed_since_the_first(published: tuple[Path, Params, Params]) -> None:
    root, *_ = published
    one, other = parents(root)
    assert one.data.tags["octopi.changed"] == "first"
    assert "first of its scale and source" in one.data.tags[NOTE]
    assert other.data.tags["octopi.changed"] == "2 parameters, 1 figure"
    text = other.data.tags[NOTE]
    assert "`encoder.epochs` 4 → 2" in text
    assert "`ablation.plan` paper → single" in text.splitlines()[2]
    assert "`full.PC` 0.25 → 0.5" in text
    assert "full.POM" not in text
    assert f"runs/{one.info.run_id})" in text
    assert one.info.run_id in re.findall(r"compare-runs\?runs=(\S+)&", text)[0]


def test_the_description_begins_with_the_answers(published: tuple[Path, Params, Params]) -> None:
    root, first, _ = published
    lines = parents(root)[0].data.tags[NOTE].splitlines()
    assert lines[0] == "- **Committed?** unknown: no Git commit"
    assert lines[1].startswith("- **Best variant?** OPD: ")
    assert "swapped" not in lines[1], "what feels another object is no contestant"
    assert lines[2].startswith("- **Changed?**")
    assert all(any(line.startswith(f"| {variant} |") for line in lines) for variant in first.plan.variants)


def test_prepared_tables_find_what_they_promise(published: tuple[Path, Params, Params]) -> None:
    root, _, second = published
    client, experiment = client_of(root)
    views = {name: json.loads(experiment.tags[f"{VIEW}{name}"]) for name in (REPRODUCTIONS, VARIANTS)}
    for name, view in views.items():
        assert f"viewStateShareKey={name}" in experiment.tags[NOTE].splitlines()[0]
        assert view["columnOrder"][1:] == view["selectedColumns"]
        found = client.search_runs(
            [experiment.experiment_id], view["searchFilter"], order_by=[f"{view['orderByKey']} DESC"]
        )
        kinds = {"metrics": "metrics", "tags": "tags"}
        for column in view["selectedColumns"]:
            kind, figure = re.fullmatch(r"(metrics|tags)\.`(.*)`", column).groups()  # type: ignore[union-attr]
            holders = [run for run in found if figure in getattr(run.data, kinds[kind])]
            assert holders or figure == "octopi.commit", f"{name}: no run has {column}"
        if name == VARIANTS:
            assert {run.data.tags[STAGE] for run in found} == {f"grade@{v}" for v in second.plan.variants}
            figures = [run.data.metrics["accuracy.PC"] for run in found]
            assert figures == sorted(figures, reverse=True)
        else:
            assert {run.info.run_id for run in found} == {run.info.run_id for run in parents(root)}


def test_a_description_fits_a_tag(published: tuple[Path, Params, Params]) -> None:
    root, _, params = published
    rows = [Standing(task, 0.1234, 0.0123, 0.9876) for task in Task]
    every = {f"finetuned-without-needed-{seed}-removed": rows for seed in range(200)}
    this = Reproduction("a" * 32, "name 12345678", {}, {f"p{i}": "x" * 30 for i in range(300)}, {})
    before = Reproduction("b" * 32, "name 12345678", {}, {}, {f"m{i}": 0.5 for i in range(300)})
    checks = tuple(Check(what, False, "x" * 200) for what in ("code", "parameters", "data", "results", "report"))
    text = note(Facts(this, before, Committed("c" * 40, checks), every, frozenset()), Dashboard(params.tracking, root))
    assert len(text) < LONGEST_TAG
    assert "and 176 more" in text
    assert "and 285 more" in text


@pytest.fixture
def repository(tmp_path: Path) -> tuple[Path, Params]:
    """A reproduction that is committed whole."""
    root, params = tmp_path / "clone", fake_params()
    root.mkdir()
    (root / "params.yaml").write_text(yaml.safe_dump(params.model_dump(mode="json"), sort_keys=False))
    (root / "pipeline").mkdir()
    (root / "pipeline" / "config.py").write_text("a = 1\n")
    write_lock(root, params)
    edit_lock(root, "1" * 32, hashlib.md5(b"a = 1\n").hexdigest())
    write_report(root, params, **{"full.PC": 0.25})
    (root / ".gitignore").write_text("/data/\n/runs/\n")
    git(root, "init", "--quiet")
    commit(root)
    return root, params


def git(root: Path, *arguments: str) -> None:
    subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments], cwd=root, check=True)


def commit(root: Path) -> None:
    git(root, "add", "--all")
    git(root, "commit", "--quiet", "--allow-empty", "--message", "x")


def edit_lock(root: Path, old: str, new: str) -> None:
    lock = root / "dvc.lock"
    text = lock.read_text()
    assert old in text
    lock.write_text(text.replace(old, new))


def test_what_is_committed_whole_is(repository: tuple[Path, Params]) -> None:
    root, params = repository
    found = committed(params, root)
    assert found.answer == "yes"
    assert [check.what for check in found.checks] == ["code", "parameters", "data", "results", "report"]
    (root / "notes.txt").write_text("")
    (root / "pipeline" / "config.py").write_text("a = 2\n")
    assert committed(params, root).answer == "yes", "nothing has run with the edit yet"
    with (root / "dvc.lock").open("a") as stream:
        stream.write("  publish: {cmd: python stages/publish.py}\n")
    assert committed(params, root).answer == "yes", "DVC notes the publishing itself when it is over"


def test_what_is_not_committed_is_named(repository: tuple[Path, Params]) -> None:
    root, params = repository
    with (root / "params.yaml").open("a") as stream:
        stream.write("# edited\n")
    assert committed(params, root).answer == "no: parameters"
    edit_lock(root, "2" * 32, "3" * 32)
    assert committed(params, root).answer == "no: parameters, results"
    (root / "reports" / params.report_name / "new.csv").write_text("a\n")
    assert committed(params, root).answer == "no: parameters, results, report"
    edit_lock(root, "0" * 32, "4" * 32)
    assert committed(params, root).answer == "no: parameters, data, results, report"
    commit(root)
    assert committed(params, root).answer == "yes"


def test_a_commit_with_other_code_than_ran_is_not_it(repository: tuple[Path, Params]) -> None:
    root, params = repository
    (root / "pipeline" / "config.py").write_text("a = 2\n")
    commit(root)
    found = committed(params, root)
    assert found.answer == "no: code"
    assert found.checks[0].looked_at.endswith("not the same: pipeline/config.py")
    git(root, "rm", "--quiet", "pipeline/config.py", "dvc.lock")
    commit(root)
    assert committed(params, root).answer == "no: results", "nothing has run"


def test_without_a_commit_nothing_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))
    assert committed(fake_params(), tmp_path).answer == "unknown: no Git commit"
    git(tmp_path, "init", "--quiet")
    assert committed(fake_params(), tmp_path).answer == "unknown: no Git commit"


@contextmanager
def serve(root: Path, folder: Path) -> Iterator[str]:
    """`mlflow server` over the database of `root`."""
    with closing(socket.socket()) as listener:
        listener.bind(("127.0.0.1", 0))
        port = str(listener.getsockname()[1])
    options = ["--backend-store-uri", local_uri(root), "--host", "127.0.0.1", "--port", port, "--workers", "1"]
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    with (folder / "server.log").open("w") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "mlflow", "server", *options],
            stdout=log,
            stderr=log,
            cwd=folder,
            env=environment,
            start_new_session=True,
        )
    try:
        deadline = time.monotonic() + 300
        while True:
            try:
                with urlopen(f"http://127.0.0.1:{port}/health", timeout=2):
                    break
            except OSError:
                assert time.monotonic() < deadline, "the server did not start"
                time.sleep(0.3)
        yield f"http://127.0.0.1:{port}"
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()


def words(folder: Path, address: str) -> str:
    """What a browser shows at an address."""
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    quiet = [
        "--disable-background-networking",
        "--no-first-run",
        "--window-size=2400,2000",
        "--virtual-time-budget=20000",
    ]
    done = subprocess.run(
        [*command, *quiet, "--dump-dom", address],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
        env={**os.environ, "HOME": str(folder)},
    )
    return " ".join(re.sub(r"<(script|style)\b.*?</\1>|<[^>]+>", " ", done.stdout, flags=re.S).split())


@pytest.mark.skipif(not BROWSER, reason="needs a browser: install chromium")
def test_a_browser_shows_the_answers(published: tuple[Path, Params, Params], tmp_path: Path) -> None:
    root, _, params = published
    _, experiment = client_of(root)
    parent = parents(root)[1]
    with serve(root, tmp_path) as server:
        page = f"{server}/#/experiments/{experiment.experiment_id}/runs"
        variants = words(tmp_path, f"{page}?viewStateShareKey={VARIANTS}")
        assert "Which variant is best?" in variants
        assert all(f"grade@{variant}" in variants for variant in params.plan.variants)
        assert f"grade@{FULL}-swapped" in variants
        assert "accuracy.PC" in variants
        reproductions = words(tmp_path, f"{page}?viewStateShareKey={REPRODUCTIONS}")
        assert "2 parameters, 1 figure" in reproductions
        assert "unknown: no Git" in reproductions
        assert "grade@" not in reproductions
        run = words(tmp_path, f"{page}/{parent.info.run_id}")
        assert re.search(r"Committed\? unknown.*Best variant\? OPD: .*Changed since", run)
