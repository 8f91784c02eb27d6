"""Language trainings: what learns how fast, kills from which they resume to the bit, and rates that are too high."""

import itertools
import math
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch.optim.optimizer import Optimizer, register_optimizer_step_pre_hook

from pipeline.config import LanguageConfig, LoraTrainConfig, RuntimeConfig
from pipeline.core.io import read_jsonl, write_jsonl
from pipeline.core.layout import embeddings_dir, questions_file
from pipeline.core.records import Encoder, Opd, Question
from pipeline.language.chat import IGNORE_INDEX
from pipeline.language.lora import add_lora
from pipeline.language.training import Job, Material, assemble, fit, write_model_card
from pipeline.scales import compose
from pipeline.training.embeddings import STATISTICS_FILE, EmbeddingStore
from pipeline.training.trainer import Trained
from tests.checkpoints import contents, write_llama
from tests.conftest import ROOT, Begun, refused
from tests.language.conftest import (
    DIM,
    SMALL,
    adapted,
    assert_comes_back,
    embedded,
    material,
    stored,
    taking,
    train,
)

CPU = RuntimeConfig(device="cpu")
CONFIG = LoraTrainConfig(
    **{**SMALL.model_dump(), "epochs": 2, "samples": 10}, rank=4, alpha=8, learning_rate=1e-3, dropout=0.1
)
"""Three updates an epoch, the last of them smaller; six in all."""


def run(kind: str, held: Material, folder: Path) -> Trained:
    # Sums depend on the number of threads in their last bits, and each process would take its own.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return train(Job(kind, "x", 0), held, CONFIG, folder)
    finally:
        torch.set_num_threads(threads)


def killed(kind: str, when: str, questions: Path, weights: str, embeddings: Path, folder: Path) -> None:
    """A training that is killed before an update, or while it writes a file of its second checkpoint."""
    save, count = torch.save, itertools.count(1)

    def die(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def half(value: object, file: str | Path, *rest: object, **others: object) -> None:
        if str(file).endswith(when) and next(count) == 2:
            Path(file).write_bytes(b"half a file")
            die()
        save(value, file, *rest, **others)

    if when.isdigit():
        register_optimizer_step_pre_hook(lambda *_: die() if next(count) == int(when) else None)
    else:
        torch.save = half
    held = material(LanguageConfig(weights=weights), read_jsonl(questions, Question), EmbeddingStore(embeddings))
    run(kind, held, folder)


@pytest.mark.parametrize(("kind", "when", "left"), [("align", "6", 4), ("lora", "optimizer.pt", 2)])
def test_killed_and_resumed_ends_the_same(kind: str, when: str, left: int, held: Material, checkpoints: Path) -> None:
    """By SIGKILL between two checkpoints, and while one is being written."""
    write_jsonl(checkpoints / "questions.jsonl", held.questions)
    given = (checkpoints / "questions.jsonl", held.language.weights, held.store.folder, checkpoints / "killed")
    process = multiprocessing.get_context("spawn").Process(target=killed, args=(kind, when, *given))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    kept = {int(f.parent.name.split("-")[1]) for f in checkpoints.glob(f"killed/{kind}/*/*/trainer_state.json")}
    assert kept == {left}
    whole = run(kind, held, checkpoints / "whole")
    again = run(kind, held, checkpoints / "killed")
    assert again.history == whole.history
    assert again.state.keys() == whole.state.keys()
    assert all(torch.equal(again.state[name], value) for name, value in whole.state.items())
    hook = register_optimizer_step_pre_hook(lambda *_: pytest.fail("trained again"))
    ended = run(kind, held, checkpoints / "killed")
    hook.remove()
    assert ended.history == whole.history, "what is trained waits for the stage to write it"


def test_a_checkpoint_s_key_has_each_input(held: Material, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    weights, catalogue = tmp_path / "weights", tmp_path / "catalogue"
    embeddings, asked = embeddings_dir(Encoder.FINETUNED, 0), questions_file(0, "train")
    shutil.copytree(ROOT / "pipeline" / "physiclear", catalogue)
    shutil.copytree(held.store.folder, embeddings)
    weights.mkdir()
    (weights / "model.safetensors").write_bytes(b"one")
    write_jsonl(asked, held.questions)
    params = compose("smoke", [f"language.weights={weights}", f"data.catalogue={catalogue}"], ROOT / "conf")

    def key() -> str:
        return Material.load(params, Encoder.FINETUNED, Opd.ALL, 0).fingerprint(SMALL)

    keys = [key()]
    assert key() == keys[0]
    write_jsonl(asked, held.questions[1:])
    keys.append(key())
    for file in (weights / "model.safetensors", embeddings / STATISTICS_FILE, catalogue / "properties.yaml"):
        file.write_bytes((file.read_bytes() if file.exists() else b"") + b"# another\n")
        keys.append(key())
    assert len(set(keys)) == 5


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_what_is_trained_is_float32_and_comes_back(dtype: str, held: Material, checkpoints: Path) -> None:
    language = held.language.model_copy(update={"dtype": dtype})
    model, data = assemble(replace(held, language=language), taking(8), "test")
    add_lora(model, CONFIG)
    fit(model, data, CONFIG, CPU, Job("lora", "x", 0))
    for name, parameter in model.named_parameters():
        assert parameter.dtype == (torch.float32 if parameter.requires_grad else getattr(torch, dtype)), name
    model.save_pretrained(checkpoints / "saved")
    saved = load_file(checkpoints / "saved" / "adapter" / "adapter_model.safetensors")
    assert {v.dtype for v in saved.values()} == {getattr(torch, dtype)}, "written in the base's format"
    assert_comes_back(model, checkpoints / "saved", dtype=dtype)


def test_training_goes_on_from_a_trained_model(held: Material, checkpoints: Path, tmp_path: Path) -> None:
    """Its connector and adapter are those that alignment begins with, frozen, and that LoRA trains on."""
    begun = assemble(held, CONFIG, "test")[0]
    adapted(begun, CONFIG).save_pretrained(tmp_path / "begun" / "language")
    went_on = replace(held, language=held.language.model_copy(update={"start": str(tmp_path / "begun")}))
    model, data = assemble(went_on, CONFIG, "align")
    before = {name: value.clone() for name, value in model.named_parameters()}
    for name, value in begun.named_parameters():
        assert torch.equal(before[name], value), name
    fit(model, data, SMALL, CPU, Job("align", "x", 0))
    changed = {name for name, value in model.named_parameters() if not torch.equal(before[name], value)}
    assert {name.split(".")[0] for name in changed} == {"connector"}
    with refused(r"lora.target_modules: the adapter to train on has \[k_proj,q_proj\]; set lora.target_modules=\["):
        add_lora(model, CONFIG.model_copy(update={"target_modules": "all-linear"}))
    add_lora(model, CONFIG)
    fit(model, data, CONFIG, CPU, Job("lora", "x", 0))
    after = {name for name, value in model.named_parameters() if not torch.equal(before[name], value)}
    assert {name for name in before if "lora_" in name} <= after
    assert not {name for name in after if name.startswith("llm") and "lora_" not in name}
    other = replace(went_on, store=stored(tmp_path / "other", [("a_0", 0, "none")], torch.zeros(1, DIM + 1)))
    with refused(f"begun reads embeddings of {DIM}, but the encoder gives {DIM + 1}; set encoder.backbone"):
        assemble(other, CONFIG, "align")


@pytest.mark.parametrize(
    ("micro", "weighting", "words"), [(4, "question", False), (2, "token", True), (1, "question", False)]
)
def test_an_updates_gradient_is_that_of_its_questions_one_at_a_time(
    micro: int, weighting: str, words: bool, held: Material, checkpoints: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Updates of four, four and one, by a plain loop in float64 over tokens, without batches, padding or a cache.

    Frames are drawn anew in the second epoch. Word embeddings may be trained, also those that all questions begin with.
    """
    order = [7, 0, 1, 2, 8, 3, 4, 5, 6]
    monkeypatch.setattr("pipeline.language.training.UpdateSampler", lambda *_, **__: order)
    own = {"epochs": 2, "samples": 9, "max_grad_norm": 0.0, "weighting": weighting}
    config = LoraTrainConfig(**{**SMALL.model_dump(), **own})
    model, data = assemble(held, config, "test")
    matrix = model.train_words() if words else model.llm.get_input_embeddings()
    parameters, gaps, counts, drawn = [p for p in model.double().parameters() if p.requires_grad], [], [], []

    def loss(update: list[int]) -> torch.Tensor:
        total, whole = torch.zeros(()).double(), 0.0
        for index in update:
            ids, labels = data[index]["input_ids"].tolist(), data[index]["labels"].tolist()
            row = embedded(model, ids, data[index]["features"].double(), matrix.weight)
            said = model.llm(inputs_embeds=row[None]).logits[0].log_softmax(-1)
            learnt = [place for place, label in enumerate(labels) if label != IGNORE_INDEX]
            counts.append(len(learnt))
            share = len(learnt) if weighting == "question" else 1.0
            total = total - sum(said[place - 1, labels[place]] for place in learnt) / share
            whole += len(learnt) / share
        return total / whole

    @torch.enable_grad()
    def compare(*_: object) -> None:
        start = 4 * (len(gaps) % 3)
        update = order[start : start + 4]
        drawn.append(data[order[0]]["features"])
        wanted = torch.cat([g.flatten() for g in torch.autograd.grad(loss(update), parameters)])
        found = torch.cat([p.grad.flatten() for p in parameters])
        gaps.append(float((found - wanted).abs().max() / wanted.abs().max()))

    kept = register_optimizer_step_pre_hook(compare)
    fit(model, data, config.model_copy(update={"micro_batch_size": micro}), CPU, Job("align", "x", 0))
    kept.remove()
    assert len(data) == 9
    assert max(counts) > 3 * min(counts), "or either weighting would do"
    assert not torch.equal(drawn[0], drawn[3])
    assert len(gaps) == 6
    # transformers' normalisation computes in float32 whatever it is given.
    assert max(gaps) < 2e-6, gaps


def test_a_training_is_not_gone_on_with_by_another_version_of_the_code(
    held: Material, checkpoints: Path, versions: Callable[[str], None], begun_in: Begun
) -> None:
    places = []
    for file in ("report/page.py", "report/build.py", "training/trainer.py", "language/base.py"):
        versions(f"pipeline/{file}")
        places.append(begun_in(lambda: run("lora", held, checkpoints)))
    assert places[0] == places[1], "it does not depend on reports"
    assert len(set(places)) == 3


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("ACCELERATE_MIXED_PRECISION", "bf16", "ACCELERATE_MIXED_PRECISION is bf16"),
        ("ACCELERATE_USE_FSDP", "true", "FSDP_VERSION is 1"),
        ("WORLD_SIZE", "3", "micro_batch_size 2 on 3 devices does not divide batch_size 4"),
    ],
)
def test_accelerate_may_not_compute_otherwise_than_the_parameters_say(
    name: str, value: str, words: str, held: Material, checkpoints: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    with refused(words):
        run("align", held, checkpoints)


@pytest.mark.parametrize("tied", [False, True])
def test_words_are_trained_and_the_base_is_not(tied: bool, held: Material, tmp_path: Path, checkpoints: Path) -> None:
    """Also where the base pads with a word, and its matrix is its head too."""
    folder = write_llama(tmp_path / "base", tie_word_embeddings=tied, pad_token_id=1)
    model, data = assemble(replace(held, language=LanguageConfig(weights=str(folder))), taking(4), "test")
    base = {n: p.detach().clone() for n, p in model.llm.named_parameters()}
    start = model.train_words().weight.detach().clone()
    fit(model, data, SMALL.model_copy(update={"epochs": 1}), CPU, Job("align", "x", 0))
    changed = set((model.words.weight != start).any(1).nonzero().flatten().tolist())
    assert len(changed) > 20
    assert 1 in changed, "which pads"
    assert changed <= set(torch.cat([each["input_ids"] for each in data.written]).tolist())
    assert all(torch.equal(p, base[n]) for n, p in model.llm.named_parameters())


def test_adapters_go_on_with_the_words_that_alignment_trained(held: Material, checkpoints: Path) -> None:
    held = replace(held, language=held.language.model_copy(update={"dtype": "bfloat16"}))
    folder = checkpoints / "aligned"
    model, data = assemble(held, taking(4), "test")
    model.train_words()
    model.save_pretrained(folder, fit(model, data, SMALL, CPU, Job("align", "x", 0)).state)
    aligned = load_file(folder / "words.safetensors")["weight"]
    assert aligned.dtype == torch.float32
    model, data = assemble(held, taking(8), "test", folder)
    assert torch.equal(model.words.weight, aligned)
    add_lora(model, CONFIG)
    trained = fit(model, data, CONFIG, CPU, Job("lora", "x", 0))
    assert not torch.equal(trained.state["words.weight"], aligned)
    model.save_pretrained(checkpoints / "saved", trained.state)
    again = assert_comes_back(model, checkpoints / "saved", dtype="bfloat16")
    again.save_pretrained(checkpoints / "once more")
    assert contents(checkpoints / "once more") == contents(checkpoints / "saved")
    assert not any("embed" in n for n in load_file(checkpoints / "saved" / "adapter" / "adapter_model.safetensors"))
    write_model_card(checkpoints / "saved", held, data, CONFIG)
    assert "| trained word embeddings | all |" in (checkpoints / "saved" / "README.md").read_text()


def test_a_projection_without_schedule_keeps_its_rate(held: Material, checkpoints: Path) -> None:
    """Eight questions make two updates an epoch; the rest of what is trained warms up for two of six, then falls."""
    rates = {"learning_rate": 2e-3, "projection_schedule": "constant", "warmup_ratio": 1 / 3}
    config = CONFIG.model_copy(update={**rates, "epochs": 3})
    model, data = assemble(held, taking(8), "test")
    model.train_words()
    add_lora(model, config)
    used: list[dict[str, float]] = []

    def note(optimizer: Optimizer, *_: object) -> None:
        rates = {id(p): group["lr"] for group in optimizer.param_groups for p in group["params"]}
        used.append({n: rates[id(p)] for n, p in model.named_parameters() if p.requires_grad})

    handle = register_optimizer_step_pre_hook(note)
    fit(model, data, config, CPU, Job("lora", "x", 0))
    handle.remove()
    shares = [0, 1 / 2, *((1 + math.cos(math.pi * step / 4)) / 2 for step in range(4))]
    for rates, share in zip(used, shares, strict=True):
        for name, rate in rates.items():
            own = config.learning_rate if "lora_" in name else config.projection_learning_rate
            assert rate == pytest.approx(own if "projection" in name else own * share, abs=1e-12), name
