"""What the trainings of the last reproduction took, beside the paper's: nothing is measured again."""

from __future__ import annotations

from contextlib import chdir
from pathlib import Path

from benchmarks.table import Row, make_rows
from pipeline.config.params import load_params
from pipeline.running.errors import UserError
from pipeline.tracking.chain import ChainStage, read_stages

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
        UserError: where dvc.lock has none that ran here.
    """
    found = {question: dict[str, list[ChainStage]]() for question in PUBLISHED}
    with chdir(root):
        stages = read_stages(params := load_params())
    for title, last in sorted(stages.items()):
        stage, _, key = title.partition("@")
        if stage in TRAININGS and last.ran:
            # A variant's alignment and its LoRA make one model.
            name = key if TRAININGS[stage] == LANGUAGE else f"{stage} {key}".strip()
            found[TRAININGS[stage]].setdefault(name, []).append(last)
    if not any(found.values()):
        raise UserError(f"{root}: no training ran here; run `make repro` first")
    rows = list[Row]()
    for question, published in PUBLISHED.items():
        known = dict(published)
        for name, runs in found[question].items():
            minutes = sum(run.metrics["system/seconds"] for run in runs) / 60
            peak = max(run.metrics["system/peak_memory_mb"] for run in runs)
            known[f"{params.report_name}, {name}"] = minutes, peak * 2**20 / 1e6, runs[-1].device
        made = make_rows(
            question,
            {name: [minutes] for name, (minutes, _, _) in known.items()},
            unit="minutes",
            baseline=next(iter(published)),
            counts={name: {"megabytes": peak} for name, (_, peak, _) in known.items() if peak is not None},
        )
        rows += [row.model_copy(update={"machine": known[row.setting][2]}) for row in made]
    return rows
