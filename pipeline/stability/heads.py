"""Classifiers' heads at their edges: features of no length, and logits as large as float32 holds.

Heads are random. They are trained and read in float32, and so are votes; the published code's, which scale features to
length 1, are tried in every format, as a quotient by next to nothing is where short formats end.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial
from typing import cast

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.release import SHORTEST_FEATURE, PublishedHeads
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.runtime import seed_everything
from pipeline.stability.case import NETWORKS, SOLVED, Bound, Case, Dtype, Floats, summing
from pipeline.stability.encoder import CLASSES, PART

SIZES = (1e4, 1e30)
"""Of features."""
HEAVIER = (1.0, 1e4)
"""By which heads' weights are multiplied."""


def cases() -> list[Case]:
    """Features through every kind of heads."""
    return [*_features(), *_huge()]


# Features of no length


def cancelling(dtype: torch.dtype) -> torch.Tensor:
    """Two frames whose mean is exactly 0: 1 x 2 x 16."""
    frame = torch.randn(1, 1, 16, generator=torch.Generator().manual_seed(0)).to(dtype)
    return torch.cat([frame, -frame], dim=1)


def published_heads(dtype: torch.dtype) -> PublishedHeads:
    """Heads of the published code over 16 features."""
    seed_everything(0)
    return PublishedHeads(16, [3, 2]).to(dtype).eval()


def _features() -> Iterator[Case]:
    heads = published_heads(torch.float64)
    hidden = F.relu(heads.shared.bias)
    with torch.no_grad():
        expected = torch.cat(heads.properties(hidden[None]), dim=1)
        layers = [cast(nn.Linear, layer) for layer in heads.properties]
        sizes = torch.cat([layer.weight.abs() @ hidden + layer.bias.abs() for layer in layers])
    magnified = (sizes.max() / expected.abs().max()).item()
    yield Case(
        PART,
        "heads of release: mean of length 0",
        NETWORKS,
        _cancelled,
        Bound(
            lambda d: magnified * summing(hidden.numel() + 1, d),
            "roundings: the sum over the hidden layer, by the sizes of its terms",
        ),
        lambda: expected.numpy(),
    )
    for factor, length in ((0.1, 0.1), (10.0, 1.0)):
        yield Case(
            PART,
            f"heads of release: length {factor * SHORTEST_FEATURE:g} is shown as",
            NETWORKS,
            partial(_shown, factor * SHORTEST_FEATURE),
            Bound(
                partial(_normalised, factor * SHORTEST_FEATURE),
                "roundings: the feature, the least length, their quotient; and what lies below the smallest number",
            ),
            partial(np.full, 1, length),
        )


def _cancelled(dtype: Dtype) -> Floats:
    model = PropertyClassifier(FrameEncoder(16), published_heads(dtype.torch), [3, 2]).to(dtype.device)
    with torch.no_grad():
        logits = model.classify(cancelling(dtype.torch).to(dtype.device))
    return np.asarray(torch.cat(logits, dim=1).double().cpu())


def _shown(length: float, dtype: Dtype) -> Floats:
    """The length of what the hidden layer is given."""
    heads = published_heads(dtype.torch).to(dtype.device)
    shown: list[torch.Tensor] = []
    heads.shared.register_forward_pre_hook(lambda _, given: shown.append(given[0].detach().double().cpu()))
    heads(torch.tensor([[length] + [0.0] * 15], dtype=dtype.torch, device=dtype.device))
    return np.asarray(shown[0].norm(dim=1))


def _normalised(length: float, dtype: Dtype) -> float:
    # Feature and least length are each rounded to the format, which may have few digits left there.
    below = dtype.smallest / 2 * (1 / length + 1 / SHORTEST_FEATURE)
    return 6 * dtype.roundoff + 2 * below


# Huge logits


def huge_features(size: float) -> torch.Tensor:
    """Features of that size: float32, 4 x 3 x 256."""
    return size * torch.randn(4, 3, 256, generator=torch.Generator().manual_seed(0))


def huge_classifier(kind: type[PropertyClassifier], weight: float) -> PropertyClassifier:
    """Heads or votes whose weights are `weight` times as large as fresh ones."""
    seed_everything(0)
    network = SceneEncoder()
    model = FrameVotes(network, CLASSES) if kind is FrameVotes else kind(network, Heads(256, CLASSES), CLASSES)
    with torch.no_grad():
        for parameter in model.heads.parameters():
            parameter.mul_(weight)
    return model


def _huge() -> Iterator[Case]:
    for kind, size, weight in itertools.product((PropertyClassifier, FrameVotes), SIZES, HEAVIER):
        name = "votes" if kind is FrameVotes else "heads"
        yield Case(
            PART,
            f"{name}: features of {size:g}, weights times {weight:g}",
            SOLVED,
            partial(_logits, kind, size, weight),
            Bound(
                partial(_rounded_logits, kind, size, weight),
                "roundings: the mean over frames and the sum over features, by the sizes of its terms; votes take a "
                "softmax's logarithm besides, which is off by no more than twice its logits",
            ),
        )


def _logits(kind: type[PropertyClassifier], size: float, weight: float, dtype: Dtype) -> Floats:
    model = huge_classifier(kind, weight).to(dtype.torch)
    with torch.no_grad():
        return np.asarray(torch.cat(model.classify(huge_features(size).to(dtype.torch)), dim=1).double())


def _rounded_logits(kind: type[PropertyClassifier], size: float, weight: float, dtype: Dtype) -> float:
    model = huge_classifier(kind, weight).double()
    heads = [cast(nn.Linear, head) for head in model.heads.children()]
    features = huge_features(size).double()
    terms = model.standardise(features).abs().flatten(0, 1) if isinstance(model, FrameVotes) else features.abs().mean(1)
    with torch.no_grad():
        sizes = max(float((terms @ head.weight.abs().T + head.bias.abs()).max()) for head in heads)
    largest = float(np.abs(_logits(kind, size, weight, Dtype.FLOAT64)).max())
    return (2 if kind is FrameVotes else 1) * summing(256 + 4, dtype) * sizes / largest
