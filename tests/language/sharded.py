"""A process of a sharded training: `accelerate launch -m tests.language.sharded FOLDER WEIGHTS EMBEDDINGS WHAT`."""

import itertools
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from accelerate.state import AcceleratorState
from accelerate.utils import DistributedType
from torch.distributed.tensor import DTensor
from torch.nn import Module
from torch.optim.optimizer import register_optimizer_step_pre_hook

from pipeline.config import LanguageConfig, LoraTrainConfig
from pipeline.core.io import read_jsonl, save_tensors, write_json
from pipeline.core.records import Question
from pipeline.language.training import Job, Material
from pipeline.training.embeddings import EmbeddingStore
from pipeline.training.trainer import TrainableTrainer, Trained
from tests.language.conftest import SMALL, material, train

CONFIG = LoraTrainConfig(
    **{**SMALL.model_dump(), "samples": 9, "epochs": 2}, rank=4, alpha=8, learning_rate=1e-3, dropout=0.0
)
"""Six updates, of four questions or (the last of each epoch) of one. Each process sees two of the four, or one process
two after two. No dropout: each process draws its own."""
KINDS = {"align": "float32", "lora": "bfloat16"}
"""Trainings and the number format of the frozen weights; adapters stand in one group with them."""
DIES = 5
"""Update in which a process is killed; checkpoints are written after each second one."""


def run(kind: str, held: Material, folder: Path) -> Trained:
    language = LanguageConfig(weights=held.language.weights, dtype=KINDS[kind])
    return train(Job(kind, "x", 0), replace(held, language=language), CONFIG, folder)


def shard_on_cpus() -> None:
    """Have accelerate shard on CPUs as on GPUs: it has no other reason to refuse than that nobody would want it."""
    begin = AcceleratorState.__init__

    def begin_sharded(self: AcceleratorState, *args: Any, fsdp_plugin: Any = None, **kwargs: Any) -> None:
        begin(self, *args, fsdp_plugin=fsdp_plugin, **kwargs)
        if self.distributed_type == DistributedType.MULTI_CPU:
            self.distributed_type = DistributedType.FSDP
            if fsdp_plugin is not None:
                if self._mixed_precision != "no":
                    fsdp_plugin.set_mixed_precision(self._mixed_precision)
                self.fsdp_plugin = fsdp_plugin

    AcceleratorState.__init__ = begin_sharded


def watch(said: dict[str, Any]) -> None:
    """Note how parameters are held, and what format they compute in."""
    step = TrainableTrainer.training_step

    def watched(self: TrainableTrainer, model: Module, *args: Any, **kwargs: Any) -> torch.Tensor:
        if "sharded" not in said:
            parameters = list(model.parameters())
            said["sharded"] = all(isinstance(p, DTensor) for p in parameters)
            said["share"] = sum(p.to_local().numel() for p in parameters) / sum(p.numel() for p in parameters)

            def note(module: Module, *_: object) -> None:
                said["computes"] = str(module.weight.dtype)

            model.get_submodule("connector.projection.0").register_forward_hook(note)
        return step(self, model, *args, **kwargs)

    TrainableTrainer.training_step = watched


def main() -> None:
    place, weights, embeddings, what = sys.argv[1:]
    folder, rank, updates = Path(place), os.environ["RANK"], itertools.count(1)
    shard_on_cpus()
    torch.set_num_threads(1)
    questions = read_jsonl(folder / "questions.jsonl", Question)
    held = material(LanguageConfig(weights=weights), questions, EmbeddingStore(Path(embeddings)))

    def die(*_: object) -> None:
        if next(updates) == DIES and rank == "1":
            os.kill(os.getpid(), signal.SIGKILL)

    if what == "killed":
        for kind in KINDS:
            said: dict[str, Any] = {}
            watch(said)
            save_tensors(folder / f"{kind}-whole-{rank}.safetensors", run(kind, held, folder / "whole").state)
            write_json(folder / f"{kind}-{rank}.json", said)
        register_optimizer_step_pre_hook(die)
    save_tensors(folder / f"lora-resumed-{rank}.safetensors", run("lora", held, folder / "killed").state)


if __name__ == "__main__":
    main()
