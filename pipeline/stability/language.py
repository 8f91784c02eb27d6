"""The language model at its edges: no, tiny and huge tactile embeddings, labels that are all ignored.

The model is the committed stand-in; the connector is random and stays float32 as in the pipeline, whatever the model's
format is, which is that of the rows. transformers normalises in float32 even in a float64 model: what the other
formats are held against is right to some 1e-7.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import cast

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.chat import IGNORE_INDEX
from pipeline.runtime import seed_everything
from pipeline.stability.case import NETWORKS, Bound, Case, Dtype, Floats, exactly, summing
from pipeline.stability.condition import magnification, rounded

PART = "language model"
DIM, FRAMES, LENGTH = 64, 4, 40
SIZES = (0.0, 1e-30, 1.0, 1e4)
"""Of tactile embeddings; at 1e4 a random connector's output is near the largest number of float16."""
LONGEST = 480
"""Terms of the longest sum in the stand-in Llama."""


def cases(llama: Path) -> list[Case]:
    """Embeddings of all sizes, and the loss of hardly any labels.

    Args:
        llama: Folder of the language model.
    """
    return [*_embeddings(llama), *_losses(llama)]


def octopi(llama: Path) -> OctopiForCausalLM:
    """A model with a random connector, in float32; equal at every call."""
    seed_everything(5)
    made = OctopiForCausalLM.from_base(llama, DIM).eval()
    nn.init.normal_(made.connector.delimiters, std=0.02)
    return made


def conversation(model: OctopiForCausalLM, rows: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Token numbers with frames among them, rows x `LENGTH`, and embeddings of noise, rows x frames x `DIM`."""
    draw = torch.Generator().manual_seed(0)
    ids = torch.randint(4, 200, (rows, LENGTH), generator=draw)
    ids[:, 3], ids[:, 4 : 4 + FRAMES], ids[:, 4 + FRAMES] = model.start_id, model.frame_id, model.end_id
    return ids, torch.randn(rows, FRAMES, DIM, generator=draw)


# Embeddings


def _embeddings(llama: Path) -> Iterator[Case]:
    for size in SIZES:
        yield Case(
            PART,
            f"connector: embeddings of {size:g}",
            NETWORKS,
            partial(_projected, llama, size),
            Bound(
                partial(_rounded_projection, llama, size),
                "roundings: two layers in float32, by the sizes of their terms (GELU's slope is at most 1.13), and the "
                "cast to the model's format",
            ),
        )
        name = f"logits after embeddings of {size:g}"
        yield Case(PART, name, NETWORKS, partial(_answered, llama, size), _condition(llama, size))


def _projected(llama: Path, size: float, dtype: Dtype) -> Floats:
    model = made(llama, dtype)
    ids, features = conversation(model)
    with torch.no_grad():
        embedded = model.embed(ids.to(dtype.device), size * features.to(dtype.device, model.connector.delimiters.dtype))
    return plain(embedded[:, 4 : 4 + FRAMES])


def _rounded_projection(llama: Path, size: float, dtype: Dtype) -> float:
    model = made(llama, Dtype.FLOAT64)
    first, _, last = (cast(nn.Linear, layer) for layer in model.connector.projection)
    features = (size * conversation(model)[1].double()).flatten(0, 1)
    with torch.no_grad():
        hidden = F.gelu(first(features)).abs()
        off = summing(DIM + 1, Dtype.FLOAT32) * (features.abs() @ first.weight.abs().T + first.bias.abs())
        off = 1.13 * off + 4 * Dtype.FLOAT32.roundoff * hidden
        sizes = (hidden + off) @ last.weight.abs().T + last.bias.abs()
        off = off @ last.weight.abs().T + summing(len(last.weight) + 1, Dtype.FLOAT32) * sizes
        largest = model.connector.projection(features).abs().max()
    return float(off.max() / largest) + dtype.roundoff


# Losses


def _losses(llama: Path) -> Iterator[Case]:
    yield Case(
        PART,
        "labels that are all ignored: loss",
        NETWORKS,
        lambda d: _loss(llama, d, ()),
        exactly("use: nothing is learnt from it"),
        lambda: 0.0,
    )
    yield Case(
        PART,
        "answers of one token: loss",
        NETWORKS,
        lambda d: _loss(llama, d, (1, LENGTH // 2, LENGTH - 1)),
        Bound(
            partial(_rounded_loss, llama),
            "condition: that of the logits; a cross-entropy moves by no more than twice what its logits do",
        ),
    )


def _loss(llama: Path, dtype: Dtype, columns: tuple[int, ...]) -> Floats:
    model = made(llama, dtype)
    ids, features = (x.to(dtype.device) for x in conversation(model))
    labels = torch.full_like(ids, IGNORE_INDEX)
    for row, column in enumerate(columns):
        ids[row, column] = labels[row, column] = model.tokenizer.eos_token_id
    with torch.no_grad():
        return plain(model(ids, features, labels=labels).loss)


def _rounded_loss(llama: Path, dtype: Dtype) -> float:
    loss = float(_loss(llama, Dtype.FLOAT64, (1, LENGTH // 2, LENGTH - 1)))
    largest = logits_of(made(llama, Dtype.FLOAT64), Dtype.FLOAT64).abs().max().item()
    return 2 * rounded_model(llama, 1.0, dtype) * largest / loss


# What cases share


@cache
def made(llama: Path, dtype: Dtype) -> OctopiForCausalLM:
    """`octopi` with its language model in a format, on that format's device; kept, so leave it as it is."""
    model = octopi(llama)
    model.llm.to(dtype.torch)
    if dtype is Dtype.FLOAT64:
        model.connector.double()
    return model.to(dtype.device)


def logits_of(model: OctopiForCausalLM, dtype: Dtype, size: float = 1.0) -> torch.Tensor:
    """Logits of the `conversation`, its embeddings multiplied by `size`: rows x length x vocabulary."""
    ids, features = conversation(model)
    with torch.no_grad():
        wanted = model.connector.delimiters.dtype
        logits = model(ids.to(dtype.device), size * features.to(dtype.device, wanted)).logits
    return cast(torch.Tensor, logits)


def _answered(llama: Path, size: float, dtype: Dtype) -> Floats:
    return plain(logits_of(made(llama, dtype), dtype, size))


@cache
def _magnified(llama: Path, size: float) -> float:
    model = made(llama, Dtype.FLOAT64)
    return magnification(model, lambda: logits_of(model, Dtype.FLOAT64, size))


def rounded_model(llama: Path, size: float, dtype: Dtype) -> float:
    """By how much of the largest the logits may be off that `logits_of` gives."""
    return rounded(_magnified(llama, size), LONGEST, at_best_float32(dtype))


def _condition(llama: Path, size: float) -> Bound:
    of: Callable[[Dtype], float] = partial(rounded_model, llama, size)
    return Bound(of, "condition: the model's magnification of rounded weights times roundings a layer")


def at_best_float32(dtype: Dtype) -> Dtype:
    """The format in which a model of that format normalises, or its own where that is shorter."""
    return Dtype.FLOAT32 if dtype is Dtype.FLOAT64 else dtype


def plain(values: torch.Tensor) -> Floats:
    """As float64 on the CPU."""
    found: Floats = values.detach().double().cpu().numpy()
    return found
