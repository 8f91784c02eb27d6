"""Encoders at their edges, tiny and random: frames without signal and with too much, late frames, batches of one."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.core.runtime import seed_everything
from pipeline.encoder.frame_classifier import JointFrameClassifier
from pipeline.encoder.model import FrameEncoder, PropertyClassifier, SideBySide, mean_and_deviation
from pipeline.encoder.recipes import RECIPES, base_encoder, property_classifier
from pipeline.encoder.release import sinusoid
from pipeline.encoder.scene_encoder import CHANNELS, SceneEncoder
from tests.encoders import config, write_timm, write_tower
from tests.numerics.bounds import longest_sum, magnification, rounded, summing
from tests.numerics.harness import FLOAT32, FLOAT64, NETWORKS, Check, Format, formats

PART = "encoder"
CLASSES = (3, 3, 3)
SIDE = 64
TIMES = torch.tensor([0, 1, 40_000, 10**6])
"""Numbers of the frames in their videos: float32 no longer holds the sinusoid of the last."""
BASES = {"base": "paper", "base of release": "release"}
"""Encoders without prompts, and the recipe that they are read by."""
CLASSIFIERS = (*RECIPES, "timm")
"""Recipes; `tuned` stands on the backbone `scenes`, `timm` is that recipe on a network of timm's."""


def classifier(kind: str) -> PropertyClassifier:
    """Of a recipe, equal at every call."""
    seed_everything(0)
    if kind != "tuned":
        return property_classifier(settings(kind), CLASSES)
    network = SceneEncoder()
    # Running statistics of some pictures: a fresh network's are 0 and 1.
    draw = torch.Generator().manual_seed(7)
    for _ in range(20):
        network.train()(torch.randint(0, 256, (8, 32, 32, 3), dtype=torch.uint8, generator=draw), torch.zeros(8))
    return JointFrameClassifier(SideBySide([network]), CLASSES)


@cache
def settings(kind: str) -> EncoderConfig:
    if kind == "timm":
        return config(write_timm(Path(mkdtemp())), "tuned", backbone=("timm",), feature_stage=2)
    return config(write_tower(Path(mkdtemp())), kind)


@cache
def encoder(kind: str, fmt: Format) -> FrameEncoder:
    seed_everything(0)
    made = base_encoder(settings(BASES[kind])) if kind in BASES else classifier(kind).encoder
    return made.eval().to(fmt.device, fmt.torch)


def both(model: FrameEncoder, frames: torch.Tensor, times: torch.Tensor = TIMES) -> torch.Tensor:
    """What the language model and, where that is something else, the classifier are given, side by side."""
    given: torch.Tensor = model(frames, times)
    same = type(model).describe is FrameEncoder.describe
    return given if same else torch.cat([given, model.describe(frames, times)], dim=1)


NOISE = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (4, SIDE, SIDE, 3), dtype=np.uint8))
FRAMES = {"noise": NOISE}
"""uint8, 4 x side x side x RGB."""
for name, value in (("black", 0), ("grey", 128), ("white", 255)):
    FRAMES[f"{name}, one half the opposite"] = torch.full_like(NOISE, value)
    FRAMES[f"{name}, one half the opposite"][1, : SIDE // 2] = 255 - value


@cache
def magnified(kind: str, name: str) -> float:
    model = encoder(kind, FLOAT64)
    return magnification(model, lambda: both(model, FRAMES[name]))


def network(kind: str, name: str, fmt: Format) -> float:
    """condition: the encoder's magnification of rounded weights on these frames, times roundings a layer."""
    return rounded(magnified(kind, name), longest_sum(encoder(kind, FLOAT64)), fmt)


@formats(*NETWORKS)
@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("kind", [*BASES, *CLASSIFIERS])
def test_hard_frames_are_embedded(check: Check, kind: str, name: str, fmt: Format) -> None:
    @torch.no_grad()
    def embedded(f: Format) -> torch.Tensor:
        return both(encoder(kind, f), FRAMES[name].to(f.device), TIMES.to(f.device))

    check(f"{kind}: {name}", fmt, embedded, lambda f: network(kind, name, f))


@formats(*NETWORKS)
@pytest.mark.parametrize("value", [0.0, 0.1, 6.0, 1e4])
def test_a_channel_that_is_the_same_everywhere_has_no_deviation(check: Check, value: float, fmt: Format) -> None:
    """roundings: of the value, and of a mean of 196 equal ones in float32. Its gradient is finite, also of 0."""
    maps = torch.full((1, 2, 196), value, dtype=torch.float64).to(fmt.device, fmt.torch).requires_grad_()
    found = mean_and_deviation(maps)
    bound, exact = fmt.roundoff + summing(196, FLOAT32), np.array([[value, value, 0.0, 0.0]])
    check(f"mean and deviation: {value} everywhere", fmt, lambda _: found, bound, exact)
    found.sum().backward()
    assert maps.grad.isfinite().all()


def test_positions_of_late_frames_are_told_apart(check: Check) -> None:
    """roundings: that to float32, and of angles up to 10^9 in float64; against long doubles."""
    late = 10**9
    angles = late * np.longdouble(10_000) ** (-np.arange(0, 64, 2, dtype=np.longdouble) / 64)
    exact = np.stack([np.sin(angles), np.cos(angles)], axis=-1).ravel()
    bound = FLOAT32.roundoff + 8 * late * FLOAT64.roundoff
    check("positions: frame 10^9", FLOAT32, lambda _: sinusoid(torch.tensor([late]), 64)[0], bound, exact)
    assert not torch.equal(*sinusoid(torch.tensor([late, late + 1]), 64))


@pytest.mark.parametrize("kind", [*BASES, *CLASSIFIERS])
def test_a_batch_of_one_equals_a_batch_of_many(check: Check, kind: str) -> None:
    """condition: twice that of the network, as two ways are compared."""
    model = encoder(kind, FLOAT32)
    with torch.no_grad():
        whole = both(model, FRAMES["noise"])
        alone = torch.cat([both(model, x[None], n[None]) for x, n in zip(FRAMES["noise"], TIMES, strict=True)])
    assert not torch.allclose(whole[0], whole[1]), "the frames differ"
    found, bound = (alone - whole) / whole.abs().max(), 2 * network(kind, "noise", FLOAT32)
    check(f"{kind}: frames one by one, against a batch", FLOAT32, lambda _: found, bound, 0.0)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("kind", CLASSIFIERS)
def test_hard_frames_train_and_are_decided_on(check: Check, kind: str, name: str) -> None:
    frames = torch.stack([FRAMES[name][:3], FRAMES[name][1:]])
    numbers = torch.tensor([[0, 1, 2], [10**6, 10**6, 10**6]])
    model = classifier(kind).train()
    loss = model(frames, numbers, torch.tensor([[0, 1, 2], [2, 1, 0]]))["loss"]
    loss.backward()
    found = torch.cat([loss[None], *(p.grad.flatten() for p in model.parameters() if p.grad is not None)])
    check(f"{kind}: {name}: loss and gradients", FLOAT32, lambda _: found)
    with torch.no_grad():
        logits = model.eval()(frames, numbers)["logits"]
    assert logits.isfinite().all()
    assert set(model.decide(logits).flatten().tolist()) <= {0, 1, 2}


def test_the_network_is_seven_convolutions_of_what_differs_from_128(check: Check) -> None:
    """By BN(w * x) = (g w / s) * x + b - g m / s in float64; 24 steps, which pictures show doubled, count as 1.

    condition: twice that of the network, as two ways are compared.
    """
    state = encoder("tuned", FLOAT64).get_submodule("backbones.0").state_dict()
    shown = FRAMES["noise"].clone()
    shown[0] = 128
    maps = (shown.double().permute(0, 3, 1, 2) - 128) / 24
    for number, (_, stride) in enumerate(CHANNELS):
        kernel, norm = state[f"layers.{3 * number}.weight"], f"layers.{3 * number + 1}"
        scale = state[f"{norm}.weight"] / (state[f"{norm}.running_var"] + 1e-5).sqrt()
        shift = state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale
        maps = F.conv2d(maps, kernel * scale[:, None, None, None], shift, stride, kernel.shape[-1] // 2).relu()
    assert maps.shape[1:] == (128, 4, 4)
    exact = torch.cat([maps.mean((2, 3)), maps.amax((2, 3))], dim=1)
    bound = 2 * network("tuned", "noise", FLOAT32)
    with torch.no_grad():
        check("scenes: against folded convolutions", FLOAT32, lambda f: encoder("tuned", f)(shown, TIMES), bound, exact)
