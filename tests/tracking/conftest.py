"""A finished chain, made up: two variants, the files that tracking reads, and a database that is there already."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from pipeline.config import Params, TrackingConfig
from pipeline.core.io import write_json, write_table
from pipeline.core.records import Measurement
from pipeline.scales import compose, write_params
from pipeline.tracking.publish import PLUMBING, publish
from pipeline.tracking.store import Store, out_of_reach
from tests.closure import ROOT

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Run

SYSTEM = "{encoder: '${ablation.encoders}', opd: '${ablation.opd}', seed: '${ablation.seeds}'}"
CHAIN = f"""
stages:
  split: {{cmd: x}}
  align: {{cmd: x, matrix: {SYSTEM}}}
  lora: {{cmd: x, matrix: {SYSTEM}}}
  answer: {{cmd: x, matrix: {{encoder: '${{ablation.encoders}}', lora: '${{ablation.lora}}',
    opd: '${{ablation.opd}}', seed: '${{ablation.seeds}}'}}}}
  grade: {{cmd: x}}
  publish: {{cmd: x}}
"""
FULL, BASE = "finetuned-with-all-0", "base-with-all-0"
TITLES = ["split", "align@finetuned-all-0", "align@base-all-0", "lora@finetuned-all-0", "lora@base-all-0"]
TITLES += [f"answer@{FULL}", f"answer@{BASE}", "grade"]
FIRST = datetime(2024, 5, 1, 10, tzinfo=UTC)
SECONDS = 9
HEADER = "task,measure,encoder,lora,opd,touch,seed,n,right,unread,accuracy,low,high,chance\n"
SCORES = """\
PC,choice,finetuned,with,all,real,0,12,6,0,0.5,0.25,0.75,0.3
PC,choice,finetuned,with,all,real,all,12,7,0,0.6,0.3,0.8,0.3
PC,choice,finetuned,with,all,swapped,0,12,4,0,0.333333,0.1,0.6,0.3
PC,choice,base,with,all,real,0,12,3,0,0.25,0.1,0.5,0.3
OPD,combined,finetuned,with,all,real,0,8,1,0,0.125,,,0.1
OPD,hardness,finetuned,with,all,real,0,8,4,0,0.5,0.2,0.8,0.3
TOY,choice,finetuned,with,all,real,0,4,3,0,0.75,0.5,1,0.5
heads,combined,finetuned,,,real,0,12,6,0,0.9,0.8,1,0.1
"""


@dataclass
class FakeChain:
    """A reproduction in the working directory."""

    params: Params
    folder: Path

    def copy(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeChain]:
        shutil.copytree(self.folder, folder)
        monkeypatch.chdir(folder)
        out_of_reach.clear()
        yield FakeChain(self.params, folder)
        out_of_reach.clear()

    def write(self) -> None:
        write_params(self.params)
        Path("dvc.yaml").write_text(CHAIN)
        for title in TITLES:
            if title.startswith(("align", "lora")):
                curve = [Measurement(step=s, name="loss", value=1 / s) for s in range(1, 121)]
                write_table(Path(out(title)) / "history.parquet", Measurement, curve)
                (Path(out(title)) / "connector.safetensors").write_bytes(b"weights")
            if title.startswith("answer"):
                Path(out(title)).mkdir(parents=True)
                (Path(out(title)) / "real.jsonl").write_text("{}\n")
        Path("data/encoder/0").mkdir(parents=True)
        Path("data/encoder/0/encoder.safetensors").write_bytes(b"prompts")
        self.ran(TITLES, 0)
        self.report()

    def ran(self, titles: Sequence[str], minutes: float, mark: str = "1") -> None:
        """Stages ran one after the other, `minutes` after the first; `mark` stands for the hash of what they made."""
        path = Path("dvc.lock")
        lock = yaml.safe_load(path.read_text()) if path.is_file() else {"schema": "2.0", "stages": {}}
        for index, title in enumerate(titles):
            begin = FIRST + timedelta(minutes=minutes, seconds=index * (SECONDS + 1))
            times = {"started": begin.isoformat(), "ended": (begin + timedelta(seconds=SECONDS)).isoformat()}
            cost = {"startup_seconds": 1.5, "seconds": float(SECONDS), "peak_memory_mb": 100.0, "device": "a card"}
            made = {"metrics": {"loss": 1.0, "answers": 5}, "outs": {out(title): mark * 32}}
            write_json(Path("runs") / f"{title}.json", {**times, **cost, **made})
            lock["stages"][title] = {
                "cmd": f"python {title}",
                "params": {"params.yaml": {"seed": 0, "frames": {"pixels": 64}}},
                "outs": [{"path": out(title), "md5": mark * 32}],
            }
        path.write_text(yaml.safe_dump(lock))

    def report(self, rows: str = SCORES) -> None:
        """Write the report with these rows of scores.csv."""
        folder = Path("reports") / self.params.report_name
        metrics = {"full": {"PC": 0.5}, "encoder.combined": 0.25, "octopi-small, adapted by 5_PC": 0.4}
        write_json(folder / "metrics.json", metrics)
        (folder / "scores.csv").write_text(HEADER + rows)
        (folder / "README.md").write_text("# Report\n")


def out(title: str) -> str:
    name, _, key = title.partition("@")
    folders = {"align": "data/models/without", "lora": "data/models/with", "answer": "data/answers"}
    return f"{folders[name]}/{key}" if key else f"data/{name}"


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FakeChain:
    """The folder of a chain of which each stage ran once, and an empty database; it is copied, not used."""
    folder = tmp_path_factory.mktemp("finished")
    overrides = ("ablation.lora=[with]", "ablation.opd=[all]", "tracking.timeout_seconds=3")
    fake = FakeChain(compose("smoke", overrides, conf=ROOT / "conf"), folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        fake.write()
        Store(TrackingConfig())
    return fake


@pytest.fixture
def chain(finished: FakeChain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeChain]:
    """The finished chain as the working directory."""
    yield from finished.copy(tmp_path / "a clone", monkeypatch)


@pytest.fixture(scope="session")
def published(finished: FakeChain, tmp_path_factory: pytest.TempPathFactory) -> FakeChain:
    """The finished chain after publishing; it is copied, not used."""
    folder = tmp_path_factory.mktemp("published") / "a clone"
    with pytest.MonkeyPatch.context() as patch:
        for chain in finished.copy(folder, patch):
            commit = "git init -q && git -c user.name=a -c user.email=a@b commit -q --allow-empty -m a"
            subprocess.run(commit, shell=True, check=True)
            publish(chain.params)
    return FakeChain(finished.params, folder)


@pytest.fixture
def again(published: FakeChain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeChain]:
    """The published chain, moved, as the working directory."""
    yield from published.copy(tmp_path / "moved", monkeypatch)


def client(uri: str = "") -> MlflowClient:
    from mlflow import MlflowClient

    return MlflowClient(uri or f"sqlite:///{Path('mlruns/mlflow.db').resolve()}")


def runs(kind: str = "", uri: str = "") -> list[Run]:
    """All runs of a kind, in the order they began."""
    there = client(uri)
    query = f"tags.`octopi.kind` = '{kind}'" if kind else ""
    experiment = there.get_experiment_by_name("octopi").experiment_id
    return list(there.search_runs([experiment], query, order_by=["attributes.start_time ASC"], max_results=500))


def by_name(kind: str) -> dict[str, Any]:
    """Runs of a kind by their names, without what is said of random models; fails where two have one name."""
    found = runs(kind)
    assert len({run.info.run_name for run in found}) == len(found)
    return {run.info.run_name.removesuffix(PLUMBING): run for run in found}


def losses(run: Run) -> list[Metric]:
    return list(client().get_metric_history(run.info.run_id, "loss"))


def seconds(run: Run) -> float:
    return (run.info.end_time - run.info.start_time) / 1000
