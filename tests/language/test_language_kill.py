"""Language trainings that are killed by the system, or run away: what is left must be good, and what follows equal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from pipeline import training as shared
from pipeline.config import LanguageConfig, LoraTrainConfig, RuntimeConfig
from pipeline.embeddings import EmbeddingStore
from pipeline.errors import UserError
from pipeline.io import write_jsonl
from pipeline.language.training import Job, add_lora, align, assemble, finetune_lora
from pipeline.records import Question
from pipeline.training import Trained
from tests.closure import ROOT
from tests.language.shared import SMALL, language, material, questions, store

__all__ = ["language", "questions", "store"]
"""Fixtures."""
RUNTIME = RuntimeConfig(device="cpu", save_steps=2)
CONFIG = LoraTrainConfig(
    **{**SMALL.model_dump(), "epochs": 2, "samples": 10}, rank=4, alpha=8, learning_rate=1e-3, dropout=0.1
)
"""Three updates an epoch, the last of them smaller; six in all."""
CHILD = """
import os, signal, sys
from pathlib import Path
import torch
from torch.optim.optimizer import register_optimizer_step_pre_hook
from pipeline.io import read_jsonl
from pipeline.embeddings import EmbeddingStore
from pipeline.records import Question
from pipeline.config import LanguageConfig
from tests.language.test_language_kill import run
folder, weights, embeddings, kind, when = sys.argv[1:]
def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)
if when.startswith("writing"):
    save, saved = torch.save, []
    def half(value, file, *rest, **others):
        if str(file).endswith(when.split()[1]):
            saved.append(file)
            if len(saved) == 2:
                Path(file).write_bytes(b"half a file")
                die()
        return save(value, file, *rest, **others)
    torch.save = half
else:
    count = iter(range(1000))
    register_optimizer_step_pre_hook(lambda *_: die() if next(count) == int(when) else None)
questions = read_jsonl(Path(folder) / "questions.jsonl", Question)
run(kind, LanguageConfig(weights=weights), questions, EmbeddingStore(Path(embeddings)), Path(folder) / "killed")
"""


def run(kind: str, language: LanguageConfig, questions: list[Question], store: EmbeddingStore, folder: Path) -> Trained:
    """One training with its checkpoints below the folder."""
    shared.CHECKPOINTS = folder
    # Sums depend on the number of threads in their last bits, and each process would take its own.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        model, data = assemble(material(language, questions, store), 10, "test")
        if kind == "align":
            return align(model, data, CONFIG, RUNTIME, Job(kind, "x", 0))
        add_lora(model, CONFIG)
        return finetune_lora(model, data, CONFIG, RUNTIME, Job(kind, "x", 0))
    finally:
        torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def uninterrupted(
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[dict[str, Trained]]:
    before = shared.CHECKPOINTS
    folder = tmp_path_factory.mktemp("whole")
    yield {kind: run(kind, language, questions, store, folder) for kind in ("align", "lora")}
    shared.CHECKPOINTS = before


@pytest.mark.parametrize(
    ("kind", "when", "left"),
    [("align", "4", 4), ("lora", "5", 4), ("lora", "writing optimizer.pt", 2)],
)
def test_killed_by_the_system_and_resumed_ends_the_same(
    kind: str,
    when: str,
    left: int,
    uninterrupted: dict[str, Trained],
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """SIGKILL in a process of its own: right behind a checkpoint, between two, and while one is being written."""
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    write_jsonl(tmp_path / "questions.jsonl", questions)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path), language.weights, str(store.folder), kind, when],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr[-2000:]
    kept = {int(f.parent.name.split("-")[1]) for f in tmp_path.glob(f"killed/{kind}/x/*/trainer_state.json")}
    assert kept == {left}
    whole = uninterrupted[kind]
    again = run(kind, language, questions, store, tmp_path / "killed")
    assert again.history == whole.history
    assert again.state.keys() == whole.state.keys()
    for name, value in whole.state.items():
        assert torch.equal(again.state[name], value), name


def test_another_language_model_under_the_same_name_begins_anew(
    language: LanguageConfig, questions: list[Question], store: EmbeddingStore, tmp_path: Path
) -> None:
    """A checkpoint holds only what is trained: gone on with on other weights, it would be neither's."""
    weights, inputs = tmp_path / "llm", tmp_path / "train.jsonl"
    weights.mkdir()
    write_jsonl(inputs, [])
    (weights / "model.safetensors").write_bytes(b"one")
    held = material(language.model_copy(update={"weights": str(weights)}), questions, store)
    before = held.mark(SMALL, inputs)
    assert held.mark(SMALL, inputs) == before
    (weights / "model.safetensors").write_bytes(b"two")
    assert held.mark(SMALL, inputs) != before


@pytest.mark.parametrize("factor", [100, 1e30])
def test_a_rate_too_high_ends_finite_or_in_one_line(
    factor: float,
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Params allow no rate from 10 on; a model may be as badly scaled all the same."""
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    model, data = assemble(material(language, questions, store), 10, "test")
    rates = {"learning_rate": factor * 2e-4, "projection_learning_rate": factor * 2e-5}
    config = CONFIG.model_copy(update=rates)
    add_lora(model, config)
    if factor == 100:
        trained = finetune_lora(model, data, config, RUNTIME, Job("lora", "x", 0))
        assert all(v.isfinite().all() for v in trained.state.values())
        assert all(m.value < 1e3 for m in trained.history)
    else:
        with pytest.raises(UserError, match=r"^[a-z_]+ is .* at step \d: .*lower the learning rate.*kept\)$"):
            finetune_lora(model, data, config, RUNTIME, Job("lora", "x", 0))


def test_running_away_late_leaves_the_last_good_checkpoint(
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    model, data = assemble(material(language, questions, store), 10, "test")

    def log(step: int, values: dict[str, float]) -> None:
        if step == 5:
            with torch.no_grad():
                model.connector.delimiters.fill_(float("inf"))

    with pytest.raises(UserError, match="lower the learning rate"):
        align(model, data, CONFIG, RUNTIME, Job("align", "x", 0, log))
    (kept,) = tmp_path.glob("align/x/checkpoint-*")
    assert kept.name == "checkpoint-4"
    assert all(value.isfinite().all() for value in load_file(kept / "model.safetensors").values())
