"""What the trainings of the last reproduction took, beside the paper's: nothing is measured again."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from benchmarks.table import Row, make_rows
from pipeline.config.params import PARAMS_FILE, load_params
from pipeline.core.errors import UserError
from pipeline.core.io import read_json
from pipeline.core.stage import RUNS

ENCODER, LANGUAGE = "training an encoder", "training a language model"
TRAININGS = {"pretrain": ENCODER, "finetune_encoder": ENCODER, "align": LANGUAGE, "lora": LANGUAGE}
PUBLISHED: dict[str, dict[str, tuple[float, float | None, str]]] = {
    ENCODER: {"the paper's encoder (less than 5 GB)": (360.0, 5000.0, "NVIDIA RTX A6000")},
    LANGUAGE: {
        "the paper's 7b": (300.0, None, "NVIDIA RTX A6000"),
        "the paper's 13b": (390.0, None, "2 x NVIDIA RTX A6000"),
    },
}
"""Minutes, megabytes where it says them, the device: Yu et al. 2024, section V-C. Ratios are to the first."""


def measure(root: Path) -> list[Row]:
    """Minutes of each training in `root`/runs, and its peak of memory: the device's, on a processor the host's.

    Raises:
        UserError: where no training is in runs/.
    """
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for file in sorted((root / RUNS).glob("*.json")):
        stage, _, key = file.stem.partition("@")
        if stage in TRAININGS:
            # A variant's alignment and its LoRA make one model.
            name = key if TRAININGS[stage] == LANGUAGE else f"{stage} {key}".strip()
            found[TRAININGS[stage], name].append(read_json(file))
    if not found:
        raise UserError(f"{root / RUNS}: no training ran here; run `make repro` first")
    report, rows = load_params(root / PARAMS_FILE).report_name, list[Row]()
    for question, published in PUBLISHED.items():
        known = dict(published)
        for (kind, name), runs in found.items():
            if kind == question:
                minutes, peak = sum(r["seconds"] for r in runs) / 60, max(r["peak_memory_mb"] for r in runs)
                known[f"{report}, {name}"] = minutes, peak * 2**20 / 1e6, runs[-1].get("device", "not recorded")
        made = make_rows(
            question,
            {name: [minutes] for name, (minutes, _, _) in known.items()},
            unit="minutes",
            baseline=next(iter(published)),
            counts={name: {"megabytes": peak} for name, (_, peak, _) in known.items() if peak is not None},
        )
        rows += [row.model_copy(update={"machine": known[row.setting][2]}) for row in made]
    return rows
