"""Trainings that log while they run: their curves, their ends, and that nothing which tracking does reaches them."""

import inspect
import multiprocessing
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import mlflow
import pytest
import torch
from mlflow.environment_variables import _EnvironmentVariable
from mlflow.tracking import fluent
from torch import nn
from torch.nn import functional as F
from transformers.integrations import MLflowCallback

from pipeline.config import Params
from pipeline.core.io import write_table
from pipeline.core.records import Measurement
from pipeline.running.stage import Stage
from pipeline.scales import write_params
from pipeline.tracking import live as live_module
from pipeline.tracking.chain import settings
from pipeline.tracking.live import live
from pipeline.tracking.publish import publish
from pipeline.tracking.store import TrackingError, out_of_reach
from pipeline.training.trainer import TrainableTrainer, Trained, train, training_arguments
from tests.conftest import HUNG, wait_for
from tests.project import ENVIRONMENT
from tests.tracking.conftest import FIRST, FULL, FakeChain, by_name, client, losses, runs

ALIGN = "align@finetuned-all-0"
STEPS = 6


def watched(params: Params, **values: object) -> Params:
    return params.model_copy(update={"tracking": params.tracking.model_copy(update={"live": True, **values})})


class Line(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(2, 1)

    def forward(self, inputs: torch.Tensor, labels: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"loss": F.mse_loss(self.layer(inputs)[:, 0], labels)}


def fit(params: Params, callbacks: Sequence[Any]) -> Trained:
    torch.manual_seed(0)
    data = [{"inputs": torch.tensor([i, 1.0]), "labels": torch.tensor(2.0 * i)} for i in range(8)]
    arguments = training_arguments(Path("fit"), params.runtime, 0, params.pretrain, max_steps=STEPS, logging_steps=1)
    return train(TrainableTrainer(model=Line(), args=arguments, train_dataset=data, callbacks=callbacks))


@pytest.mark.parametrize("broken", [False, True], ids=["whole", "the server was away at the end"])
def test_a_training_and_publishing_share_a_run(chain: FakeChain, monkeypatch: pytest.MonkeyPatch, broken: bool) -> None:
    """What a live run lacks of its curve, publishing adds."""
    log_batch = mlflow.MlflowClient.log_batch

    def breaks_off(self: Any, run_id: str, metrics: Sequence[Any] = (), *rest: Any, **more: Any) -> None:
        if broken and any(m.key == "loss" and m.step > 3 for m in metrics):
            raise OSError("gone")
        log_batch(self, run_id, metrics, *rest, **more)

    stage = Stage(ALIGN, watched(chain.params))
    with monkeypatch.context() as patch:
        patch.setattr(mlflow.MlflowClient, "log_batch", breaks_off)
        patch.setenv("MLFLOW_SYSTEM_METRICS_SAMPLING_INTERVAL", "0.05")
        with live(stage) as callbacks:
            assert by_name("stage")[ALIGN].info.status == "RUNNING"
            trained = fit(chain.params, callbacks)
            wait_for(lambda: any(m.startswith("system/") for m in by_name("stage")[ALIGN].data.metrics))
    run, (parent,) = by_name("stage")[ALIGN], runs("reproduction")
    assert (run.info.status, parent.info.status) == ("RUNNING" if broken else "FINISHED", "RUNNING")
    assert run.info.start_time == int(stage.started * 1000)
    logged = {name for name in run.data.metrics if not name.startswith("system/")}
    assert logged == {m.name for m in trained.history if not broken or m.step <= 3}
    # What a person sets and the stage's axes: not the Trainer's hundred arguments.
    assert run.data.params.keys() == {*settings(chain.params), "encoder", "opd", "seed"}

    # The stage began a second earlier than its run, which is the one that began within.
    chain.ran([ALIGN], minutes=(stage.started - 1 - FIRST.timestamp()) / 60)
    write_table(Path("data/models/without/finetuned-all-0/history.parquet"), Measurement, trained.history)
    out_of_reach.clear()
    publish(chain.params)
    complete = by_name("stage")[ALIGN]
    assert complete.info.run_id == run.info.run_id
    assert complete.data.metrics["system/peak_memory_mb"] == 100
    curve = [(m.step, m.value) for m in trained.history if m.name == "loss"]
    assert sorted((m.step, m.value) for m in losses(complete)) == curve
    (again,) = runs("reproduction")
    assert again.info.run_id == parent.info.run_id
    assert {again.info.status, complete.info.status} == {"FINISHED"}


def test_a_curve_stands_in_its_run_whatever_the_shell_says(chain: FakeChain, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every variable that MLflow's fluent calls or transformers' callback for MLflow read, by their source."""
    names = set(re.findall(r'os\.getenv\("(\w+)"', inspect.getsource(MLflowCallback)))
    names |= {found.name for found in vars(fluent).values() if isinstance(found, _EnvironmentVariable)}
    for name in sorted({*names, "MLFLOW_REGISTRY_URI", "MLFLOW_ENABLE_ASYNC_LOGGING"}):
        monkeypatch.setenv(name, STRAY.get(name, "1" if "URI" not in name else "sqlite:///stray.db"))
    fluent._ACTIVE_MODEL_CONTEXT.reset()  # As where MLflow is imported only now.
    with live(Stage(ALIGN, watched(chain.params))) as callbacks:
        fit(chain.params, callbacks)
    assert sorted(run.info.run_name for run in runs()) == sorted([ALIGN, chain.params.report_name])
    run = by_name("stage")[ALIGN]
    assert len(losses(run)) == STEPS
    assert run.data.params.keys() == {*settings(chain.params), "encoder", "opd", "seed"}
    assert "stray" not in run.data.tags
    assert client().list_artifacts(run.info.run_id) == []
    assert {e.name for e in client().search_experiments()} == {"Default", "octopi"}
    assert not Path("stray.db").exists()


STRAY = {"MLFLOW_ACTIVE_MODEL_ID": "m-" + "0" * 32, "MLFLOW_RUN_ID": "0" * 32, "MLFLOW_TAGS": '{"stray": "1"}'}


@pytest.mark.parametrize(("error", "status"), [(RuntimeError, "FAILED"), (KeyboardInterrupt, "KILLED")])
def test_how_a_training_ended(chain: FakeChain, error: type[BaseException], status: str) -> None:
    with pytest.raises(error), live(Stage(ALIGN, watched(chain.params))):
        raise error
    assert by_name("stage")[ALIGN].info.status == status


def test_four_killed_cold_starts_and_the_next_attempt(chain: FakeChain) -> None:
    """Four trainings start at once without a database and are killed; one is tried again."""
    shutil.rmtree("mlruns")
    names = [f"{stage}@{key}" for stage in ("align", "lora") for key in ("finetuned-all-0", "base-all-0")]

    def killed_at_once(name: str) -> None:
        with live(Stage(name, watched(chain.params))) as callbacks:
            os._exit(9 if callbacks else 1)

    # Forked, so that MLflow is imported already and they really meet.
    started = [multiprocessing.get_context("fork").Process(target=killed_at_once, args=(name,)) for name in names]
    for process in started:
        process.start()
    for process in started:
        process.join(HUNG)
    assert [process.exitcode for process in started] == [9] * 4
    killed = by_name("stage")
    assert {name: run.info.status for name, run in killed.items()} == dict.fromkeys(names, "RUNNING")
    assert len(runs("reproduction")) == 1
    with live(Stage(ALIGN, watched(chain.params))):
        pass
    assert client().get_run(killed[ALIGN].info.run_id).info.status == "KILLED"
    assert sorted(run.info.status for run in runs("stage")) == ["FINISHED", "KILLED", *["RUNNING"] * 3]
    assert len(runs("reproduction")) == 1


def test_an_unfinished_reproduction_of_another_scale_ends(chain: FakeChain) -> None:
    with live(Stage(ALIGN, watched(chain.params).model_copy(update={"scale": "other"}))):
        pass
    publish(chain.params)
    assert {r.info.run_name: r.info.status for r in runs("reproduction")} == {
        "other-scenes": "KILLED",
        chain.params.report_name: "FINISHED",
    }


@pytest.mark.parametrize(("on", "rank"), [(False, "0"), (True, "1")])
def test_mlflow_is_not_imported_without_logging_or_in_a_second_process(chain: FakeChain, on: bool, rank: str) -> None:
    shutil.rmtree("mlruns")
    write_params(watched(chain.params, live=on))
    code = (
        "import sys; from pipeline.config.params import load_params; from pipeline.running.stage import Stage\n"
        f"from pipeline.tracking.live import live\nwith live(Stage('{ALIGN}', load_params())) as callbacks: pass\n"
        "assert callbacks == [] and 'mlflow' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env={**ENVIRONMENT, "RANK": rank})
    assert not Path("mlruns").exists()


@contextmanager
def silent_server() -> Iterator[str]:
    """Accepts connections and never answers."""
    with closing(socket.socket()) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(16)
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"


@contextmanager
def broken_database() -> Iterator[str]:
    Path("mlruns/mlflow.db").write_bytes(b"garbage " * 1000)
    yield ""


@contextmanager
def refusing_server() -> Iterator[str]:
    """Asks for a password."""

    class Refusal(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(401)

    with ThreadingHTTPServer(("127.0.0.1", 0), Refusal) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://ada:S3cret@127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize(
    ("dead", "cause"),
    [
        (silent_server, r"http://127\.0\.0\.1:\d+: TimeoutError: timed out"),
        (refusing_server, r"http://\*\*\*@127.*401.*MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD"),
        (broken_database, r"mlflow\.db: .*file is not a database"),
    ],
)
def test_out_of_reach_costs_one_warning_and_one_call(
    chain: FakeChain, dead: Any, cause: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    untracked = fit(chain.params, [])
    monkeypatch.setattr("mlflow.store.db.utils.time.sleep", lambda _: pytest.fail("opens the database again"))
    with dead() as uri:
        params = watched(chain.params, uri=uri)
        with live(Stage(ALIGN, params)) as callbacks:
            trained = fit(params, callbacks)
        monkeypatch.setattr(live_module, "Store", lambda _: pytest.fail("calls again"))
        with live(Stage("lora@finetuned-all-0", params)) as callbacks:
            assert callbacks == []
        monkeypatch.undo()
        monkeypatch.chdir(chain.folder)
        with pytest.raises(TrackingError, match="octopi publish` tries again") as refused:
            publish(params)
    assert (os.environ["MLFLOW_HTTP_REQUEST_MAX_RETRIES"], os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"]) == ("0", "1")
    assert trained.history == untracked.history
    assert all(torch.equal(trained.state[name], value) for name, value in untracked.state.items())
    (warning,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert warning.startswith("tracking is off")
    for line in (warning, str(refused.value)):
        assert re.search(cause, line)
        assert len(line.splitlines()) == 1
        assert "S3cret" not in line


def test_a_server_that_dies_meanwhile(chain: FakeChain, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Path("mlruns").rename(tmp_path / "server")
    store = ["--backend-store-uri", f"sqlite:///{tmp_path / 'server' / 'mlflow.db'}"]
    place = ["--host", "127.0.0.1", "--port", "0", "--workers", "1"]
    command = [sys.executable, "-m", "mlflow", "server", *place, *store]
    command += ["--artifacts-destination", str(tmp_path / "artifacts")]
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    with (tmp_path / "server.log").open("w") as log:
        server = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=environment)
    try:
        # At a port that it chose itself, as soon as it says so.
        wait_for(lambda: " running on http" in (tmp_path / "server.log").read_text())
        (uri,) = re.findall(r"running on (http://\S+)", (tmp_path / "server.log").read_text())[:1]
        params = watched(chain.params, uri=uri, experiment="remote", timeout_seconds=int(HUNG))
        publish(params)
        assert "nothing new" in publish(params)
        there = client(uri)
        experiment = there.get_experiment_by_name("remote").experiment_id
        (variant,) = there.search_runs([experiment], f"tags.`octopi.variant` = '{FULL}'")
        assert {a.path for a in there.list_artifacts(variant.info.run_id, "encoder")} == {"encoder/encoder.safetensors"}
        with live(Stage(ALIGN, params)) as callbacks:
            assert len(callbacks) == 1
            os.killpg(server.pid, signal.SIGKILL)
            server.wait()
            trained = fit(params, callbacks)
    finally:
        if server.poll() is None:
            os.killpg(server.pid, signal.SIGKILL)
            server.wait()
    assert trained.history == fit(params, []).history
    assert [r.levelname for r in caplog.records].count("WARNING") == 1
