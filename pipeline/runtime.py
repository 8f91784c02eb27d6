"""Seeds, devices and number formats: the only place that decides where a tensor lives."""

from __future__ import annotations

import hashlib
import os
import random
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.errors import UserError

if TYPE_CHECKING:
    import torch

CHECKPOINTS = Path("checkpoints")
"""Where unfinished work waits to be resumed, outside DVC's reach: DVC deletes the outputs of a killed stage."""

DeviceName = Literal["auto", "cpu", "cuda", "mps"]
DtypeName = Literal["float32", "bfloat16", "float16"]
Quantization = Literal["none", "nf4"]


def derive_seed(*parts: object) -> int:
    """A 63-bit seed from any printable parts: equal on every machine and in every process."""
    digest = hashlib.sha256("\x1f".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def seed_everything(seed: int) -> None:
    """Seed Python, NumPy and torch."""
    import numpy as np
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def resolve_device(name: DeviceName) -> torch.device:
    """The device of that name; `auto` takes CUDA, then Apple's MPS, then the CPU."""
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    elif name == "cuda" and not torch.cuda.is_available():
        raise UserError("runtime.device: cuda is asked for but torch sees no CUDA device; use auto or cpu")
    elif name == "mps" and not torch.backends.mps.is_available():
        raise UserError("runtime.device: mps is asked for but torch sees no MPS device; use auto or cpu")
    return torch.device(name)


def resolve_dtype(name: DtypeName) -> torch.dtype:
    """The torch dtype of that name."""
    import torch

    dtypes: dict[str, torch.dtype] = {
        "float32": torch.float32,
        "bfloat16": torch.bfloat16,
        "float16": torch.float16,
    }
    return dtypes[name]


def limit_threads(count: int) -> None:
    """Let torch use this many CPU threads, where it is in use at all; 0 leaves it as it is."""
    if count and "torch" in sys.modules:
        import torch

        torch.set_num_threads(count)


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def quiet_libraries() -> None:
    """Silence what libraries say that a person can do nothing about: a bar a loaded file, and their own deprecations."""
    os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    warnings.filterwarnings(
        "ignore", category=FutureWarning, module=r"(torch|transformers|peft|accelerate|open_clip|timm)\b"
    )
