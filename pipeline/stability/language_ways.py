"""Two ways through the language model that must come to the same: with an adapter that does nothing or merged, beside
rows of padding or alone, token by token or all at once.

Formats and models are those of `language`. A float64 model normalises in float32 and gets float32's bound.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import torch
from torch import nn

from pipeline.language.cache import AHEAD, roomy_cache
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.runtime import seed_everything
from pipeline.stability.case import NETWORKS, Bound, Case, Dtype, Floats, exactly
from pipeline.stability.condition import magnification, rounded
from pipeline.stability.language import (
    DIM,
    LONGEST,
    PART,
    at_best_float32,
    conversation,
    logits_of,
    made,
    octopi,
    plain,
    rounded_model,
)

RANK, ALPHA = 128, 256
"""The paper's."""
WAYS = "condition: twice the model's magnification of rounded weights times roundings a layer, as two ways are compared"


def cases(llama: Path) -> list[Case]:
    """Adapters, padding and the cache.

    Args:
        llama: Folder of the language model.
    """
    return [*_adapters(llama), *_rows(llama), *_cached(llama)]


def paper_adapter(model: OctopiForCausalLM, deviation: float) -> OctopiForCausalLM:
    """With LoRA of the paper's size on its query and key projections; B normal of that deviation, 0 as fresh ones."""
    from peft import LoraConfig, get_peft_model

    seed_everything(1)
    settings = LoraConfig(r=RANK, lora_alpha=ALPHA, target_modules=["q_proj", "k_proj"], task_type="CAUSAL_LM")
    model.llm = get_peft_model(model.llm, settings).eval()
    for name, parameter in model.llm.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(parameter, std=deviation)
    return model


# Adapters


def _adapters(llama: Path) -> Iterator[Case]:
    yield Case(
        PART,
        f"fresh adapter, alpha {ALPHA}, rank {RANK}, against none",
        NETWORKS,
        partial(_fresh, llama),
        exactly("use: B = 0 is the identity, whatever alpha and rank are"),
        lambda: 0.0,
    )
    yield Case(
        PART,
        f"adapter, alpha {ALPHA}, rank {RANK}, merged against apart",
        NETWORKS,
        partial(_merged, llama),
        Bound(lambda d: 2 * _rounded_adapter(llama, d), WAYS),
        lambda: 0.0,
    )


def _fresh(llama: Path, dtype: Dtype) -> Floats:
    model = octopi(llama)
    model.llm.to(dtype.device, dtype.torch)
    model.connector.to(dtype.device)
    before = logits_of(model, dtype)
    paper_adapter(model, 0.0)
    return plain(logits_of(model, dtype) - before)


def _merged(llama: Path, dtype: Dtype) -> Floats:
    """Difference of the logits over the largest."""
    model = octopi(llama)
    model.llm.to(dtype.torch)
    paper_adapter(model, 0.02).to(dtype.device)
    apart = logits_of(model, dtype)
    model.llm = copy.deepcopy(model.llm).merge_and_unload()
    return plain((logits_of(model, dtype) - apart) / apart.abs().max())


@cache
def _adapted(llama: Path) -> float:
    model = paper_adapter(octopi(llama), 0.02).double()
    return magnification(model, lambda: logits_of(model, Dtype.FLOAT64))


def _rounded_adapter(llama: Path, dtype: Dtype) -> float:
    return rounded(_adapted(llama), LONGEST, at_best_float32(dtype))


# Padding


def _rows(llama: Path) -> Iterator[Case]:
    for side in ("left", "right"):
        yield Case(
            PART,
            f"a row of nothing but padding, padded on the {side}, beside others",
            NETWORKS,
            partial(_padded, llama, side),
            Bound(lambda d: 2 * rounded_model(llama, 1.0, d), WAYS),
            lambda: 0.0,
        )


def _padded(llama: Path, side: str, dtype: Dtype) -> Floats:
    """What the first row's logits lose by their neighbours, over the largest; NaN where any row's are not finite."""
    model = made(llama, dtype)
    ids, _ = conversation(model)
    ids = ids.clamp(max=199).to(dtype.device)
    mask, none = torch.ones_like(ids), torch.zeros(3, 0, DIM, device=dtype.device)
    mask[1] = 0
    mask[2, slice(None, 4) if side == "left" else slice(5, None)] = 0
    with torch.no_grad():
        beside, alone = model(ids, none, mask).logits, model(ids[:1], none[:1]).logits
    lost = (beside[:1] - alone) / alone.abs().max()
    return plain(torch.where(beside.isfinite().all(), lost, torch.nan))


# Cache


def _cached(llama: Path) -> Iterator[Case]:
    yield Case(
        PART,
        "token by token beyond the cache's room, against all at once",
        NETWORKS,
        partial(_stepwise, llama),
        Bound(lambda d: 2 * rounded_model(llama, 1.0, d), WAYS),
        lambda: 0.0,
    )


def _stepwise(llama: Path, dtype: Dtype) -> Floats:
    """Difference of the logits over the largest; the prompt leaves `AHEAD` places free, and more tokens follow."""
    model = made(llama, dtype)
    ids = torch.randint(4, 200, (2, 5 + AHEAD + 4), generator=torch.Generator().manual_seed(0)).to(dtype.device)
    parts = [ids[:, :5], ids[:, 5 : 5 + AHEAD - 2], *ids[:, 5 + AHEAD - 2 :].split(1, dim=1)]
    kept = roomy_cache(model.llm.config)
    with torch.no_grad():
        whole = model.llm(ids, use_cache=False).logits
        steps = [model.llm(part, past_key_values=kept, use_cache=True).logits for part in parts]
    return plain((torch.cat(steps, dim=1) - whole) / whole.abs().max())
