"""The whole chain, reduced, in a copy of the project: once, again, after a change, and from scratch."""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file

from pipeline.core.io import read_json, read_jsonl
from pipeline.core.records import Opd, Prediction, Question
from pipeline.use.model import Octopi
from tests.drill import Drill
from tests.project import REDUCED, Project, copy_project
from tests.use.shared import replay

METRICS = "reports/smoke-scenes/metrics.json"
KILLS, SEED = int(os.environ.get("KILLS", "4")), os.environ.get("SEED", "0")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    project = copy_project(tmp_path_factory.mktemp("chain") / "a path with spaces")
    project.run("octopi", "scale", *REDUCED)
    project.run("octopi", "repro")
    shutil.copy(project.folder / METRICS, project.folder / "first.json")
    return project


def test_everything_a_person_looks_at_is_there(project: Project) -> None:
    report = project.folder / "reports" / "smoke-scenes"
    for name in ("README.md", "scores.csv", "effects.csv", "params.yaml", "provenance.json", "metrics.json", "figures"):
        assert (report / name).exists(), name
    assert "prove" in (report / "README.md").read_text(), "the smoke report says what its figures are worth"
    assert (project.folder / "mlruns" / "mlflow.db").is_file()
    assert (project.folder / "reports" / "index.html").is_file()
    shown = read_json(report / "samples.json")
    examples = [(s["question_id"], s["part"], len(s["answered"])) for s in shown["examples"]]
    assert examples == [("rice-a", "train", 2), ("rice-b", "train", 2)]
    assert list(shown["not_asked"]) == ["toothbrush"]
    assert "smoke-scenes" in project.run("dvc", "metrics", "show", "--md")


def test_the_packaged_model_answers_as_the_evaluation_did(project: Project) -> None:
    key, data = "finetuned-with-all-0", project.folder / "data"
    model = Octopi.from_pretrained(project.folder / "models" / key, device="cpu")
    trainings = (data / "models/without/finetuned-all-0", project.folder / "models" / key / "language")
    words = [load_file(folder / "words.safetensors")["weight"] for folder in trainings]
    assert not torch.equal(*words), "both trainings train them"
    questions = read_jsonl(data / "questions" / "0" / "evaluation.jsonl", Question)
    predictions = read_jsonl(data / "answers" / key / "real.jsonl", Prediction)
    files = {f.stem: f for f in (data / "scenes" / "videos").rglob("*.*")}
    assert replay(model, questions, predictions, Opd.ALL, files) == len(questions) >= 16


def test_second_time_does_nothing(project: Project) -> None:
    assert "stages are up to date" in project.run("octopi", "repro")


def test_a_killed_chain_goes_on_and_loses_nothing(project: Project, tmp_path: Path) -> None:
    """On a copy of what has run; `make drill` does it more often."""
    shutil.copytree(project.folder, tmp_path / "a project", symlinks=True)
    drill, done = Drill(Project(tmp_path / "a project")), 0
    for number in itertools.count():
        done += drill.kill(f"{SEED}/{number}")
        if done == KILLS:
            break


def test_the_same_bytes_by_another_processor_s_kernels(project: Project, tmp_path: Path) -> None:
    """A whole second run, report and figures too, on one core, where each library is told to compute otherwise."""
    before = yaml.safe_load((project.folder / "dvc.lock").read_text())["stages"]
    other = Project(project.folder)
    other.environment |= {"ATEN_CPU_CAPABILITY": "default", "OPENBLAS_CORETYPE": "Nehalem", "MKL_CBWR": "SSE4_2"}
    other.environment |= {"ONEDNN_MAX_CPU_ISA": "SSE41", "OPENCV_IPP": "sse42", "MKL_NUM_THREADS": "2"}
    other.environment |= {"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"}
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        other.run("dvc", "repro", "--force", "report")
        assert yaml.safe_load((project.folder / "dvc.lock").read_text())["stages"] == before
        shutil.copytree(project.folder, tmp_path / "machine", symlinks=True)
        other.folder = tmp_path / "machine"
        other.environment["PYTHONPATH"] = str(other.folder)
        other.run("octopi", "scale", *REDUCED, "kernels=machine")
        other.run("dvc", "repro", "finetune_encoder")
    finally:
        os.sched_setaffinity(0, cores)
    after = yaml.safe_load((other.folder / "dvc.lock").read_text())["stages"]
    changed = {name for name, stage in after.items() if stage.get("outs") != before[name].get("outs")}
    assert {"weights", "finetune_encoder@0"} <= changed, "these variables do change what is computed"


def test_two_processes_train_like_one(project: Project) -> None:
    """The shipped configuration on two CPU processes. There accelerate trains data-parallel: sharding on CPUs is
    tests/language/test_sharded.py's."""
    text = (project.folder / "conf/accelerate/fsdp.yaml").read_text()
    (project.folder / "two.yaml").write_text(f"{text}use_cpu: true\n")
    two = ["accelerate", "launch", "--config_file", "two.yaml"]
    results = []
    project.run("octopi", "scale", *REDUCED, "align.micro_batch_size=8")
    for launcher in (["python"], two):
        project.run(*launcher, "stages/align.py", "finetuned", "all", "0")
        results.append(load_file(project.folder / "data/models/without/finetuned-all-0/connector.safetensors"))
    assert results[0].keys() == results[1].keys()
    # Of AdamW's one step of 3e-3. Where a gradient is as small as its epsilon of 1e-8, the step follows rounding.
    for name, value in results[0].items():
        torch.testing.assert_close(value, results[1][name], atol=1e-5, rtol=1e-5)


def test_going_back_to_a_scale_restores_it(project: Project) -> None:
    """After other questions and another batch size: what those made lies there now."""
    project.run("octopi", "scale", *REDUCED, "questions.seed=1")
    project.run("dvc", "repro", "questions")
    project.run("octopi", "scale", *REDUCED)
    shutil.rmtree(project.folder / "data" / "models" / "with")
    output = project.run("dvc", "repro")
    assert "Stage 'questions' is cached - skipping run, checking out outputs" in output
    assert "Running stage 'lora" not in output
    assert (project.folder / METRICS).read_bytes() == (project.folder / "first.json").read_bytes()
    # Last, since it leaves the project without its videos.
    shutil.rmtree(project.folder / "data" / "scenes")
    (project.folder / "data" / "scenes" / "videos").mkdir(parents=True)
    message = project.run("python", "stages/extract_frames.py", status=1)
    assert "Traceback" not in message
    assert "data/scenes/videos" in message
