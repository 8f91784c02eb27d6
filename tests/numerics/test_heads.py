"""Classifiers at their edges: features of no length, logits as large as float32 holds, decisions that tie.

Heads are random. They are trained and read in float32; the published code's, which scale features to length 1, are
tried in every format, as a quotient by next to nothing is where short formats end. The joint decision is float64
whatever it is given, and held against a search in exact fractions, so that its bound is 0: no decision may change.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from pipeline.core.runtime import seed_everything
from pipeline.encoder.frame_classifier import JointFrameClassifier, decode_jointly
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.encoder.release import PublishedHeads
from pipeline.encoder.scene_encoder import SceneEncoder
from tests.numerics.bounds import summing
from tests.numerics.harness import FLOAT16, FLOAT64, NETWORKS, SOLVED, Check, Format, formats

PART = "heads"
CLASSES = (3, 3, 3)


@formats(*NETWORKS)
def test_features_of_length_0_are_classified(check: Check, fmt: Format) -> None:
    """And learnt from. roundings: the sum over the hidden layer, by the sizes of its terms."""

    def published_heads(f: Format) -> PublishedHeads:
        seed_everything(0)
        return PublishedHeads(16, [3, 2]).to(f.torch).eval()

    heads = published_heads(FLOAT64)
    hidden = F.relu(heads.shared.bias)
    with torch.no_grad():
        exact = torch.cat(heads.properties(hidden[None]), dim=1)
        sizes = torch.cat([layer.weight.abs() @ hidden + layer.bias.abs() for layer in heads.properties])

    def classified(f: Format) -> torch.Tensor:
        model = PropertyClassifier(FrameEncoder(16), published_heads(f), [3, 2]).to(f.device)
        frame = torch.randn(1, 1, 16, generator=torch.Generator().manual_seed(0)).to(f.device, f.torch)
        features = torch.cat([frame, -frame], dim=1).requires_grad_()  # Their mean is exactly 0.
        logits = torch.cat(model.classify(features), dim=1)
        F.cross_entropy(logits.float(), torch.tensor([2], device=f.device)).backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in model.heads.parameters())
        # Of the features it is up to 1 / release.SHORTEST_FEATURE times as large, which float16 does not hold.
        assert f is FLOAT16 or features.grad.isfinite().all()
        return logits

    bound = (sizes.max() / exact.abs().max()).item() * summing(hidden.numel() + 1, fmt)
    check("heads of release: mean of length 0", fmt, classified, bound, exact.numpy())


@formats(*SOLVED)
@pytest.mark.parametrize("weight", [1.0, 1e4])
@pytest.mark.parametrize("size", [1e4, 1e30])
@pytest.mark.parametrize("joint", [False, True])
def test_huge_logits_are_decided_on(check: Check, joint: bool, size: float, weight: float, fmt: Format) -> None:
    """Of heads whose weights are `weight` times as large as fresh ones, of whole videos or (joint) of single frames.

    roundings: the mean over frames and the sum over features, by the sizes of its terms. Heads of single frames clip
    features, so that there it is the weights that count; they take a softmax's logarithm besides, which is off by no
    more than twice its logits.
    """

    def classifier(f: Format) -> PropertyClassifier:
        seed_everything(0)
        network = SceneEncoder()
        heads = JointFrameClassifier(network, CLASSES) if joint else Heads(256, CLASSES)
        model = heads if joint else PropertyClassifier(network, heads, CLASSES)
        with torch.no_grad():
            for parameter in model.heads.parameters():
                parameter.mul_(weight)
        return model.to(f.torch)

    features = size * torch.randn(4, 3, 256, generator=torch.Generator().manual_seed(0), dtype=torch.float32)

    def said(f: Format) -> torch.Tensor:
        return torch.cat(classifier(f).classify(features.to(f.torch)), dim=1).detach()

    exact, double, wild = said(FLOAT64), classifier(FLOAT64), features.double()
    terms = double.standardise(wild).abs().flatten(0, 1) if joint else wild.abs().mean(1)
    sizes = max((terms @ head.weight.abs().T + head.bias.abs()).max().item() for head in double.heads.children())
    bound = (2 if joint else 1) * summing(256 + 4, fmt) * sizes / float(exact.abs().max())
    name = "frame heads" if joint else "heads"
    check(f"{name}: features of {size:g}, weights times {weight:g}", fmt, said, bound)

    model, given = classifier(fmt), features.to(fmt.torch).requires_grad_()
    found = model.classify(given)
    torch.stack([F.cross_entropy(z, torch.tensor([0, 1, 2, 0])) for z in found]).sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert given.grad.isfinite().all()
    decided = model.decide(torch.cat(found, dim=1).detach())
    assert torch.equal(decided, torch.stack([z.argmax(1) for z in exact.split(CLASSES, dim=1)], dim=1))


TABLES: dict[str, Sequence[Sequence[float]]] = {
    "all classes alike": ((0.5, 0.5), (0.5, 0.5)),
    "certain": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "tie of two combinations": ((0.25, 0.5, 0.25), (0.5, 0.5, 0.0)),
    "too small for float32": ((1e-300, 1e-200), (1e-100, 1.0)),
    "the smallest numbers": ((5e-324, 1e-320), (5e-324, 1.0)),
    "every combination impossible": ((0.0, 0.0), (0.5, 0.5)),
    "a single class": ((1.0,), (1.0,)),
    "a rounding apart": ((0.5, 0.5 + 2**-40), (0.5 + 2**-39, 0.5)),
}
"""One video's probabilities of each class, by property."""


@pytest.mark.parametrize("name", TABLES)
def test_decisions_are_those_of_exact_fractions(check: Check, name: str) -> None:
    table = TABLES[name]
    shape = tuple(map(len, table))
    best = max(
        itertools.product(*map(range, shape)),
        key=lambda combination: math.prod(Fraction(row[k]) for row, k in zip(table, combination, strict=True)),
    )
    check(
        f"joint decision: {name}",
        FLOAT64,
        lambda _: decode_jointly([np.log([row]) for row in table], np.zeros(shape))[0],
        0,
        best,
    )
