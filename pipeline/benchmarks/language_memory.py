"""Peak memory of training and answering at sizes that need not be there: what has to be held at once, in bytes.

Held are the frozen weights in bfloat16; of what is trained the weight, its gradient and Adam's two moments in float32;
what autograd keeps for the backward pass; in generation, keys and values. What autograd keeps is not estimated: torch
runs the language model without its numbers (`FakeTensorMode`), and the tensors that it keeps are added up. Two models
of one and of two layers suffice, since each layer keeps as much as any other. What a single operation needs besides is
left out, so that all of this is a bound from below.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from peft import LoraConfig, get_peft_model
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.func import functional_call
from torch.nn import functional as F
from transformers import AutoModelForCausalLM, LlamaConfig

from pipeline.benchmarks.language_counts import LOWEST, Batch, Llama

TRAINED = 4 * 4
"""Bytes of a trained number: itself, its gradient and Adam's two moments, in float32."""


@dataclass(frozen=True)
class Kept:
    """Bytes that autograd keeps of one batch."""

    layer: int
    """In each layer."""
    entry: int
    """What comes into each layer: all that gradient checkpointing keeps of it."""
    rest: int
    """Behind the last layer: logits and loss."""

    def total(self, layers: int, again: bool) -> int:
        """At the fullest moment; with gradient checkpointing (`again`), while one layer is being run again."""
        return self.rest + (layers * self.entry + self.layer if again else layers * self.layer)


@cache
def kept(llama: Llama, batch: Batch, rank: int = 0) -> Kept:
    """What a batch's forward pass keeps; with a rank, through adapters on q_proj and k_proj."""
    one, two = (_kept_by(llama, layers, batch, rank) for layers in (1, 2))
    return Kept(two - one, LOWEST * batch.rows * batch.length * llama.hidden, one - (two - one))


def _kept_by(llama: Llama, layers: int, batch: Batch, rank: int) -> int:
    config = LlamaConfig(
        hidden_size=llama.hidden,
        intermediate_size=llama.ffn,
        num_hidden_layers=layers,
        num_attention_heads=llama.heads,
        num_key_value_heads=llama.kv_heads,
        head_dim=llama.head_size,
        vocab_size=llama.vocabulary,
    )
    with torch.device("meta"):
        model: torch.nn.Module = AutoModelForCausalLM.from_config(config, dtype=torch.bfloat16).requires_grad_(False)
        if rank:
            form = LoraConfig(r=rank, lora_alpha=2 * rank, lora_dropout=0.05, target_modules=["q_proj", "k_proj"])
            model = get_peft_model(model, form)
    # As if on the CPU, whose own kernel of attention keeps no scores, like a card's.
    with FakeTensorMode():
        tensors = {
            name: torch.empty(t.shape, dtype=t.dtype, requires_grad=t.requires_grad)
            for name, t in (*model.named_parameters(), *model.named_buffers())
        }
        embeddings = torch.empty(batch.rows, batch.length, llama.hidden, dtype=torch.bfloat16, requires_grad=True)
        return kept_of(model.train(), tensors, embeddings, batch.logits // batch.rows)


def kept_of(model: torch.nn.Module, tensors: dict[str, torch.Tensor], embeddings: torch.Tensor, logits: int) -> int:
    """Bytes that autograd keeps of a forward pass with a loss over each row's last tokens.

    Args:
        model: A causal language model of transformers.
        tensors: Its parameters and buffers by name, which do not count.
        embeddings: rows x length x hidden.
        logits: Tokens a row whose logits are computed.
    """
    held = {t.untyped_storage()._cdata for t in tensors.values()}
    found: dict[int, torch.UntypedStorage] = {}

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        found[storage._cdata] = storage
        return tensor

    call = {"inputs_embeds": embeddings, "use_cache": False, "logits_to_keep": logits}
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        out = functional_call(model, tensors, kwargs=call).logits.float().flatten(0, 1)
        F.cross_entropy(out, torch.zeros(len(out), dtype=torch.long))
    return sum(storage.nbytes() for name, storage in found.items() if name not in held)


def training_bytes(llama: Llama, batch: Batch, rank: int = 0, again: bool = False, tower: int = 0) -> int:
    """Peak of training on batches like this one.

    Args:
        again: Gradient checkpointing.
        tower: Weights of a visual tower that is held beside.
    """
    return (
        LOWEST * (_frozen(llama) + tower)
        + TRAINED * (_connector(llama) + rank * llama.adapted)
        + kept(llama, batch, rank).total(llama.layers, again)
    )


def answering_bytes(llama: Llama, rows: int, tokens: int, tower: int = 0) -> int:
    """Peak of answering so many questions at once, the last new token read: `tokens` a row, prompt and answer."""
    cached = 2 * rows * tokens * llama.layers * llama.kv_heads * llama.head_size
    return LOWEST * (_frozen(llama) + tower + cached) + 4 * _connector(llama)


def _frozen(llama: Llama) -> int:
    return llama.weights + llama.hidden * llama.vocabulary


def _connector(llama: Llama) -> int:
    return llama.hidden * (llama.tactile + llama.hidden)
