"""The model in MLflow: logged, registered, loaded where this repository is not, asked, and refused bad input."""

from __future__ import annotations

import ast
import base64
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path
from typing import Any, NamedTuple

import mlflow
import pytest
from mlflow import MlflowClient
from mlflow.pyfunc.scoring_server import init
from starlette.testclient import TestClient

from pipeline.tracking.registry import NEEDED, log_model, packaged, register
from pipeline.use.model import Octopi
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
        mlflow.set_tracking_uri(uri)
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
    inputs = {column["name"]: column for column in info.signature.inputs.to_dict()}
    assert {name: column["type"] for name, column in inputs.items()} == {"question": "string", "videos": "array"}
    assert [column["name"] for column in info.signature.outputs.to_dict()] == ["answer"]
    assert info.metadata["variant"] == made.variant.key
    assert info.metadata["base"]["files"] == json.loads((made.folder / "config.json").read_text())["base"]["files"]
    needs = Path(mlflow.artifacts.download_artifacts(f"{logged.address}/requirements.txt")).read_text().splitlines()
    assert {line.partition("==")[0] for line in needs} == set(NEEDED)
    assert all("==" in line and "+" not in line and "@" not in line for line in needs)
    assert loaded.input_example["question"].tolist()


FRESH = """
import json, sys
import mlflow.pyfunc, pandas as pd
model = mlflow.pyfunc.load_model(sys.argv[1])
rows = json.load(sys.stdin)
said = model.predict(pd.DataFrame(rows, columns=["question", "videos"]))
import pipeline
print(json.dumps({"said": list(said["answer"]), "code": pipeline.__file__, "modules": sorted(sys.modules)}))
"""


def test_a_process_without_this_repository_answers(
    logged: Logged, octopi: Octopi, files: list[Path], tmp_path: Path
) -> None:
    """And what it imported stands among the requirements, or comes with what stands there."""
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    env["MLFLOW_TRACKING_URI"] = logged.client.tracking_uri
    rows = json.dumps([[QUESTIONS[0], [encoded(files[0])]]])
    env["OCTOPI_BASE"] = logged.base
    command = [sys.executable, "-c", FRESH, logged.address]
    done = subprocess.run(command, input=rows, env=env, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["said"] == [octopi.ask(QUESTIONS[0], files[:1])]
    assert "artifacts" in found["code"]
    homes = packages_distributions()
    there = {name.split(".")[0] for name in found["modules"]} & _imported() & homes.keys()
    assert there > {"torch", "av", "transformers", "pydantic"}
    brought = _brought(NEEDED)
    asked = {_plain(home) for name in _imported() for home in homes.get(name, ())}
    # No code imports torchvision, but open_clip's must be of torch's build.
    assert set(map(_plain, NEEDED)) - asked == {"torchvision"}
    unneeded = {"sentencepiece"}  # transformers imports it where it is installed; answering does without
    assert {name for name in there - unneeded if not {_plain(home) for home in homes[name]} & brought} == set()


def _brought(names: Iterable[str]) -> set[str]:
    """What installing these distributions brings, themselves included, without extras."""
    found: set[str] = set()
    waiting = set(map(_plain, names))
    while waiting:
        found.add(name := waiting.pop())
        with suppress(PackageNotFoundError):
            lines = [line for line in requires(name) or () if "extra ==" not in line]
            waiting |= {_plain(re.split(r"[^\w.-]", line)[0]) for line in lines} - found
    return found


def _plain(name: str) -> str:
    return name.lower().replace("_", "-")


def _imported() -> set[str]:
    """Whatever a file of the package imports, at its top or inside a function."""
    files = (Path(__file__).parents[2] / "pipeline").rglob("*.py")
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    return {name.split(".")[0] for name in names} - {"pipeline"}


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
    with monkeypatch.context() as patch:
        patch.setattr(loaded.unwrap_python_model().model, "ask", lambda *_: 1 / 0)
        broken = ask(client, asked[0])
    assert broken.status_code == 500
    assert "row 1: the model broke" in broken.text
    assert "Traceback" not in broken.text
    assert "ZeroDivision" not in broken.text
    assert ask(client, asked[0]).status_code == 200


@pytest.mark.parametrize(
    ("question", "videos", "words"),
    [
        ("{tactile}", ["/etc/passwd"], "row 2: video 1: broken base64"),
        ("{tactile}", [base64.b64encode(b"no video").decode()], "row 2: video 1: no video"),
        ("{tactile} and no video", [], "row 2: the question has 1 {tactile} for 0 videos"),
        (None, [], "row 2: its question is no text of at most 20000 characters"),
        ("a" * 20_001, [], "row 2: its question is no text of at most 20000 characters"),
    ],
)
def test_bad_rows_are_400(client: TestClient, files: list[Path], question: Any, videos: list[str], words: str) -> None:
    good = {"question": QUESTIONS[0], "videos": [encoded(files[0])]}
    bad = ask(client, good, {"question": question, "videos": videos})
    assert bad.status_code == 400
    assert words in bad.text
    assert "Traceback" not in bad.text
    assert "octopi-" not in bad.text, "the folder of the videos"


def test_bad_tables_are_400(client: TestClient) -> None:
    for rows, words in (([{"question": "a", "videos": []}] * 65, "at most 64"), ([{"question": "a"}], "videos")):
        bad = ask(client, *rows)
        assert bad.status_code == 400
        assert words in bad.text


def test_a_folder_counts_when_it_is_whole(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert packaged(made.variant) is None
    folder = Path("models") / made.variant.key
    folder.mkdir(parents=True)
    assert packaged(made.variant) is None
    (folder / "config.json").write_text("{}")
    assert packaged(made.variant) == folder
