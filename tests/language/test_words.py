"""Word embeddings that are trained: the step against plain torch, what is saved of them, and what answers with them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch.optim.optimizer import Optimizer, register_optimizer_step_pre_hook
from transformers import LlamaForCausalLM

from pipeline.config import LanguageConfig, LoraTrainConfig, RuntimeConfig
from pipeline.language.chat import IGNORE_INDEX
from pipeline.language.conversations import collate
from pipeline.language.decoding import greedy
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Job, Material, add_lora, assemble, fit, write_model_card
from tests.checkpoints import write_llama
from tests.language.shared import DIM, SMALL, assert_comes_back, digests, embedded, taking

CPU = RuntimeConfig(device="cpu")
STEP = SMALL.model_copy(update={"epochs": 1, "max_grad_norm": 0.0})
"""One update of four questions in two halves, its gradient as it is."""
LORA = LoraTrainConfig(**{**SMALL.model_dump(), "epochs": 1}, rank=4, alpha=8, learning_rate=1e-3, dropout=0.0)


def reference(model: OctopiForCausalLM, folder: Path, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Gradients of an update: each conversation alone through transformers' own Llama, embeddings put in by hand."""
    plain = LlamaForCausalLM.from_pretrained(folder, dtype=torch.float64).requires_grad_(False)
    own = {n: p.detach().clone().requires_grad_() for n, p in model.connector.named_parameters()}
    words = plain.model.embed_tokens.weight.detach().clone().requires_grad_()
    total = torch.zeros((), dtype=torch.float64)
    for ids, labels, features in zip(batch["input_ids"], batch["labels"], batch["features"], strict=True):
        row = embedded(model, ids.tolist(), features.double(), words, own)
        said = plain(inputs_embeds=row[None]).logits[0].log_softmax(-1)
        columns = (labels != IGNORE_INDEX).nonzero().flatten().tolist()
        total = total - sum(said[column - 1, labels[column]] for column in columns) / len(columns)
    (total / len(batch["labels"])).backward()
    return {name: leaf.grad for name, leaf in (*own.items(), ("words", words)) if leaf.grad is not None}


@pytest.mark.parametrize("tied", [False, True])
def test_a_step_is_that_of_plain_torch(tied: bool, held: Material, tmp_path: Path, checkpoints: Path) -> None:
    """In float64, of questions that begin alike; the base pads with a word, and its matrix may be its head too."""
    folder = write_llama(tmp_path / "base", tie_word_embeddings=tied, pad_token_id=1)
    before = digests(folder)
    setting = LanguageConfig(weights=str(folder), system_prompt="You feel.")
    model, data = assemble(replace(held, language=setting), taking(4), "test")
    model.train_words()
    model.double()
    batch = collate([data[i] for i in range(4)])
    assert model.train()._shared(batch["input_ids"], batch["labels"]) > 9
    expected = reference(model, folder, batch)
    base = {n: p.detach().clone() for n, p in model.llm.named_parameters()}
    head, start = model.llm.get_output_embeddings().weight.clone(), model.words.weight.detach().clone()
    found: dict[str, torch.Tensor] = {}

    def note(optimizer: Optimizer, *_: object) -> None:
        held = {id(p): p.grad for group in optimizer.param_groups for p in group["params"]}
        named = {**dict(model.connector.named_parameters()), "words": model.words.weight}
        found.update({name: held[id(p)].clone() for name, p in named.items()})
        assert len(held) == len(found), "nothing else is trained"

    handle = register_optimizer_step_pre_hook(note)
    fit(model, data, STEP, CPU, Job("align", "x", 0))
    handle.remove()
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        # transformers' normalisation computes in float32 whatever it is given.
        torch.testing.assert_close(found[name], gradient, atol=2e-6 * float(gradient.abs().max()), rtol=0)
    # Adam's first step, by its definition.
    moved = start - STEP.projection_learning_rate * found["words"] / (found["words"].abs() + 1e-8)
    torch.testing.assert_close(model.words.weight.detach(), moved, atol=1e-12, rtol=0)
    seen = expected["words"].abs().amax(1) > 0
    assert 20 < seen.sum() < len(seen) - 100
    assert torch.equal(model.words.weight[~seen], start[~seen])
    assert (model.words.weight[seen] != start[seen]).any(1).all()
    assert all(torch.equal(p, base[n]) for n, p in model.llm.named_parameters())
    assert torch.equal(model.llm.get_output_embeddings().weight, head)
    assert digests(folder) == before


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_adapters_go_on_with_what_alignment_trained(dtype: str, held: Material, checkpoints: Path) -> None:
    held = replace(held, language=held.language.model_copy(update={"dtype": dtype}))
    folder = checkpoints / "aligned"
    model, data = assemble(held, taking(4), "test")
    model.train_words()
    model.save_pretrained(folder, fit(model, data, STEP, CPU, Job("align", "x", 0)).state)
    aligned = load_file(folder / "words.safetensors")["weight"]
    assert aligned.dtype == torch.float32
    model, data = assemble(held, taking(8), "test", folder)
    assert torch.equal(model.words.weight, aligned)
    add_lora(model, LORA)
    trained = fit(model, data, LORA, CPU, Job("lora", "x", 0))
    assert not torch.equal(trained.state["words.weight"], aligned)
    model.save_pretrained(checkpoints / "saved", trained.state)
    again = assert_comes_back(model, checkpoints / "saved", dtype=dtype)
    again.save_pretrained(checkpoints / "once more")
    assert digests(checkpoints / "once more") == digests(checkpoints / "saved")
    assert {"words.safetensors", "adapter/adapter_model.safetensors"} < digests(checkpoints / "saved").keys()
    assert not any("embed" in n for n in load_file(checkpoints / "saved" / "adapter" / "adapter_model.safetensors"))
    write_model_card(checkpoints / "saved", held, data, LORA)
    assert "| trained word embeddings | all |" in (checkpoints / "saved" / "README.md").read_text()


@pytest.mark.parametrize("tied", [False, True])
def test_answers_are_those_of_a_llama_with_these_embeddings(tied: bool, tmp_path: Path) -> None:
    """Prompts that begin alike, read without a cache by transformers' own Llama, whose head is the old one."""
    folder = write_llama(tmp_path, tie_word_embeddings=tied)
    model = OctopiForCausalLM.from_base(folder, DIM).eval()
    torch.nn.init.normal_(model.train_words().weight, generator=torch.manual_seed(5))
    plain = LlamaForCausalLM.from_pretrained(folder)
    head = plain.lm_head.weight.detach().clone()
    plain.lm_head.weight = torch.nn.Parameter(head)
    plain.model.embed_tokens.weight = torch.nn.Parameter(model.words.weight.detach().clone())
    prompts = [[1, 50, 60, 70, 80, 90], [1, 50, 60, 71, 80, 93, 94]]
    said = greedy(model, prompts, [torch.zeros(0, DIM)] * 2, (), [8, 8])
    for prompt, tokens in zip(prompts, said, strict=True):
        ids = list(prompt)
        while len(ids) < len(prompt) + 8:
            ids.append(int(plain(torch.tensor([ids])).logits[0, -1].argmax()))
        assert tokens == ids[len(prompt) :]
    assert len({tuple(tokens) for tokens in said}) == 2


def test_a_projection_without_schedule_keeps_its_rate(held: Material, checkpoints: Path) -> None:
    """Eight questions make two updates an epoch; the rest of what is trained warms up for two of six, then falls."""
    config = LORA.model_copy(update={"epochs": 3, "projection_schedule": "constant", "warmup_ratio": 1 / 3})
    model, data = assemble(held, taking(8), "test")
    model.train_words()
    add_lora(model, config)
    named = {id(p): n for n, p in model.named_parameters()}
    used: list[dict[str, float]] = []

    def note(optimizer: Optimizer, *_: object) -> None:
        used.append({named[id(p)]: group["lr"] for group in optimizer.param_groups for p in group["params"]})

    handle = register_optimizer_step_pre_hook(note)
    fit(model, data, config, CPU, Job("lora", "x", 0))
    handle.remove()
    shares = [0, 1 / 2, *((1 + math.cos(math.pi * step / 4)) / 2 for step in range(4))]
    assert len(used) == len(shares)
    for rates, share in zip(used, shares, strict=True):
        assert rates.keys() == {n for n, p in model.named_parameters() if p.requires_grad}
        for name, rate in rates.items():
            falls = config.learning_rate if "lora_" in name else config.projection_learning_rate
            expected = config.projection_learning_rate if "projection" in name else falls * share
            assert rate == pytest.approx(expected, abs=1e-12), name
