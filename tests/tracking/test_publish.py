"""Publishing: what stands in MLflow after a reproduction, and after a second one."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import mlflow
import pytest
import yaml
from typer.testing import CliRunner

from pipeline.config import TrackingConfig
from pipeline.core.io import write_table
from pipeline.evaluation.records import Graded
from pipeline.scales import write_params
from pipeline.tracking.chain import accuracies, read_stages
from pipeline.tracking.publish import PLUMBING, publish
from pipeline.tracking.store import TrackingError
from tests.closure import ROOT
from tests.conftest import refused
from tests.fake_run import fake_params
from tests.project import ENVIRONMENT
from tests.tracking.conftest import (
    BASE,
    CHAIN,
    FIRST,
    FULL,
    HEADER,
    SCORES,
    SECONDS,
    TITLES,
    FakeChain,
    by_name,
    client,
    losses,
    runs,
    seconds,
)


def test_a_reproduction_has_its_report_parameters_and_a_child_a_stage_and_a_variant(again: FakeChain) -> None:
    (parent,) = runs("reproduction")
    stages, variants = by_name("stage"), by_name("variant")
    assert (set(stages), set(variants)) == (set(TITLES), {FULL, BASE})
    assert {run.info.status for run in runs()} == {"FINISHED"}
    assert {r.data.tags["mlflow.parentRunId"] for r in (*stages.values(), *variants.values())} == {parent.info.run_id}
    assert parent.info.start_time == FIRST.timestamp() * 1000
    assert seconds(parent) == len(TITLES) * (SECONDS + 1) - 1
    assert {seconds(run) for run in stages.values()} == {SECONDS}
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    assert parent.data.tags["mlflow.source.git.commit"] == commit
    assert parent.data.metrics == {
        "full.PC": 0.5, "encoder.combined": 0.25, "octopi-small: adapted by 5_PC": 0.4
    }  # fmt: skip
    values = yaml.safe_load(Path("params.yaml").read_text())
    assert json.loads(parent.data.params["ablation.encoders"]) == values["ablation"]["encoders"]
    written = {a.path for a in client().list_artifacts(parent.info.run_id, "report")}
    assert written == {"report/README.md", "report/metrics.json", "report/scores.csv"}


def test_a_stage_has_its_axes_metrics_cost_and_curve(again: FakeChain) -> None:
    stages = by_name("stage")
    answered, trained = stages["answer@base-with-all-0"], stages["lora@finetuned-all-0"]
    cost = {"system/seconds": SECONDS, "system/startup_seconds": 1.5, "system/peak_memory_mb": 100}
    assert answered.data.metrics == {"loss": 1.0, "answers": 5} | cost
    assert [answered.data.params[a] for a in ("encoder", "lora", "opd", "seed")] == ["base", "with", "all", "0"]
    assert answered.data.params["encoder.epochs"] == "4"
    history = losses(trained)
    assert sorted((m.step, m.value) for m in history) == [(s, 1 / s) for s in range(1, 121)]
    assert all(trained.info.start_time <= m.timestamp <= trained.info.end_time for m in history)


def test_a_variant_has_factors_accuracies_and_what_it_is_made_of(again: FakeChain) -> None:
    run, base = by_name("variant")[FULL], by_name("variant")[BASE]
    assert list(run.data.params)[:4] == ["encoder", "lora", "opd", "seed"]
    assert run.data.params["lora.rank"] == "8"
    choice = {"PC": 0.5, "low/PC": 0.25, "high/PC": 0.75, "swapped/PC": 0.3333}
    hardness = {"OPD.hardness": 0.5, "low/OPD.hardness": 0.2, "high/OPD.hardness": 0.8}
    toy = {"TOY": 0.75, "low/TOY": 0.5, "high/TOY": 1}
    assert run.data.metrics == {"OPD": 0.125} | choice | hardness | toy
    artifacts = {a.path for a in client().list_artifacts(run.info.run_id)}
    assert artifacts == {"predictions", "model", "alignment", "encoder"}
    assert "encoder" not in {a.path for a in client().list_artifacts(base.info.run_id)}
    # Relative, so that the folder may be moved, as this one was.
    assert not run.info.artifact_uri.startswith(("/", "file:"))
    (weights,) = client().list_artifacts(run.info.run_id, "encoder")
    copy = mlflow.artifacts.download_artifacts(f"{run.info.artifact_uri}/{weights.path}")
    assert Path(copy).read_bytes() == b"prompts"


def test_a_new_task_is_a_column_by_itself(again: FakeChain) -> None:
    experiment = client().get_experiment_by_name("octopi")
    view = json.loads(experiment.tags["mlflow.sharedViewState.variants"])
    tasks = ["metrics.`OPD`", "metrics.`PC`", "metrics.`TOY`"]
    # Of the parameters only the factors differ.
    assert view["selectedColumns"] == [*tasks, *(f"params.`{a}`" for a in ("encoder", "lora", "opd", "seed"))]
    found = client().search_runs([experiment.experiment_id], view["searchFilter"])
    assert {run.info.run_name.removesuffix(PLUMBING) for run in found} == {FULL, BASE}
    stages = json.loads(experiment.tags["mlflow.sharedViewState.stages"])
    assert stages["selectedColumns"] == ["metrics.`system/seconds`", "metrics.`system/peak_memory_mb`"]
    found = client().search_runs([experiment.experiment_id], stages["searchFilter"])
    costs = {"system/seconds", "system/peak_memory_mb"}
    assert {run.info.run_name for run in found if costs <= set(run.data.metrics)} == set(TITLES)


def test_a_run_of_a_fold_has_that_folds_accuracies(chain: FakeChain) -> None:
    """The report pools folds, so that its rows are of no single model."""
    params = fake_params("split.name=kfold", "split.folds=3", "ablation.seeds=[0,1]")
    score = {"task": "PC", "measure": "choice", "parsed": True, "truncated": False, "expected": "a", "predicted": "a"}
    score |= {"encoder": "finetuned", "lora": "with", "opd": "all", "seed": 0, "touch": "real"}
    rows = [
        Graded(question_id=f"{seed}-{i}", correct=i < right, objects=(f"o{i}",), trained=seed, **score)
        for seed, right in ((0, 1), (1, 3))
        for i in range(4)
    ]
    write_table(Path("data/graded.parquet"), Graded, rows)
    found = {key: metrics["PC"] for key, metrics in accuracies(params).items()}
    assert found == {FULL: 0.25, "finetuned-with-all-1": 0.75}


def test_a_second_time_adds_nothing(again: FakeChain) -> None:
    before = hashlib.sha256(Path("mlruns/mlflow.db").read_bytes()).hexdigest()
    assert "nothing new" in publish(again.params)
    assert hashlib.sha256(Path("mlruns/mlflow.db").read_bytes()).hexdigest() == before


@pytest.mark.parametrize(
    ("anew", "scores", "variant"),
    [
        (["lora@base-all-0", f"answer@{BASE}", "grade"], SCORES, BASE),
        (["grade"], SCORES.replace("0,12,6,0,0.5,", "0,12,7,0,0.5833,"), FULL),
    ],
)
def test_only_what_is_new_makes_runs(again: FakeChain, anew: list[str], scores: str, variant: str) -> None:
    first, variants = runs("reproduction")[0], by_name("variant")
    (other,) = {FULL, BASE} - {variant}
    again.report(scores)
    again.ran(anew, minutes=60, mark="2")
    publish(again.params)
    parent = runs("reproduction")[1]
    children = [run for run in runs() if run.data.tags.get("mlflow.parentRunId") == parent.info.run_id]
    assert {run.info.run_name.removesuffix(PLUMBING) for run in children} == {*anew, variant}
    assert parent.data.tags[f"variant.{other}"] == variants[other].info.run_id
    assert f"variant.{variant}" not in parent.data.tags
    assert client().get_run(first.info.run_id).data.tags == first.data.tags


def test_going_back_to_results_that_stand_there_adds_nothing(again: FakeChain) -> None:
    lock = Path("dvc.lock").read_bytes()
    again.ran(TITLES, minutes=60, mark="2")
    publish(again.params)
    count = len(runs())
    Path("dvc.lock").write_bytes(lock)
    assert runs("reproduction")[0].info.run_id in publish(again.params)
    again.ran(["grade"], minutes=120, mark="3")
    publish(again.params)
    assert len(runs()) == count + 2


def test_reports_of_other_chains_are_finished_runs_above_a_test_of_the_plumbing(chain: FakeChain) -> None:
    """As a clone has them: scores, parameters of an older version, where the models came from."""
    other = Path("reports/real-videos")
    other.mkdir()
    (other / "params.yaml").write_text("scale: small\nframes: {old: 3}\n")
    (other / "provenance.json").write_text("{}")
    shipped = "PC,choice,octopi-small,,all,touch,all,40,30,0,0.75,0.6,0.85,0.3\n"
    unlike = shipped.replace("touch", "classes") + "heads,combined,finetuned,,,real,all,12,6,0,0.9,0.8,1,0.1\n"
    (other / "scores.csv").write_text(HEADER + SCORES + shipped + unlike)
    publish(chain.params)
    found = {run.info.run_name: run for run in runs("variant")}
    mine, full = {f"{name}{PLUMBING}" for name in (FULL, BASE)}, found["real-videos: finetuned-with-all"]
    assert set(found) - mine == {"real-videos: finetuned-with-all", "real-videos: octopi-small"}
    assert full.data.metrics == {"PC": 0.6, "low/PC": 0.3, "high/PC": 0.8}, "folds and seeds pooled"
    assert full.data.params == {"encoder": "finetuned", "lora": "with", "opd": "all", "seed": "all"} | {
        "scale": "small", "frames.old": "3"
    }  # fmt: skip
    assert found["real-videos: octopi-small"].data.metrics["PC"] == 0.75
    assert {run.info.status for run in found.values()} == {"FINISHED"}
    assert {a.path for a in client().list_artifacts(full.info.run_id, "report")} == {"report/provenance.json"}
    view = client().get_experiment_by_name("octopi").tags["mlflow.sharedViewState.variants"]
    assert json.loads(view)["orderByKey"] == "metrics.`OPD`", "random models, whose accuracies are chance, below"
    chain.ran(["grade"], minutes=60, mark="2")
    publish(chain.params)
    assert len(runs("variant")) == len(found)
    shared = f"sqlite:///{Path('shared.db').resolve()}"
    publish(on_it := chain.params.model_copy(update={"tracking": TrackingConfig(uri=shared)}))
    before = {run.info.run_id for run in runs("variant", shared)}
    (other / "scores.csv").write_text(HEADER + SCORES)
    chain.ran(["grade"], minutes=120, mark="3")
    publish(on_it)
    assert before < {run.info.run_id for run in runs("variant", shared)}, "a server has reports of others, too"
    publish(chain.params)
    left = {run.info.run_name: run.info.run_id for run in runs("variant")}
    assert set(left) - mine == {"real-videos: finetuned-with-all"}, "a system that the new report lacks is gone"
    assert left["real-videos: finetuned-with-all"] != full.info.run_id, "and what the old one had"
    shutil.rmtree(other)
    chain.ran(["grade"], minutes=180, mark="4")
    publish(chain.params)
    assert {run.info.run_name for run in runs("variant")} == mine


def test_a_clone_that_only_pulled_has_no_stage_runs(chain: FakeChain) -> None:
    shutil.rmtree("runs")
    publish(chain.params)
    assert (len(runs("reproduction")), len(runs("stage")), len(runs("variant"))) == (1, 0, 2)
    assert "nothing new" in publish(chain.params)


def test_entries_of_other_parameters_are_no_part(chain: FakeChain) -> None:
    lock = yaml.safe_load(Path("dvc.lock").read_text())
    lock["stages"]["lora@base-all-0"]["params"]["params.yaml"]["frames"]["pixels"] = 224
    lock["stages"]["of-another-chain"] = lock["stages"]["split"]
    shutil.copy("runs/split.json", "runs/of-another-chain.json")
    Path("dvc.lock").write_text(yaml.safe_dump(lock))
    publish(chain.params)
    assert set(by_name("stage")) == set(TITLES) - {"lora@base-all-0"}


LORA = """\
from pathlib import Path
from pipeline.running.stage import stage
with stage("lora", "base-0") as run:
    Path("data/base-0/adapter").mkdir(parents=True)
    for file in ("data/base-0/adapter/é", "data/base-0/b", "smoke.json"):
        Path(file).write_text(str(run.params.lora.rank))
"""


def test_a_run_belongs_to_what_it_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rank 8 is trained, then rank 4, then rank 8 comes from DVC's cache: the run of rank 4 is not its."""
    monkeypatch.chdir(tmp_path)
    own = {"cmd": "python lora.py", "params": ["lora.rank"], "matrix": {"encoder": ["base"], "seed": [0]}}
    own |= {"outs": ["data/${item.encoder}-${item.seed}"], "metrics": [{"${scale}.json": {"cache": False}}]}
    Path("dvc.yaml").write_text(yaml.safe_dump({"vars": ["params.yaml"], "stages": {"lora": own}}))
    Path("lora.py").write_text(LORA)
    ran = []
    for rank in (8, 4, 8):
        write_params(params := fake_params(f"lora.rank={rank}"))
        command = "test -d .dvc || dvc init -q --no-scm; dvc repro -q"
        subprocess.run(command, shell=True, check=True, env=ENVIRONMENT)
        ran.append(read_stages(params)["lora@base-0"].ran is not None)
    assert ran == [True, True, False]


def test_publishing_that_was_cut_off_goes_on(chain: FakeChain, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(mlflow.MlflowClient, "log_artifacts", lambda *_: (_ for _ in ()).throw(OSError("disk")))
        with pytest.raises(TrackingError, match="disk"):
            publish(chain.params)
    publish(chain.params)
    (parent,) = runs("reproduction")
    assert not [name for name in parent.data.tags if name.startswith("variant.")]
    assert set(by_name("stage")) == set(TITLES)
    whole = [run for run in runs() if run.info.status == "FINISHED"]
    assert len(whole) == 1 + len(TITLES) + 2
    assert "nothing new" in publish(chain.params)
    assert len(losses(by_name("stage")["lora@base-all-0"])) == 120


def test_the_command_says_what_was_added_or_in_one_line_why_it_could_not(chain: FakeChain) -> None:
    from pipeline.cli import app

    assert "2 variants are new" in CliRunner().invoke(app, ["publish"]).stdout
    client().delete_experiment(client().get_experiment_by_name("octopi").experiment_id)
    with refused("tracking.experiment: octopi was deleted"):
        publish(chain.params)
    for text in ("{", "stages: [split]", "stages: {split: 3}"):
        Path("dvc.lock").write_text(text)
        with refused(r"dvc.lock: not as DVC writes it \(.*from Git"):
            publish(chain.params)


PUBLISH = """\
from pipeline.running.stage import stage
from pipeline.tracking.publish import PLUMBING, publish
with stage("publish") as run:
    print(publish(run.params))
"""


def test_an_experiment_publishes_into_the_project(chain: FakeChain) -> None:
    """DVC runs it in a copy of what Git has, and deletes the copy."""
    shutil.copy(ROOT / ".gitignore", ".")
    Path("stages").mkdir()
    Path("stages/publish.py").write_text(PUBLISH)
    Path("dvc.yaml").write_text(CHAIN.replace("publish: {cmd: x}", "publish: {cmd: python stages/publish.py}"))

    def run(command: str) -> str:
        return subprocess.run(command, shell=True, env=ENVIRONMENT, text=True, capture_output=True, check=True).stdout

    run("git init -q && git config user.name a && git config user.email a@b && dvc init -q")
    run("git add . && git commit -qm a && dvc exp run --temp --single-item publish")
    (parent,) = runs("reproduction")
    assert {a.path for a in client().list_artifacts(parent.info.run_id)} == {"report"}
    written = set(Path("mlruns/artifacts").rglob("*"))
    assert chain.folder / "mlruns" in {p.parents[-len(chain.folder.parts) - 1] for p in map(Path.resolve, written)}
    # What runs in one folder is not taken for what was killed in another.
    assert parent.data.tags["octopi.folder"].startswith(".dvc/tmp/exps/")
    assert run("git status --porcelain -- mlruns") == ""


def test_a_packaged_folder_is_logged_with_its_card(again: FakeChain) -> None:
    folder = Path("models") / FULL
    folder.mkdir(parents=True)
    for minutes, text in ((60, "x"), (120, "y")):
        for name in ("config.json", "README.md"):
            # As DVC's `cache.type symlink` leaves it: the name in models/, the file in the cache, read-only.
            file = Path(f"{text}-{name}").absolute()
            file.write_text(text)
            file.chmod(0o444)
            (folder / name).unlink(missing_ok=True)
            (folder / name).symlink_to(file)
        again.ran(["grade"], minutes)
        publish(again.params)
        parent = runs("reproduction")[-1].info.run_id
        (last,) = [run for run in runs("variant") if run.data.tags["mlflow.parentRunId"] == parent]
        for name in ("config.json", "README.md"):
            copy = Path(mlflow.artifacts.download_artifacts(f"{last.info.artifact_uri}/package/{name}"))
            assert (copy.is_symlink(), copy.read_text()) == (False, text)
