"""What a scale takes, against torch's own count and figures made by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode
from transformers import LlamaForCausalLM
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.errors import UserError
from pipeline.scales import compose
from pipeline.scales.cost import Hours, costs, measured_rate, work
from pipeline.scales.memory import Lengths, count
from pipeline.weights.shapes import read_language
from tests.checkpoints import write_llama

ONE = (
    "ablation.encoders=[finetuned]",
    "ablation.lora=[with]",
    "ablation.opd=[all]",
    "align.samples=1",
    "align.epochs=1",
)


def test_a_training_s_operations_are_torch_s_own_count(tmp_path: Path) -> None:
    """Of a Llama whose weights are frozen, but not what it reads; attention's own products, which grow with the length,
    are left out."""
    folder = write_llama(tmp_path / "llama", hidden_size=128, intermediate_size=320, num_hidden_layers=3)
    model = LlamaForCausalLM.from_pretrained(folder, dtype=torch.float32)
    model.requires_grad_(False)
    shapes = read_language(folder)
    tokens = 24
    embedded = model.get_input_embeddings()(torch.zeros(1, tokens, dtype=torch.long)).requires_grad_()
    with FlopCounterMode(display=False) as counter:
        model.model(inputs_embeds=embedded).last_hidden_state.sum().backward()
    lengths = Lengths(tokens, 0, 0, mean_training=tokens, mean_answer=0, mean_prompt=0)
    found = work(compose("smoke", ONE), shapes, lengths, None, 0)
    aligned = next(h for h in found if h.stage == "align")
    assert aligned.work == pytest.approx(counter.get_total_flops(), rel=0.1)


def test_hours_are_the_longer_of_computing_and_reading() -> None:
    assert Hours("answer", 1, work=3600e12, read=0).on(1e12, 1e9) == 1
    assert Hours("answer", 1, work=3600e12, read=7200e9).on(1e12, 1e9) == 2
    assert Hours("answer", 1, work=3600e12, read=7200e9).on(1e12, None) == 1
    assert 1e8 < measured_rate(side=256, seconds=0.05) < 1e14


def test_what_is_to_be_fetched_and_what_does_not_fit_is_said() -> None:
    params = compose("paper-7b")
    uses, _ = count(params)
    said = "\n".join(costs(params, uses, "rtx4090"))
    for words in ("lmsys/vicuna-7b-v1.5, 13 GB", "lora nears 24 GiB: set lora.micro_batch_size=1", "(8 runs)"):
        assert words in said
    assert "nears" not in "\n".join(costs(params, uses, "h100"))
    larger = compose("paper-13b")
    assert "Host memory" not in said
    said = "\n".join(costs(larger, count(larger)[0], "rtx4090"))
    assert "answer exceeds 24 GiB: set language.quantization=nf4" in said
    # 13.016e9 weights of 2 bytes, by transformers' own count of this configuration.
    assert "each of 2 processes loads the whole language model (26 GB) before it keeps its share, 52.1 GB" in said
    with pytest.raises(UserError, match="--card a600: not known; did you mean a6000"):
        costs(params, uses, "a600")


def test_a_plan_needs_nothing_and_writes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.scales.write_params", lambda *_: 1 / 0)
    monkeypatch.setattr("pipeline.scales.check_inputs", lambda *_: 1 / 0)
    said = CliRunner().invoke(app, ["scale", "paper-13b", "--plan", "--card", "a6000"])
    assert said.exit_code == 0, said.output
    assert "8 variants; nothing is written." in said.output
