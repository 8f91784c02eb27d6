"""The language model at its edges: tactile embeddings of any size, padding, adapters that do nothing, labels that are
all ignored, losses of huge logits.

The model is the tiny Llama that the pipeline makes; the connector is random and stays float32 as in the pipeline,
whatever the model's format is, which is that of the rows. transformers normalises in float32 even in a float64 model:
what the other formats are held against is right to some 1e-7, and a float64 model gets float32's bound.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from torch import nn
from torch.nn import functional as F
from torch.nn.utils import parameters_to_vector
from transformers.modeling_outputs import CausalLMOutput

from pipeline.config import LoraTrainConfig
from pipeline.core.runtime import seed_everything
from pipeline.language.chat import IGNORE_INDEX
from pipeline.language.lora import add_lora
from pipeline.language.octopi import OctopiForCausalLM
from tests.checkpoints import model_folder
from tests.numerics.bounds import longest_sum, magnification, rounded, summing
from tests.numerics.harness import BFLOAT16, FLOAT16, FLOAT32, FLOAT64, NETWORKS, Check, Format, formats

PART = "language"
DIM, FRAMES, LENGTH = 64, 4, 40
SIZES = (0.0, 1e-30, 1.0, 1e4)
"""Of tactile embeddings; at 1e4 a random connector's output is near the largest number of float16."""
PAPER = LoraTrainConfig(samples=1, rank=128, alpha=256, dropout=0)


def octopi() -> OctopiForCausalLM:
    """A model with a random connector, in float32; equal at every call."""
    seed_everything(5)
    made = OctopiForCausalLM.from_base(model_folder("tiny-llama"), DIM).eval()
    nn.init.normal_(made.connector.delimiters, std=0.02)
    return made


@cache
def made(fmt: Format) -> OctopiForCausalLM:
    """`octopi` with its language model in a format, on that format's device; kept, so leave it as it is."""
    model = octopi()
    model.llm.to(fmt.torch)
    if fmt is FLOAT64:
        model.connector.double()
    return model.to(fmt.device)


def conversation(model: OctopiForCausalLM) -> tuple[torch.Tensor, torch.Tensor]:
    """Token numbers with frames among them, 3 x `LENGTH`, and embeddings of noise, 3 x frames x `DIM`."""
    draw = torch.Generator().manual_seed(0)
    ids = torch.randint(4, 200, (3, LENGTH), generator=draw)
    ids[:, 3], ids[:, 4 : 4 + FRAMES], ids[:, 4 + FRAMES] = model.start_id, model.frame_id, model.end_id
    delimiters = model.connector.delimiters
    features = torch.randn(3, FRAMES, DIM, generator=draw).to(delimiters.device, delimiters.dtype)
    return ids.to(delimiters.device), features


@torch.no_grad()
def answered(model: OctopiForCausalLM, size: float = 1.0) -> torch.Tensor:
    """Logits of the `conversation`, its embeddings multiplied by `size`: rows x length x vocabulary."""
    ids, features = conversation(model)
    return model(ids, size * features).logits


@cache
def magnified(size: float) -> float:
    return magnification(made(FLOAT64), lambda: answered(made(FLOAT64), size))


def network(fmt: Format, size: float = 1.0) -> float:
    """condition: the model's magnification of rounded weights times roundings a layer, by the largest logit."""
    return rounded(magnified(size), longest_sum(made(FLOAT64)), FLOAT32 if fmt is FLOAT64 else fmt)


@formats(*NETWORKS)
@pytest.mark.parametrize("size", SIZES)
def test_embeddings_of_any_size_are_projected_and_answered(check: Check, fmt: Format, size: float) -> None:
    """condition: the connector's own magnification, in float32, and the cast to the model's format."""

    @torch.no_grad()
    def projected(f: Format) -> torch.Tensor:
        ids, features = conversation(made(f))
        return made(f).embed(ids, size * features)[:, 4 : 4 + FRAMES]

    connector = made(FLOAT64).connector
    off = rounded(magnification(connector, lambda: projected(FLOAT64)), longest_sum(connector), FLOAT32)
    check(f"connector: embeddings of {size:g}", fmt, projected, off + fmt.roundoff)
    name = f"logits after embeddings of {size:g}"
    check(name, fmt, lambda f: answered(made(f), size), lambda f: network(f, size))


@formats(*NETWORKS)
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_row_of_nothing_but_padding_spoils_no_other(check: Check, fmt: Format, side: str) -> None:
    """What the first row's logits lose by its neighbours; and a loss over such rows has finite gradients."""
    model = made(fmt)
    ids = conversation(model)[0].clamp(max=199)
    mask, none = torch.ones_like(ids), torch.zeros(3, 0, DIM, device=fmt.device)
    mask[1] = 0
    mask[2, slice(None, 4) if side == "left" else slice(5, None)] = 0
    words = model.embed(ids, none).detach().requires_grad_()
    beside = model.llm(inputs_embeds=words, attention_mask=mask).logits
    with torch.no_grad():
        lost = (beside[:1] - model(ids[:1], none[:1]).logits) / beside.abs().max()
    if not beside.isfinite().all():
        lost = torch.tensor(torch.nan)
    name = f"a row of nothing but padding, padded on the {side}, beside others"
    check(name, fmt, lambda _: lost, 2 * network(fmt), 0.0)

    if fmt is FLOAT32:
        loss = F.cross_entropy(beside.mT, ids.masked_fill(mask == 0, IGNORE_INDEX))
        check(f"{name}: gradients", fmt, lambda _: torch.autograd.grad(loss, words)[0])


@formats(*NETWORKS)
def test_a_fresh_adapter_is_the_identity(check: Check, fmt: Format) -> None:
    """use: B = 0 is the identity to the bit, whatever alpha and rank are."""
    model = octopi()
    model.llm.to(fmt.torch)
    before = answered(model.to(fmt.device))
    add_lora(model, PAPER)
    name = f"fresh adapter, alpha {PAPER.alpha:g}, rank {PAPER.rank}, against none"
    check(name, fmt, lambda _: before - answered(model.to(fmt.device).eval()), 0, 0.0)


@formats(FLOAT32, BFLOAT16, FLOAT16)
def test_what_is_trained_is_float32_and_moves_as_adam_says(check: Check, fmt: Format) -> None:
    """The first step is rate x g / (|g| + eps), however small gradients g are: a half format would lose both the step
    beside the weight and an eps of 1e-8, whose loss makes 0 / 0 of a gradient of 0.

    roundings: some 8 operations on a step, and that of the weight.
    """
    model, rate = octopi(), 1e-5
    model.llm.to(fmt.torch)
    add_lora(model, PAPER)
    trained = [p for p in model.to(fmt.device).train().parameters() if p.requires_grad]
    assert {p.dtype for p in trained} == {torch.float32}
    ids, features = conversation(model)
    model(ids, features, labels=ids.masked_fill(ids > 199, IGNORE_INDEX)).loss.backward()
    for parameter in trained:
        parameter.grad.mul_(1e-6)
    before = parameters_to_vector(trained).detach().double()
    slope = torch.cat([p.grad.flatten().double() for p in trained])
    torch.optim.AdamW(trained, lr=rate, weight_decay=0).step()
    after = parameters_to_vector(trained).detach().double()
    exact = -rate * slope / (slope.abs() + 1e-8)
    bound = (8 + float(before.abs().max()) / float(exact.abs().max())) * FLOAT32.roundoff
    check("first step of Adam, gradients times 1e-6", fmt, lambda _: after - before, bound, exact.cpu().numpy())


STEPS = np.array([[0, 1, -1, 3, 3], [7, -7, 0, 0, 1], [2, 2, 2, 2, 2], [-5, 4, 4, -5, 6]])
"""Logits by multiples: one loss each of several rows, among them ties. Times a power of two they are logits that every
format holds, so that what is off is the loss alone."""
TARGETS = (3, 1, 0, 4)


@formats(*NETWORKS)
def test_labels_that_are_all_ignored_weigh_nothing(check: Check, fmt: Format) -> None:
    """use: exactly nothing is learnt, however many tokens the update counts."""
    model = made(fmt)
    ids, features = (x[:1] for x in conversation(model))
    labels = torch.full_like(ids, IGNORE_INDEX)
    losses = [model(ids, features, labels=labels, num_items_in_batch=n).loss for n in (None, torch.tensor(0), 12)]
    labels[:, 0] = 5  # Nothing foretells the first token.
    losses.append(model(ids, features, labels=labels).loss)
    check("labels that are all ignored: loss", fmt, lambda _: torch.stack(losses), 0, 0.0)
    gradients = torch.autograd.grad(torch.stack(losses).sum(), list(model.connector.parameters()))
    assert all((gradient == 0).all() for gradient in gradients)


@formats(*NETWORKS)
@pytest.mark.parametrize("power", [0, 12, 120])
def test_losses_are_cross_entropies(check: Check, monkeypatch: pytest.MonkeyPatch, fmt: Format, power: int) -> None:
    """Of a language model that says the same whatever it reads, its first column foretelling the second.

    2^120 is a three hundredth of the largest number of float32; 7 x 2^12 is near that of float16.
    roundings: exp, log, sums over classes and rows, in float32 at least, by the spread of logits over the loss.
    """
    if fmt is Format.FLOAT16 and power > 12:
        pytest.skip("beyond float16")
    logits = STEPS * 2.0**power
    losses = logsumexp(logits, axis=1) - logits[np.arange(len(STEPS)), TARGETS]
    exact = math.fsum(losses) / len(losses)
    bound = summing(sum(STEPS.shape) + 6, fmt if fmt is FLOAT64 else FLOAT32) * (float(np.ptp(logits)) / exact + 1)
    said = torch.from_numpy(logits)[:, None].expand(-1, 2, -1).to(fmt.device, fmt.torch)
    model = made(fmt)
    monkeypatch.setattr(
        model.llm, "forward", lambda logits_to_keep, **_: CausalLMOutput(logits=said[:, logits_to_keep])
    )
    ids = torch.tensor([[1, target] for target in TARGETS], device=fmt.device)
    labels = ids.clone()
    labels[:, 0] = IGNORE_INDEX
    loss = model(ids, torch.zeros(len(ids), 0, DIM, device=fmt.device), labels=labels).loss
    check(f"loss of answers, logits of 2^{power}", fmt, lambda _: loss, bound, exact)
