"""Losses at their edges: logits from 0 to nearly the largest number of float32, right and wrong, and classes that tie.

The language model's loss is taken in float32 of logits in the model's format; the classifier's and the lessons' are
float32. Logits are whole multiples of a power of two, which every format holds: what is off is the loss alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import nn
from transformers import PreTrainedModel
from transformers.modeling_outputs import CausalLMOutput

from pipeline.language.octopi import OctopiForCausalLM
from pipeline.encoder.scene_encoder import LessonModel, SceneEncoder
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.language.chat import IGNORE_INDEX
from pipeline.runtime import seed_everything
from pipeline.stability.case import NETWORKS, SOLVED, Bound, Case, Dtype, Floats, summing
from pipeline.stability.language import made, plain

PART = "loss"
SCALES = (0, 5, 60, 120)
"""Powers of two that logits are multiples of; 2^120 is a three hundredth of the largest number of float32."""
LARGEST_FLOAT16 = 12
"""The same for float16, whose largest number is below 2^16."""
STEPS = np.array([[0, 1, -1, 3, 3], [7, -7, 0, 0, 1], [2, 2, 2, 2, 2], [-5, 4, 4, -5, 6]])
"""Logits by multiples: one loss each of several rows, among them ties."""
TARGETS = (3, 1, 0, 4)


def cases(llama: Path) -> list[Case]:
    """Cross-entropies of answers and of properties, and the lessons' two losses.

    Args:
        llama: Folder of the language model.
    """
    return [*_answers(llama), *_properties(), *_lessons()]


def logits(power: int) -> Floats:
    """`STEPS` times 2^power: 4 x 5."""
    return np.asarray(STEPS * 2.0**power)


def cross_entropy(values: Floats, target: int) -> float:
    """log sum exp z - z of the target, with exact sums; rounded only by exp, log and the end."""
    top = float(values.max())
    return math.log(math.fsum(math.exp(z - top) for z in values.tolist())) + (top - float(values[target]))


# Answers


class _Said(nn.Module):
    """In the place of a language model: says the same logits whatever it reads."""

    def __init__(self, values: torch.Tensor, reads: PreTrainedModel) -> None:
        super().__init__()
        self.values, self.reads = values, reads

    def get_input_embeddings(self) -> nn.Module:
        """Those of the model in whose place it is."""
        return cast(nn.Module, self.reads.get_input_embeddings())

    def forward(self, logits_to_keep: torch.Tensor, **_: object) -> CausalLMOutput:
        """Some columns of what it says, as a language model would be asked."""
        return CausalLMOutput(logits=self.values[:, logits_to_keep])


def _answers(llama: Path) -> Iterator[Case]:
    for power in SCALES:
        dtypes = NETWORKS if power <= LARGEST_FLOAT16 else tuple(d for d in NETWORKS if d is not Dtype.FLOAT16)
        yield Case(
            PART,
            f"answers, logits of 2^{power}",
            dtypes,
            partial(_answer_loss, llama, power),
            _bound(len(STEPS) + STEPS.shape[1], power),
            partial(_mean_loss, power),
        )


def _answer_loss(llama: Path, power: int, dtype: Dtype) -> Floats:
    """The mean over rows, as `OctopiForCausalLM` takes it: one labelled token a row, behind the logits for it."""
    base = made(llama, dtype)
    model = OctopiForCausalLM(base.llm, base.tokenizer, 4)
    # Two columns: what is said in the first foretells the second.
    said = torch.from_numpy(logits(power))[:, None].expand(-1, 2, -1).to(dtype.device, dtype.torch)
    model.llm = _Said(said, model.llm)
    ids = torch.tensor([[1, target] for target in TARGETS])
    labels = ids.clone()
    labels[:, 0] = IGNORE_INDEX
    model = model.to(dtype.device)
    return plain(model(ids.to(dtype.device), torch.zeros(len(ids), 0, 4), labels=labels.to(dtype.device)).loss)


def _mean_loss(power: int) -> float:
    return math.fsum(cross_entropy(z, t) for z, t in zip(logits(power), TARGETS, strict=True)) / len(TARGETS)


# Properties


class _Shown(FrameEncoder):
    """In the place of an encoder: frames are features already, in 8-bit steps around 128 times a power of two."""

    def __init__(self, dim: int, power: int, dtype: torch.dtype) -> None:
        super().__init__(dim)
        self.power, self.dtype = power, dtype

    def forward(self, frames: torch.Tensor, moments: torch.Tensor) -> torch.Tensor:
        return (frames.flatten(1).to(self.dtype) - 128) * 2.0**self.power


class _Twice(nn.Module):
    """Heads that hand on the features, once for each of two properties."""

    def forward(self, features: torch.Tensor) -> list[torch.Tensor]:
        return [features, features]


def _properties() -> Iterator[Case]:
    for power in SCALES:
        yield Case(
            PART,
            f"properties, logits of 2^{power}",
            SOLVED,
            partial(_property_loss, power),
            _bound(2 * (len(STEPS) + STEPS.shape[1]), power),
            lambda p=power: 2 * _mean_loss(p),  # type: ignore[misc]
        )


def _property_loss(power: int, dtype: Dtype) -> Floats:
    classes = STEPS.shape[1]
    model = PropertyClassifier(_Shown(classes, power, dtype.torch), _Twice(), [classes] * 2)
    frames = torch.from_numpy(STEPS + 128).to(torch.uint8)[:, None, None, None, :]
    labels = torch.tensor(TARGETS)[:, None].expand(-1, 2)
    return plain(model(frames, torch.zeros(len(frames), 1, dtype=torch.int64), labels)["loss"])


def _bound(terms: int, power: int) -> Bound:
    largest = max(_mean_loss(power), 2.0**-53)
    spread = float(np.ptp(logits(power)))
    return Bound(
        lambda d: (
            summing(terms + 6, Dtype.FLOAT64 if d is Dtype.FLOAT64 else Dtype.FLOAT32) * (spread + largest) / largest
        ),
        "roundings: exp, log and sums over classes and rows in float32, by the spread of the logits over the loss",
    )


# Lessons


def _lessons() -> Iterator[Case]:
    for size in (0.0, 2.0**13, 2.0**100):
        yield Case(
            PART,
            f"lessons, quantities and kinds off by {size:g}",
            SOLVED,
            partial(_lesson_loss, size),
            Bound(
                lambda d: summing(2 * 12 + 8, d),
                "roundings: means over twelve numbers each whose terms are all positive",
            ),
            partial(_lesson_by_hand, size),
        )


def _lesson_loss(size: float, dtype: Dtype) -> Floats:
    seed_everything(0)
    model = LessonModel(SceneEncoder(), torch.tensor([[0.0] * 3, [1.0] * 3]), 3).to(dtype.torch).eval()
    with torch.no_grad():
        # The head says `size` of everything, whatever it sees.
        last = cast(nn.Linear, model.head[-1])
        last.weight.zero_()
        last.bias.fill_(size)
        frames = torch.zeros(2, 2, 16, 16, 3, dtype=torch.uint8)
        output = model(frames, torch.zeros(2, 2, 3, dtype=dtype.torch), torch.zeros(2, 3, dtype=dtype.torch))
    return plain(torch.stack([output["quantities"], output["kinds"]]))


def _lesson_by_hand(size: float) -> Floats:
    """Huber's loss of `size`, and the cross-entropy of a logit of `size` for a flag that is not set."""
    huber = size - 0.5 if size > 1 else size * size / 2
    return np.array([huber, size + math.log1p(math.exp(-size))])
