"""Classifiers at their edges: features of no length, logits as large as float32 holds, decisions that tie, losses.

Heads are random. They are trained and read in float32; the published code's, which scale features to length 1, are
tried in every format, as a quotient by next to nothing is where short formats end. The joint decision is float64
whatever it is given, and held against a search in exact fractions, so that its bound is 0: no decision may change.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import cast

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from pipeline.core.runtime import seed_everything
from pipeline.encoder.frame_classifier import JointFrameClassifier, decode_jointly, log_dependence
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.encoder.pretrain import PretrainingModel
from pipeline.encoder.release import SHORTEST_FEATURE, PublishedHeads
from pipeline.encoder.scene_encoder import SceneEncoder
from tests.numerics.bounds import summing
from tests.numerics.cross_entropy import STEPS, TARGETS, logits, mean_loss, rounded_loss
from tests.numerics.harness import BFLOAT16, FLOAT64, NETWORKS, SOLVED, Check, Floats, Format, formats

PART = "heads"
CLASSES = (3, 3, 3)


# Features of no length


def published_heads(dtype: torch.dtype) -> PublishedHeads:
    seed_everything(0)
    return PublishedHeads(16, [3, 2]).to(dtype).eval()


def cancelling(dtype: torch.dtype) -> torch.Tensor:
    """Two frames whose mean is exactly 0: 1 x 2 x 16."""
    frame = torch.randn(1, 1, 16, generator=torch.Generator().manual_seed(0)).to(dtype)
    return torch.cat([frame, -frame], dim=1)


@formats(*NETWORKS)
def test_features_of_length_0_are_classified(check: Check, fmt: Format) -> None:
    """roundings: the sum over the hidden layer, by the sizes of its terms."""
    heads = published_heads(torch.float64)
    hidden = F.relu(heads.shared.bias)
    with torch.no_grad():
        exact = torch.cat(heads.properties(hidden[None]), dim=1)
        layers = [cast(nn.Linear, layer) for layer in heads.properties]
        sizes = torch.cat([layer.weight.abs() @ hidden + layer.bias.abs() for layer in layers])

    def classified(f: Format) -> torch.Tensor:
        model = PropertyClassifier(FrameEncoder(16), published_heads(f.torch), [3, 2]).to(f.device)
        return torch.cat(model.classify(cancelling(f.torch).to(f.device)), dim=1)

    bound = (sizes.max() / exact.abs().max()).item() * summing(hidden.numel() + 1, fmt)
    check("heads of release: mean of length 0", fmt, classified, bound, exact.numpy())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_features_of_length_0_have_finite_gradients(dtype: torch.dtype) -> None:
    heads, features = published_heads(dtype), cancelling(dtype).requires_grad_()
    logits = torch.cat(PropertyClassifier(FrameEncoder(16), heads, [3, 2]).classify(features), dim=1)
    F.cross_entropy(logits.float(), torch.tensor([2])).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in heads.parameters())
    # Of the features it is up to 1 / SHORTEST_FEATURE times as large, which float16 does not hold.
    assert features.grad is not None
    assert dtype == torch.float16 or features.grad.isfinite().all()


@formats(*NETWORKS)
@pytest.mark.parametrize(("factor", "shown_as"), [(0.1, 0.1), (10.0, 1.0)])
def test_short_features_are_shown_by_the_least_length(
    check: Check, fmt: Format, factor: float, shown_as: float
) -> None:
    """roundings: the feature, the least length, their quotient; and what lies below the smallest number, since short
    formats have few digits left there."""
    length = factor * SHORTEST_FEATURE

    def shown(f: Format) -> torch.Tensor:
        """The length of what the hidden layer is given."""
        heads, given = published_heads(f.torch).to(f.device), []
        heads.shared.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0].detach().double()))
        heads(torch.tensor([[length] + [0.0] * 15], dtype=f.torch, device=f.device))
        return cast(torch.Tensor, given[0].norm(dim=1))

    below = fmt.smallest * (1 / length + 1 / SHORTEST_FEATURE)
    check(f"heads of release: length {length:g} is shown as", fmt, shown, 6 * fmt.roundoff + below, shown_as)


# Huge logits


def huge_classifier(kind: type[PropertyClassifier], weight: float) -> PropertyClassifier:
    """Heads whose weights are `weight` times as large as fresh ones."""
    seed_everything(0)
    network = SceneEncoder()
    model = (
        JointFrameClassifier(network, CLASSES)
        if kind is JointFrameClassifier
        else kind(network, Heads(256, CLASSES), CLASSES)
    )
    with torch.no_grad():
        for parameter in model.heads.parameters():
            parameter.mul_(weight)
    return model


@formats(*SOLVED)
@pytest.mark.parametrize("weight", [1.0, 1e4])
@pytest.mark.parametrize("size", [1e4, 1e30])
@pytest.mark.parametrize(("name", "kind"), [("heads", PropertyClassifier), ("frame heads", JointFrameClassifier)])
def test_huge_logits_are_finite_and_decided_on(
    check: Check, name: str, kind: type[PropertyClassifier], size: float, weight: float, fmt: Format
) -> None:
    """roundings: the mean over frames and the sum over features, by the sizes of its terms.

    Heads of single frames clip features, so that there it is the weights that count; they take a softmax's logarithm
    besides, which is off by no more than twice its logits.
    """
    features = size * torch.randn(4, 3, 256, generator=torch.Generator().manual_seed(0))

    def said(f: Format) -> torch.Tensor:
        return torch.cat(huge_classifier(kind, weight).to(f.torch).classify(features.to(f.torch)), dim=1).detach()

    exact, double = said(FLOAT64), huge_classifier(kind, weight).double()
    wild = features.double()
    terms = (
        double.standardise(wild).abs().flatten(0, 1) if isinstance(double, JointFrameClassifier) else wild.abs().mean(1)
    )
    heads = [cast(nn.Linear, head) for head in double.heads.children()]
    sizes = max((terms @ head.weight.abs().T + head.bias.abs()).max().item() for head in heads)
    bound = (2 if kind is JointFrameClassifier else 1) * summing(256 + 4, fmt) * sizes / float(exact.abs().max())
    check(f"{name}: features of {size:g}, weights times {weight:g}", fmt, said, bound)

    model, given = huge_classifier(kind, weight).to(fmt.torch), features.to(fmt.torch).requires_grad_()
    found = model.classify(given)
    loss = torch.stack([F.cross_entropy(z, torch.tensor([0, 1, 2, 0])) for z in found]).sum()
    loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert given.grad is not None
    assert given.grad.isfinite().all()
    decided = model.decide(torch.cat(found, dim=1).detach())
    assert torch.equal(decided, torch.stack([z.argmax(1) for z in exact.split(CLASSES, dim=1)], dim=1))


# Joint decisions

Table = Sequence[Sequence[float]]
"""One video's probabilities of each class, by property."""
HALF = ((0.5, 0.5), (0.5, 0.5))
TABLES: dict[str, Table] = {
    "all classes alike": HALF,
    "certain": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "tie of two combinations": ((0.25, 0.5, 0.25), (0.5, 0.5, 0.0)),
    "too small for float32": ((1e-300, 1e-200), (1e-100, 1.0)),
    "the smallest numbers": ((5e-324, 1e-320), (5e-324, 1.0)),
    "every combination impossible": ((0.0, 0.0), (0.5, 0.5)),
    "a single class": ((1.0,), (1.0,)),
    "a rounding apart": ((0.5, 0.5 + 2**-40), (0.5 + 2**-39, 0.5)),
}
PRIORS: dict[str, Table] = {"prior breaks the tie": HALF, "prior against certainty": ((1.0, 0.0), (0.0, 1.0))}


@pytest.mark.parametrize("name", [*TABLES, *PRIORS])
def test_decisions_are_those_of_exact_fractions(check: Check, name: str) -> None:
    table = (TABLES | PRIORS)[name]
    labels = [(0, 0), (0, 0), (1, 1), (1, 1)] if name in PRIORS else []
    shape = tuple(map(len, table))
    joint = {c: Fraction(1, 6) + labels.count(c) for c in itertools.product(*map(range, shape))}
    total = sum(joint.values(), Fraction(0))

    def worth(combination: tuple[int, ...]) -> Fraction:
        """The product of its probabilities, and how much more often labels show it than by chance."""
        result = joint[combination] / total if labels else Fraction(1)
        for i, k in enumerate(combination):
            margin = sum((v for c, v in joint.items() if c[i] == k), Fraction(0)) / total
            result *= Fraction(table[i][k]) / (margin if labels else 1)
        return result

    def decided(_: Format) -> Floats:
        prior = log_dependence(np.array(labels), list("abcd"), shape) if labels else np.zeros(shape)
        return decode_jointly([np.log([row]) for row in table], prior)[0]

    check(f"joint decision: {name}", FLOAT64, decided, 0, max(joint, key=worth))


@formats(*SOLVED, BFLOAT16)
@pytest.mark.parametrize(("name", "scale"), [("0", 0.0), ("64", 64.0), ("2^100", 2.0**100)])
def test_decisions_on_logits_are_the_same_in_every_format(check: Check, fmt: Format, name: str, scale: float) -> None:
    """Powers of two, which every format holds; three properties of three classes."""
    rows = [[[1.0, 1.0, 0.5], [0.0, 0.0, 0.0], [-1.0, 0.5, 1.0]], [[0.0, -1.0, -0.5], [0.5, 1.0, 1.0], [1.0] * 3]]
    values = torch.tensor(rows, dtype=torch.float64) * scale
    model = JointFrameClassifier(FrameEncoder(4), CLASSES)
    name = f"joint decision: logits of {name}"
    check(name, fmt, lambda f: model.decide(values.flatten(1).to(f.torch)), 0, values.argmax(2).numpy())


# Losses


@formats(*SOLVED)
@pytest.mark.parametrize("power", [0, 5, 60, 120])
def test_losses_of_properties_are_cross_entropies(
    check: Check, monkeypatch: pytest.MonkeyPatch, fmt: Format, power: int
) -> None:
    """Of heads that say the same of two properties, whatever they are shown."""

    def loss(f: Format) -> torch.Tensor:
        model = PropertyClassifier(SceneEncoder().to(f.torch), nn.Identity(), [STEPS.shape[1]] * 2)
        monkeypatch.setattr(model, "classify", lambda _: [torch.from_numpy(logits(power)).to(f.torch)] * 2)
        labels = torch.tensor(TARGETS)[:, None].expand(-1, 2)
        return model(torch.zeros(4, 1, 16, 16, 3), torch.zeros(4, 1, dtype=torch.int64), labels)["loss"]

    check(f"loss of properties, logits of 2^{power}", fmt, loss, rounded_loss(power, fmt, 2), 2 * mean_loss(power))


@formats(*SOLVED)
@pytest.mark.parametrize("size", [0.0, 2.0**13, 2.0**100])
def test_losses_of_pretraining_are_hubers_and_cross_entropy(check: Check, fmt: Format, size: float) -> None:
    """Of a head that says `size` of everything; roundings: means over twelve numbers each, all terms positive."""

    def losses(f: Format) -> torch.Tensor:
        model = PretrainingModel(SceneEncoder(), torch.tensor([[0.0] * 3, [1.0] * 3]), 3).to(f.torch).eval()
        last = cast(nn.Linear, model.head[-1])
        nn.init.zeros_(last.weight)
        nn.init.constant_(last.bias, size)
        frames = torch.zeros(2, 2, 16, 16, 3, dtype=torch.uint8)
        output = model(frames, torch.zeros(2, 2, 3, dtype=f.torch), torch.zeros(2, 3, dtype=f.torch))
        return torch.stack([output["quantities"], output["kinds"]])

    huber = size - 0.5 if size > 1 else size * size / 2
    name = f"loss of pretraining, quantities and kinds off by {size:g}"
    check(name, fmt, losses, summing(2 * 12 + 8, fmt), [huber, size + math.log1p(math.exp(-size))])
