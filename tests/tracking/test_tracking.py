"""Tracking: publishing is idempotent, live logging never costs a training, both share one run."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.request import urlopen

import pytest

from pipeline.params import Params
from pipeline.errors import UserError
from pipeline.tracking import live_run
from pipeline.tracking.publishing import publish
from pipeline.tracking.reproduction import planned_stages, read_lock, reproduction_key
from pipeline.tracking.store import PROCESS, STAGE, Store, local_uri, now
from tests.closure import ROOT
from tests.fake_chain import fake_params, write_chain, write_lock

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

ALIGN = "align@finetuned-all-0"


@pytest.fixture
def chain(tmp_path: Path) -> tuple[Path, Params]:
    """A finished chain in a folder with a space in its name."""
    root, params = tmp_path / "a clone", fake_params()
    write_chain(root, params)
    write_lock(root, params)
    (root / "reports" / params.report_name / "tables").mkdir(parents=True)
    (root / "reports" / params.report_name / "tables" / "understanding.csv").write_text("row,value\n")
    return root, params


def with_tracking(params: Params, **values: object) -> Params:
    return params.model_copy(update={"tracking": params.tracking.model_copy(update=values)})


def runs(root: Path, uri: str = "") -> tuple[MlflowClient, dict[str, Run]]:
    """All runs by stage; fails where a stage has two."""
    from mlflow import MlflowClient

    client = MlflowClient(uri or local_uri(root))
    experiment = client.get_experiment_by_name("octopi")
    found = client.search_runs([experiment.experiment_id], max_results=1000)
    by_stage = {run.data.tags[STAGE]: run for run in found}
    assert len(by_stage) == len(found)
    return client, by_stage


def test_publish_makes_one_parent_and_a_child_a_stage(chain: tuple[Path, Params]) -> None:
    root, params = chain
    summary = publish(params, root)
    client, found = runs(root)
    titles = [stage.title for stage in planned_stages(params.plan)]
    assert summary.created == len(titles) + 1
    assert set(found) == {"", *titles}
    parent = found[""]
    assert all(run.info.status == "FINISHED" for run in found.values())
    assert all(found[t].data.tags["mlflow.parentRunId"] == parent.info.run_id for t in titles)
    assert parent.data.params["encoder.epochs"] == "4"
    assert parent.info.end_time - parent.info.start_time == 9000
    assert [f.path for f in client.list_artifacts(parent.info.run_id, "report")] == ["report/tables"]

    child = found[ALIGN]
    assert child.data.params == {"seed": "0", "frames.size": "64"}
    tags = child.data.tags
    assert (tags["octopi.encoder"], tags["octopi.lora"], tags["octopi.opd"], tags["octopi.seed"]) == (
        "finetuned",
        "without",
        "all",
        "0",
    )
    assert (tags["octopi.scale"], tags["octopi.source"], tags["octopi.split"]) == ("smoke", "scenes", "paper")
    assert tags["octopi.inputs"] == '{"data/videos.parquet": "00000000000000000000000000000000"}'
    assert tags["octopi.restored"] == "false"
    assert child.info.end_time - child.info.start_time == 9000
    assert child.data.metrics["run/seconds"] == 9
    assert len(client.get_metric_history(child.info.run_id, "loss")) == 60
    assert [d.dataset.name for d in child.inputs.dataset_inputs] == ["data/videos.parquet"]
    adapter = client.list_artifacts(found["lora@finetuned-all-0"].info.run_id, "adapter")
    assert "adapter/connector.safetensors" in [f.path for f in adapter]


def test_publishing_again_adds_nothing_and_a_changed_stage_updates_its_run(chain: tuple[Path, Params]) -> None:
    root, params = chain
    first = publish(params, root)
    _, before = runs(root)
    again = publish(params, root)
    assert (again.created, again.updated, again.unchanged) == (0, 0, first.created)
    write_lock(root, params, changed="split")
    (root / "runs" / "split.json").unlink()
    third = publish(params, root)
    assert (third.created, third.updated) == (0, 1)
    client, after = runs(root)
    assert {s: r.info.run_id for s, r in after.items()} == {s: r.info.run_id for s, r in before.items()}
    assert after["split"].data.tags["octopi.restored"] == "true"
    assert "f" * 32 in after["split"].data.tags["octopi.inputs"]
    assert after[""].data.tags["octopi.dvc_lock"] != before[""].data.tags["octopi.dvc_lock"]
    assert len(client.get_metric_history(after[ALIGN].info.run_id, "loss")) == 60


def test_stages_that_have_not_run_are_named(chain: tuple[Path, Params]) -> None:
    root, params = chain
    (root / "dvc.lock").write_text("schema: '2.0'\n")
    summary = publish(params, root)
    assert summary.created == 1
    assert summary.missing == tuple(stage.title for stage in planned_stages(params.plan))
    (root / "dvc.lock").unlink()
    with pytest.raises(UserError, match=r"dvc\.lock: no such file"):
        publish(params, root)


def test_key_changes_with_parameters_code_and_videos_only(chain: tuple[Path, Params]) -> None:
    root, _ = chain
    key = reproduction_key(root)
    (root / "dvc.lock").write_text("")
    (root / "pipeline" / "tracking").mkdir(parents=True)
    (root / "pipeline" / "tracking" / "store.py").write_text("")
    assert reproduction_key(root) == key
    (root / "pipeline" / "frames.py").write_text("")
    changed = {key, reproduction_key(root)}
    for file in ("params.yaml", "dvc.yaml", "data/videos.parquet"):
        with (root / file).open("ab") as stream:
            stream.write(b" ")
        changed.add(reproduction_key(root))
    assert len(changed) == 5


def test_lock_of_foreign_shape(tmp_path: Path) -> None:
    lock = tmp_path / "dvc.lock"
    (tmp_path / "params.yaml").write_text("a: {b: 1, c: [x]}\n")
    lock.write_text("stages: {a: {cmd: x}}")
    assert read_lock(tmp_path)["a"].deps == {}
    lock.write_text("{")
    with pytest.raises(UserError, match="not YAML"):
        read_lock(tmp_path)


def test_entries_made_with_other_parameters_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text("a: {b: 1, c: [x]}\n")
    (tmp_path / "dvc.lock").write_text(
        "stages:\n  same: {params: {params.yaml: {a: {c: [x]}}}}\n  other: {params: {params.yaml: {a.b: 2}}}\n"
    )
    assert set(read_lock(tmp_path)) == {"same"}


def test_live_and_publish_share_one_run(chain: tuple[Path, Params]) -> None:
    root, params = chain
    from pipeline.io import read_table
    from pipeline.records import Measurement

    curve = read_table(root / "data" / "align" / "finetuned-all-0" / "history.parquet", Measurement)
    with live_run(with_tracking(params, live=True, timeout_seconds=60), ALIGN, root) as live:
        for point in curve[:40]:
            live.log(point.step, {point.name: point.value})
    client, found = runs(root)
    assert set(found) == {"", ALIGN}
    assert found[ALIGN].info.status == "FINISHED"
    assert len(client.get_metric_history(found[ALIGN].info.run_id, "loss")) == 40
    publish(params, root)
    _, after = runs(root)
    assert after[ALIGN].info.run_id == found[ALIGN].info.run_id
    history = client.get_metric_history(found[ALIGN].info.run_id, "loss")
    assert [(p.step, p.value) for p in sorted(history, key=lambda p: p.step)] == [(m.step, m.value) for m in curve]


def test_a_failed_training_is_marked(chain: tuple[Path, Params]) -> None:
    root, params = chain
    with (
        pytest.raises(UserError, match="diverged"),
        live_run(with_tracking(params, live=True, timeout_seconds=60), ALIGN, root),
    ):
        raise UserError("diverged")
    assert runs(root)[1][ALIGN].info.status == "FAILED"


def test_runs_of_a_killed_process_are_ended(chain: tuple[Path, Params]) -> None:
    root, params = chain
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    store = Store(params.tracking, root)
    left = store.create("left", {STAGE: "a", PROCESS: f"{socket.gethostname()}:{dead.pid}"}, now())
    mine = store.create("mine", {STAGE: "b", PROCESS: f"{socket.gethostname()}:{os.getpid()}"}, now())
    theirs = store.create("theirs", {STAGE: "c", PROCESS: f"elsewhere:{dead.pid}"}, now())
    assert publish(params, root).killed == 1
    client, _ = runs(root)
    status = [client.get_run(run.run_id).info.status for run in (left, mine, theirs)]
    assert status == ["KILLED", "RUNNING", "RUNNING"]


@contextmanager
def silent_server() -> Iterator[str]:
    """A port that accepts connections and never answers."""
    with closing(socket.socket()) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(16)
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"


@contextmanager
def closed_port() -> Iterator[str]:
    """A port that nobody listens on."""
    with silent_server() as uri:
        pass
    yield uri


@pytest.mark.parametrize("server", [silent_server, closed_port])
def test_a_dead_server_costs_one_warning(
    chain: tuple[Path, Params], server: object, caplog: pytest.LogCaptureFixture
) -> None:
    root, params = chain
    import mlflow  # noqa: F401  (its import is no part of what is timed)

    with server() as uri:  # type: ignore[operator]
        down = with_tracking(params, uri=uri, live=True, timeout_seconds=2)
        started = time.monotonic()
        with live_run(down, ALIGN, root) as live:
            for step in range(1000):
                live.log(step, {"loss": 1.0})
            assert time.monotonic() - started < 1
        assert time.monotonic() - started < 4
        assert publish(down, root).reached is False
        assert time.monotonic() - started < 9
    lines = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING and r.name.startswith("pipeline")]
    assert len(lines) == 2
    assert all(len(line.splitlines()) == 1 for line in lines)


def test_live_logging_switched_off_imports_nothing(chain: tuple[Path, Params]) -> None:
    root, params = chain
    code = (
        "import sys; from pathlib import Path; from pipeline.params import load_params;"
        "from pipeline.tracking import live_run; root = Path(sys.argv[1]); p = load_params(root / 'params.yaml')\n"
        f"with live_run(p, '{ALIGN}', root) as live: live.log(1, {{'loss': 1.0}})\n"
        "assert 'mlflow' not in sys.modules and not (root / 'mlruns').exists()"
    )
    assert params.tracking.live is False
    subprocess.run([sys.executable, "-c", code, str(root)], check=True, cwd=ROOT)
    with pytest.raises(UserError, match="not in the plan"), live_run(params, "align@nonsense", root):
        pass


def test_cold_starts_at_once(chain: tuple[Path, Params]) -> None:
    root, _ = chain
    code = (
        "import sys; from pathlib import Path; from pipeline.params import load_params, TrackingConfig;"
        "from pipeline.tracking.store import Store, now; root = Path(sys.argv[1]); s = Store(TrackingConfig(), root);"
        "s.create(sys.argv[2], {'octopi.stage': sys.argv[2]}, now())"
    )
    started = [subprocess.Popen([sys.executable, "-c", code, str(root), str(i)], cwd=ROOT) for i in range(2)]
    assert [process.wait(120) for process in started] == [0, 0]
    assert set(runs(root)[1]) == {"0", "1"}


def test_real_server_that_dies_midway(
    chain: tuple[Path, Params], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root, params = chain
    with closed_port() as uri:
        port = uri.rsplit(":", 1)[1]
    store = f"sqlite:///{tmp_path / 'server.db'}"
    # The server makes its tables by waiting for the disk hundreds of times; ours are made without.
    Store(with_tracking(params, uri=store).tracking, tmp_path)
    write_lock(root, params, only=(ALIGN, "lora@finetuned-all-0"))
    arguments = ["--backend-store-uri", store, "--artifacts-destination", str(tmp_path / "artifacts"), "--workers", "1"]
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", port, *arguments]
    with (tmp_path / "server.log").open("w") as log:
        environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
        server = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=environment)
    try:
        _wait_for(f"{uri}/health")
        remote = with_tracking(params, uri=uri, live=True, timeout_seconds=5)
        assert (publish(remote, root).created, publish(remote, root).created) == (3, 0)
        with live_run(remote, "lora@finetuned-all-0", root) as live:
            live.log(100, {"loss": 1.0})
            _, found = runs(root, uri)
            deadline = time.monotonic() + 20
            while found["lora@finetuned-all-0"].info.status != "RUNNING" and time.monotonic() < deadline:
                time.sleep(0.2)
                _, found = runs(root, uri)
            os.killpg(server.pid, 9)
            server.wait()
            started = time.monotonic()
            for step in range(101, 200):
                live.log(step, {"loss": 1.0})
        assert time.monotonic() - started < 7
    finally:
        if server.poll() is None:
            os.killpg(server.pid, 9)
            server.wait()
    assert len([r for r in caplog.records if "tracking is off" in r.getMessage()]) == 1


def _wait_for(url: str) -> None:
    deadline = time.monotonic() + 60
    while True:
        try:
            with urlopen(url, timeout=2):
                return
        except OSError:
            assert time.monotonic() < deadline, "the server did not start"
            time.sleep(0.3)
