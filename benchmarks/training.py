"""What the trainings of the last reproduction took, beside the paper's: nothing is measured again."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from benchmarks.table import Row
from pipeline.config.params import PARAMS_FILE, load_params
from pipeline.core.errors import UserError
from pipeline.core.io import read_json
from pipeline.core.stage import RUNS

TRAININGS = {
    "pretrain": "pretraining on scenes",
    "finetune_encoder": "encoder",
    "align": "alignment and end to end",
    "lora": "alignment and end to end",
}
PUBLISHED: tuple[tuple[str, float, float | None, str], ...] = (
    ("encoder, the paper's (less than 5 GB)", 360.0, 5000.0, "NVIDIA RTX A6000"),
    ("alignment and end to end, the paper's 7b", 300.0, None, "NVIDIA RTX A6000"),
    ("alignment and end to end, the paper's 13b", 390.0, None, "2 x NVIDIA RTX A6000"),
)
"""Minutes, and megabytes where it says them: Yu et al. 2024, appendix on training."""


def measure(root: Path) -> list[Row]:
    """Minutes of each training in `root`/runs, and its peak of memory: the device's, on a processor the host's.

    Raises:
        UserError: where no training is in runs/.
    """
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for file in sorted((root / RUNS).glob("*.json")):
        stage, _, key = file.stem.partition("@")
        # A variant's alignment and its LoRA make one model.
        if stage in TRAININGS:
            found[TRAININGS[stage], key].append(read_json(file))
    if not found:
        raise UserError(f"{root / RUNS}: no training ran here; run `make repro` first")
    shown = [
        (
            f"{what}, {load_params(root / PARAMS_FILE).report_name}{f' {key}' if key else ''}",
            sum(run["seconds"] for run in runs) / 60,
            max(run["peak_memory_mb"] for run in runs) * 2**20 / 1e6,
            runs[-1].get("device", "not recorded"),
        )
        for (what, key), runs in found.items()
    ]
    return [
        Row(
            question="training",
            setting=setting,
            cost=float(f"{minutes:.4g}"),
            unit="minutes",
            # To the paper's encoder, or to its 7b.
            cost_ratio=float(f"{minutes / PUBLISHED[setting.startswith('alignment')][1]:.4g}"),
            megabytes=peak and float(f"{peak:.4g}"),
            machine=device,
        )
        for setting, minutes, peak, device in [*PUBLISHED, *shown]
    ]
