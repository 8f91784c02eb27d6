"""The model in MLflow: logged, registered, loaded where this repository is not, asked, and refused bad input."""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import mlflow
import pytest
from mlflow import MlflowClient
from mlflow.pyfunc.scoring_server import init
from starlette.testclient import TestClient

from pipeline.tracking.registry import log_model, register
from pipeline.use.model import Octopi
from tests.closure import ROOT
from tests.use.shared import Made


class Logged(NamedTuple):
    client: MlflowClient
    run: str
    address: str
    base: str


@pytest.fixture(scope="module")
def logged(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Any:
    before = mlflow.get_tracking_uri()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("mlflow"))
        uri = f"sqlite:///{Path('mlflow.db').resolve()}"
        client = MlflowClient(uri)
        experiment = client.create_experiment("octopi", artifact_location=Path("artifacts").resolve().as_posix())
        run = client.create_run(experiment).info.run_id
        log_model(client, run, made.params, made.variant, made.folder)
        address = register(client, made.params, [(made.variant, run)])
        yield Logged(client, run, address, str(made.folder.parents[1] / "llama"))
    mlflow.set_tracking_uri(before)


@pytest.fixture(scope="module")
def loaded(logged: Logged) -> Any:
    return mlflow.pyfunc.load_model(logged.address, model_config={"base": logged.base, "device": "cpu"})


def encoded(file: Path) -> str:
    return base64.b64encode(file.read_bytes()).decode()


QUESTIONS = ("How hard is it? {tactile}", "Which is softer, {tactile} or {tactile}?", "What can you feel in {tactile}?")


def test_what_is_logged_says_what_it_is(logged: Logged, loaded: Any, made: Made) -> None:
    info = mlflow.models.get_model_info(logged.address)
    inputs = {column["name"]: column["type"] for column in info.signature.inputs.to_dict()}
    assert inputs == {"question": "string", "videos": "array"}
    assert [column["name"] for column in info.signature.outputs.to_dict()] == ["answer"]
    assert info.metadata["variant"] == made.variant.key
    assert info.metadata["base"]["files"] == json.loads((made.folder / "config.json").read_text())["base"]["files"]
    needs = Path(mlflow.artifacts.download_artifacts(f"{logged.address}/requirements.txt")).read_text().splitlines()
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert {line.partition("==")[0] for line in needs} == {re.split(r"[^\w.-]", line)[0] for line in declared}


FRESH = """
import json, sys
import mlflow.pyfunc, pandas as pd
rows = pd.DataFrame(json.load(sys.stdin), columns=["question", "videos"])
said = mlflow.pyfunc.load_model(sys.argv[1]).predict(rows)
import pipeline
print(json.dumps({"said": list(said["answer"]), "code": pipeline.__file__}))
"""


def test_a_process_without_this_repository_answers(
    logged: Logged, octopi: Octopi, files: list[Path], tmp_path: Path
) -> None:
    env = {**os.environ, "MLFLOW_TRACKING_URI": logged.client.tracking_uri, "OCTOPI_BASE": logged.base}
    env.pop("PYTHONPATH", None)
    rows = json.dumps([[QUESTIONS[0], [encoded(files[0])]]])
    command = [sys.executable, "-c", FRESH, logged.address]
    done = subprocess.run(command, input=rows, env=env, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["said"] == [octopi.ask(QUESTIONS[0], files[:1])]
    assert "artifacts" in found["code"]


@pytest.fixture(scope="module")
def client(loaded: Any) -> TestClient:
    """As `mlflow models serve` answers."""
    return TestClient(init(loaded), raise_server_exceptions=False)


def ask(client: TestClient, *rows: dict[str, Any]) -> Any:
    return client.post("/invocations", json={"dataframe_records": rows})


def test_over_http_answers_are_those_of_the_library(
    client: TestClient, loaded: Any, octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    used = list(zip(QUESTIONS, (files[:1], files[1:], files[:1]), strict=True))
    asked = [{"question": q, "videos": [encoded(f) for f in of]} for q, of in used]
    answers = ask(client, *asked)
    assert answers.json() == {"predictions": [{"answer": octopi.ask(q, of)} for q, of in used]}
    monkeypatch.setattr(loaded.unwrap_python_model().model, "ask", lambda *_: 1 / 0)
    broken = ask(client, asked[0])
    assert broken.status_code == 500
    assert "row 1: the model broke" in broken.text
    assert not re.search("Traceback|ZeroDivision", broken.text)


def test_bad_rows_and_tables_are_400(client: TestClient, files: list[Path]) -> None:
    good = {"question": QUESTIONS[0], "videos": [encoded(files[0])]}
    for rows, words in (
        ([good, {"question": "{tactile}", "videos": ["/etc/passwd"]}], "row 2: video 1: broken base64"),
        ([good, {"question": "{tactile}", "videos": ["bm8gdmlkZW8="]}], "row 2: video 1: no video"),
        ([{"question": "{tactile}?", "videos": []}], "row 1: the question has 1 {tactile} for 0 videos"),
        ([{"question": None, "videos": []}], "row 1: its question is no text of at most 20000 characters"),
        ([{"question": "a" * 20_001, "videos": []}], "row 1: its question is no text of at most 20000 characters"),
        ([{"question": "a", "videos": []}] * 65, "at most 64"),
        ([{"question": "a"}], "videos"),
    ):
        bad = ask(client, *rows)
        assert bad.status_code == 400
        assert words in bad.text
        assert not re.search("Traceback|octopi-", bad.text), "nor the folder of the videos"
