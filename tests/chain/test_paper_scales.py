"""The paper's scales on narrow checkpoints with the published names and layouts, each training in two processes.

What is set beside a scale is where things lie, how much there is of them, folds, and the device: CPUs, which gloo
connects. Of each matrix one cell runs, since the others are the same command with another argument. Nearly all of the
time is importing: some fifteen processes start.
"""

from __future__ import annotations

import json
import os
from collections import Counter

import pytest
import torch
import yaml
from safetensors.torch import load_file

from pipeline.core.io import read_jsonl
from pipeline.core.records import Prediction
from tests.checkpoints import write_clip, write_vicuna
from tests.closure import ROOT
from tests.conftest import encode, moving_square
from tests.project import OBJECTS, Project, copy_project

WIDTH = 64
VIT_L = {
    "model_cfg": {
        "embed_dim": 48,
        "quick_gelu": True,
        "vision_cfg": {"image_size": 224, "layers": 4, "width": WIDTH, "patch_size": 14},
        "text_cfg": {"context_length": 77, "vocab_size": 64, "width": 16, "heads": 2, "layers": 1},
    },
    "preprocess_cfg": {"mean": [0.48145466, 0.4578275, 0.40821073], "std": [0.26862954, 0.26130258, 0.27577711]},
}
"""As open_clip_config.json of OpenAI's ViT-L/14 has it, but for widths, layers and words."""
LAYERS = {"paper-7b": 2, "paper-13b": 3}
SYSTEM = "finetuned-with-all-1"
FEW = (
    "data.dir=physiclear",
    "runtime.device=cpu",
    "ablation.encoders=[finetuned]",
    "ablation.lora=[with]",
    "ablation.opd=[all]",
    "questions.train={opd:12,pc:12,pss:12,pom:12}",
    "questions.evaluation={opd:4,pc:4,pss:4,pom:4,psr:4}",
    "language.max_new_tokens=8",
    "encoder.epochs=1",
    # Two updates, and a checkpoint after each.
    "align.samples=32",
    "lora.samples=32",
    "runtime.save_steps=1",
    "split.name=kfold",
    "split.folds=3",
)
LAUNCHED = '''"""Runs a stage as accelerate launched it, with layers sharded on CPUs, and notes how."""
import json, os, runpy, sys
from pathlib import Path
from accelerate.state import PartialState
from tests.language.sharded import shard_on_cpus, watch

said = {}
_, *sys.argv = sys.argv
shard_on_cpus()
watch(said)
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    said["processes"] = PartialState().num_processes
    Path(f"{Path(sys.argv[0]).stem}-{os.environ['RANK']}.json").write_text(json.dumps(said))
'''
LAUNCHER = "runtime.launcher=accelerate launch --config_file cpu.yaml launched.py"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    project = copy_project(tmp_path_factory.mktemp("paper"))
    folder = project.folder
    project.environment |= {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": "1"}
    for number, name in enumerate(f"{o}_{n}" for o in OBJECTS for n in range(2)):
        # In the public data set's container, codec and size.
        encode(folder / "physiclear" / f"{name}.mov", moving_square(12, number, 320, 240), "mpeg4", "yuv420p")
    write_clip(folder / "weights" / "clip-vit-large-patch14", config=VIT_L)
    words = "\n".join(f.read_text() for f in sorted((ROOT / "pipeline" / "physiclear").glob("*.*")))
    for scale, layers in LAYERS.items():
        write_vicuna(folder / "weights" / f"vicuna-{scale[6:]}-v1.5", words, num_hidden_layers=layers)
    (folder / "launched.py").write_text(LAUNCHED)
    shipped = yaml.safe_load((folder / "conf" / "accelerate" / "fsdp.yaml").read_text())
    (folder / "cpu.yaml").write_text(yaml.safe_dump({**shipped, "use_cpu": True, "main_process_port": 0}))
    return project


def test_paper_13b_from_videos_to_the_report(project: Project) -> None:
    """One of three folds."""
    table = project.run("octopi", "scale", "paper-13b", *FEW, "ablation.seeds=[1]", LAUNCHER)
    assert "align                   2" in table, "two devices are counted"
    project.run("octopi", "repro")
    files = [f for stage in ("align", "lora") for f in project.folder.glob(f"{stage}-?.json")]
    noted = {f.stem: json.loads(f.read_text()) for f in files}
    assert noted.keys() == {f"{stage}-{rank}" for stage in ("align", "lora") for rank in (0, 1)}
    for each in noted.values():
        assert (each["processes"], each["sharded"], each["computes"]) == (2, True, "torch.float32")
        assert float(str(each["share"])) < 0.6
    # Trained parameters are finite and of the shapes that the published layouts and the scale give.
    folder = project.folder / "data" / "models" / "with" / "finetuned-all-1"
    connector = load_file(folder / "connector.safetensors")
    adapter = load_file(folder / "adapter" / "adapter_model.safetensors")
    # An adapter is written in its base's format.
    for values, dtype in ((connector.values(), torch.float32), (adapter.values(), torch.bfloat16)):
        assert all(value.dtype == dtype and value.isfinite().all() for value in values)
    # The class token before its projection, as the paper's code hands it on.
    assert connector["projection.0.weight"].shape[1] == WIDTH
    layer = "base_model.model.model.layers.{}.self_attn.{}.lora_{}.weight"
    layers = range(LAYERS["paper-13b"])
    assert adapter.keys() == {layer.format(i, p, ab) for i in layers for p in ("q_proj", "k_proj") for ab in "AB"}
    assert {min(value.shape) for value in adapter.values()} == {64}, "rank 128, of a layer that is 64 wide"
    assert {max(value.shape) for value in adapter.values()} == {128}
    assert any(value.any() for name, value in adapter.items() if "lora_B" in name), "it was trained"
    for touch in ("real", "removed", "swapped", "noise"):
        said = read_jsonl(project.folder / "data" / "answers" / SYSTEM / f"{touch}.jsonl", Prediction)
        assert Counter(p.task for p in said) == dict.fromkeys(("OPD", "PC", "PSS", "POM", "PSR"), 4)
    readme = (project.folder / "reports" / "paper-13b-videos" / "README.md").read_text()
    assert "weights/vicuna-13b-v1.5" in readme
    assert "1 of 3 folds (1) were run" in readme
    assert (project.folder / "models" / SYSTEM / "README.md").is_file()
    assert not list((project.folder / "checkpoints").glob("*/*")), "nothing waits any more"


def test_paper_7b_begins_with_the_same_encoder(project: Project) -> None:
    """Everything before alignment is the same in both scales."""
    project.run("octopi", "scale", "paper-7b", *FEW, "ablation.seeds=[1]", LAUNCHER)
    output = project.run("dvc", "repro", "--dry", "report")
    assert "Running stage 'align@finetuned-all-1'" in output
    assert "Running stage 'embed'" not in output
    assert "Running stage 'finetune_encoder" not in output


def test_a_further_fold_trains_none_of_the_others_anew(project: Project) -> None:
    """How answers are pooled is tests/report/test_folds.py's."""
    project.run("octopi", "scale", "paper-13b", *FEW, "ablation.seeds=[1,2]", LAUNCHER)
    project.run("dvc", "repro", "questions")
    assert (project.folder / "data" / "questions" / "2" / "train.jsonl").is_file()
    trained = ("finetune_encoder@1", "align@finetuned-all-1", "lora@finetuned-all-1", f"answer@{SYSTEM}")
    assert "up to date" in project.run("dvc", "status", *trained)
