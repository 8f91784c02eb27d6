"""The whole chain, reduced, in a copy of the project: once, again, after a change, and from scratch."""

from __future__ import annotations

import shutil

import pytest
import torch
import yaml
from safetensors.torch import load_file

from tests.project import REDUCED, Project, copy_project


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    project = copy_project(tmp_path_factory.mktemp("chain") / "a path with spaces")
    project.run("octopi", "scale", *REDUCED)
    project.run("octopi", "repro")
    return project


def test_everything_a_person_looks_at_is_there(project: Project) -> None:
    report = project.folder / "reports" / "smoke-scenes"
    for name in ("README.md", "scores.csv", "effects.csv", "params.yaml", "provenance.json", "metrics.json", "figures"):
        assert (report / name).exists(), name
    assert "prove" in (report / "README.md").read_text(), "the smoke report says what its figures are worth"
    assert (project.folder / "mlruns" / "mlflow.db").is_file()
    assert (project.folder / "reports" / "index.html").is_file()
    header, values = project.run("dvc", "metrics", "show", "--md").splitlines()[:3:2]
    assert header.count("|") - 2 <= 12, header
    assert "smoke-scenes" in values


def test_second_time_does_nothing(project: Project) -> None:
    assert "stages are up to date" in project.run("octopi", "repro")


def test_changed_grader_regenerates_no_answer(project: Project) -> None:
    grader = project.folder / "pipeline" / "tasks" / "pc.py"
    grader.write_text(grader.read_text() + "\n# changed\n")
    output = project.run("octopi", "repro")
    assert "stages will run" in output
    assert "Running stage 'grade'" in output
    for stage in ("answer", "align", "lora", "embed", "finetune_encoder"):
        assert f"Running stage '{stage}" not in output


def test_same_seed_gives_identical_results(project: Project) -> None:
    before = yaml.safe_load((project.folder / "dvc.lock").read_text())
    project.run("dvc", "repro", "--force")
    assert yaml.safe_load((project.folder / "dvc.lock").read_text()) == before


WHO = """from accelerate import Accelerator
a = Accelerator(cpu=True)
a.print(a.distributed_type.value, a.num_processes)
"""


def test_two_processes_train_like_one(project: Project) -> None:
    """The shipped configuration on two CPU processes. There accelerate trains data-parallel: sharding on CPUs is
    tests/language/test_sharded.py's."""
    text = (project.folder / "conf/accelerate/fsdp.yaml").read_text()
    (project.folder / "two.yaml").write_text(f"{text}use_cpu: true\n")
    (project.folder / "who.py").write_text(WHO)
    two = ["accelerate", "launch", "--config_file", "two.yaml"]
    assert "MULTI_CPU 2" in project.run(*two, "who.py"), "really two that know of each other"
    results = []
    project.run("octopi", "scale", *REDUCED, "align.micro_batch_size=8")
    for launcher in (["python"], two):
        project.run(*launcher, "stages/align.py", "finetuned", "all", "0")
        results.append(load_file(project.folder / "data/models/without/finetuned-all-0/connector.safetensors"))
    project.run("octopi", "scale", *REDUCED)
    assert results[0].keys() == results[1].keys()
    for name, value in results[0].items():
        torch.testing.assert_close(value, results[1][name], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("recipe", ["release", "pretrained"])
def test_other_recipes_go_through_to_the_embeddings(project: Project, recipe: str) -> None:
    smaller = ("pretrain.objects=16", "pretrain.steps=3") if recipe == "pretrained" else ()
    project.run("octopi", "scale", *REDUCED, f"encoder.recipe={recipe}", *smaller, "encoder.epochs=1")
    project.run("dvc", "repro", "embed")
    trained = load_file(project.folder / "data" / "encoder" / "0" / "encoder.safetensors")
    assert ("dependence" in trained) == (recipe == "pretrained")
    embeddings = load_file(project.folder / "data" / "embeddings" / "finetuned-0" / "embeddings.safetensors")
    assert all(value.isfinite().all() for value in embeddings.values())
    project.run("octopi", "scale", *REDUCED)


def test_going_back_to_a_scale_restores_it(project: Project) -> None:
    """After the other recipes: their encoders lie in data/ now."""
    report = project.folder / "reports" / "smoke-scenes" / "metrics.json"
    before = report.read_bytes()
    project.run("octopi", "scale", *REDUCED, "seed=1")
    project.run("octopi", "scale", *REDUCED)
    shutil.rmtree(project.folder / "data" / "models" / "with")
    output = project.run("dvc", "repro")
    assert "is cached - skipping run, checking out outputs" in output
    assert "Running stage 'lora" not in output
    assert report.read_bytes() == before
    # Last, since it leaves the project without its videos.
    shutil.rmtree(project.folder / "data" / "scenes")
    (project.folder / "data" / "scenes" / "videos").mkdir(parents=True)
    message = project.run("python", "stages/extract_frames.py", status=1)
    assert "Traceback" not in message
    assert "data/scenes/videos" in message
