"""The trained part of a module, apart from the frozen base around it: what is saved, and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from pipeline.core.io import load_tensors, save_tensors
from pipeline.running.errors import UserError


def trainable_state(module: nn.Module) -> dict[str, torch.Tensor]:
    """What is trained, by name: parameters, and the persistent buffers of the modules that they are in."""
    state: dict[str, torch.Tensor] = {}
    kept = module.state_dict()
    for prefix, part in module.named_modules():
        state |= {n: p.detach() for n, p in part.named_parameters(prefix, recurse=False) if p.requires_grad}
        if any(p.requires_grad for p in part.parameters()):
            state |= {n: b.detach() for n, b in part.named_buffers(prefix, recurse=False) if n in kept}
    return state


def whole_state(module: nn.Module) -> dict[str, torch.Tensor]:
    """`trainable_state`, gathered from all processes where it is sharded: each must call this, and each gets all of it.

    The frozen base stays where it is: gathering that too would take its whole size of memory in each process.
    """
    state: dict[str, Any] = {**trainable_state(module)}
    return {name: value.full_tensor() if hasattr(value, "full_tensor") else value for name, value in state.items()}


def save_trainable(module: nn.Module, path: Path) -> None:
    """Write what is trained, and only that, as safetensors."""
    save_tensors(path, trainable_state(module))


def load_trainable(module: nn.Module, path: Path) -> None:
    """Read what `save_trainable` wrote; names and shapes must be exactly those of the module's `trainable_state`.

    A sharded module takes its shards of it; every process must call this.
    """
    loaded = load_tensors(path)
    own: dict[str, Any] = {**trainable_state(module)}
    wrong = sorted(loaded.keys() ^ own.keys()) or [n for n in own if loaded[n].shape != own[n].shape]
    if wrong:
        raise UserError(
            f"{path}: does not fit the model ({wrong[0]} is missing, unknown or of another shape); it was made with "
            "other parameters or weights: run `dvc repro`"
        )
    with torch.no_grad():
        for name, value in own.items():
            read = loaded[name].to(value.device)
            if hasattr(value, "placements"):  # A DTensor; importing that class for the question would take a second.
                from torch.distributed.tensor import distribute_tensor

                read = distribute_tensor(read, value.device_mesh, value.placements)
            value.copy_(read)
