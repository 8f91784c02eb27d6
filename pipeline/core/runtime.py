"""Seeds, devices, number formats, and the kernels and threads that libraries compute with."""

from __future__ import annotations

import hashlib
import os
import platform
import random
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.running.errors import UserError

if TYPE_CHECKING:
    import torch
DeviceName = Literal["auto", "cpu", "cuda", "mps"]
DtypeName = Literal["auto", "float32", "bfloat16", "float16"]
Quantization = Literal["none", "nf4"]
Kernels = Literal["portable", "machine"]
PORTABLE = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",  # The locked NumPy's names.
    "OPENBLAS_CORETYPE": "Haswell",
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "MKL_CBWR": "COMPATIBLE",  # On processors that are not Intel's, MKL honours no other.
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_IPP": "avx2",
    "MKL_DYNAMIC": "FALSE",  # Or MKL takes fewer threads where there are fewer cores.
}
"""Variables by which each library computes with the same AVX2 code on every x86-64 processor that has AVX2."""


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

    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    chosen = next(kind for kind, usable in there.items() if usable) if name == "auto" else name
    if not there[chosen]:
        raise UserError(f"runtime.device: {name} is asked for but torch sees no {name.upper()} device; use auto or cpu")
    return torch.device(chosen)


def name_dtype(name: DtypeName, device: DeviceName = "auto") -> DtypeName:
    """What `auto` stands for on that device, for the record; other names stay as they are.

    bfloat16 where it is computed in hardware (CUDA from Ampere on; processors with AVX512-BF16 or AMX), else float32:
    elsewhere a processor takes many times as long for it.
    """
    import torch

    if name != "auto":
        return name
    fast, kind = False, resolve_device(device).type
    if kind == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    elif kind == "cpu":
        # No public name asks the processor.
        fast = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return "bfloat16" if fast else "float32"


def resolve_dtype(name: DtypeName) -> torch.dtype:
    """The torch dtype of that name; `auto` for the device that `auto` is."""
    import torch

    dtype: torch.dtype = getattr(torch, name_dtype(name))
    return dtype


def use_kernels(kernels: Kernels) -> None:
    """Let this process and those that it starts compute with `PORTABLE` kernels; `machine` changes nothing.

    Libraries read the variables when they are loaded, so this comes before NumPy and torch are imported. On other
    machines than x86-64 the variables mean nothing.
    """
    x86 = platform.machine() in ("x86_64", "AMD64")
    if kernels == "machine" or not x86 or PORTABLE.items() <= os.environ.items():
        return
    if early := {"numpy", "torch"} & sys.modules.keys():
        raise RuntimeError(f"{early} imported before the kernels were chosen: import it in the stage's body")
    os.environ |= PORTABLE


def limit_threads(count: int) -> None:
    """Let torch and MKL use this many CPU threads, also where they are imported later; 0 leaves them as they are."""
    if count:
        os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(count))
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(count)


def processor() -> str:
    """The name of this machine's processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
