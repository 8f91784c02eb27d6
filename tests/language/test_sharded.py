"""conf/accelerate/fsdp.yaml on two CPU processes: sharded trainings against those of one process.

One process sees the questions of an update one by one, two processes see a half each: the same terms of the same sums,
added in another order. Adam divides each gradient by its own size, so an update differs by its rounding relative
to the rate: 1e-7 times the terms that cancel, far below the hundredth of a rate that is allowed here.
"""

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file

from pipeline.core.io import write_jsonl
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Material
from pipeline.running.errors import UserError
from tests.conftest import HUNG, ROOT
from tests.language.sharded import CONFIG, KINDS, run

CHECKPOINT = {
    *("model.safetensors", "optimizer.bin", "scheduler.pt", "rng_state_0.pth", "rng_state_1.pth"),
    *("trainer_state.json", "training_args.bin"),
}


@contextmanager
def launched(folder: Path, *arguments: str, **settings: object) -> Iterator[subprocess.Popen[str]]:
    """A launch with the shipped settings, but on CPUs."""
    shipped = yaml.safe_load((ROOT / "conf/accelerate/fsdp.yaml").read_text())
    own = folder / f"cpu-{settings.get('machine_rank', 0)}.yaml"
    own.write_text(yaml.safe_dump({**shipped, "use_cpu": True, "main_process_port": 0, **settings}))
    command = [sys.executable, "-m", "accelerate.commands.launch", "--config_file", str(own)]
    process = subprocess.Popen(
        [*command, "-m", "tests.language.sharded", str(folder), *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def free_port() -> int:
    """Below those that systems give away unasked, so that nobody is given it before it is used."""
    for port in range(20_000 + os.getpid() % 10_000, 32_000):
        with suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no port is free")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, held: Material) -> Path:
    """Every kind once to its end, and LoRA killed in its fifth update."""
    folder = tmp_path_factory.mktemp("sharded")
    write_jsonl(folder / "questions.jsonl", held.questions)
    with launched(folder, held.language.weights, str(held.store.folder), "killed") as process:
        output, _ = process.communicate(timeout=HUNG)
    assert "SIGKILL" in output, output[-3000:]
    return folder


@pytest.mark.parametrize("kind", list(KINDS))
def test_two_processes_that_share_the_layers_train_like_one(
    kind: str, trained: Path, held: Material, checkpoints: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A sharded model reads the beginnings of questions anew for each row; a base in bfloat16 rounds otherwise then.
    monkeypatch.setattr(OctopiForCausalLM, "_shared", lambda *_: 0)
    one = run(kind, held, checkpoints).state
    both = [load_file(trained / f"{kind}-whole-{rank}.safetensors") for rank in range(2)]
    said = [json.loads((trained / f"{kind}-{rank}.json").read_text()) for rank in range(2)]
    assert all(s["sharded"] for s in said)
    assert sum(s["share"] for s in said) == pytest.approx(1, abs=1e-3)
    assert max(s["share"] for s in said) < 0.6
    assert {s["computes"] for s in said} == {"torch.float32"}, "what is trained is not computed in the base's format"
    for name, value in one.items():
        assert torch.equal(both[0][name], both[1][name])
        assert both[0][name].dtype == torch.float32
        torch.testing.assert_close(both[0][name], value, atol=0.01 * CONFIG.projection_learning_rate, rtol=0)
    assert both[0].keys() == one.keys()


def test_a_checkpoint_holds_what_is_trained_alone(trained: Path) -> None:
    checkpoints = list((trained / "killed" / "lora").glob("*/checkpoint-*"))
    assert [c.name for c in checkpoints] == ["checkpoint-4"]
    assert {f.name for f in checkpoints[0].iterdir()} == CHECKPOINT
    names = load_file(trained / "lora-whole-0.safetensors").keys()
    assert load_file(checkpoints[0] / "model.safetensors").keys() == names
    assert all(name.startswith(("connector.", "words.")) or "lora_" in name for name in names)
    assert "words.weight" in names
    optimizer = torch.load(checkpoints[0] / "optimizer.bin", weights_only=True)
    assert optimizer["state"].keys() == names


def test_one_process_does_not_go_on_with_what_two_began(trained: Path, held: Material, checkpoints: Path) -> None:
    shutil.copytree(trained / "killed", checkpoints / "killed")
    with pytest.raises(UserError, match=r"checkpoint-4: was written sharded.*runtime\.launcher"):
        run("lora", held, checkpoints / "killed")


def test_two_machines_go_on_where_two_processes_were_killed(trained: Path, held: Material) -> None:
    """Each machine is launched by itself, as docs/scale.md says; here both are this one."""
    shared = {"num_machines": 2, "main_process_ip": "127.0.0.1", "main_process_port": free_port()}
    arguments = (held.language.weights, str(held.store.folder), "resumed")
    with (
        launched(trained, *arguments, **shared, machine_rank=0) as first,
        launched(trained, *arguments, **shared, machine_rank=1) as second,
    ):
        for process in (first, second):
            output, _ = process.communicate(timeout=HUNG)
            assert process.returncode == 0, output[-3000:]
    whole, resumed = (load_file(trained / f"lora-{name}-1.safetensors") for name in ("whole", "resumed"))
    assert whole.keys() == resumed.keys()
    assert all(torch.equal(resumed[name], value) for name, value in whole.items())
