"""Encoders at their edges: frames without signal and with too much of it, and frames late in their videos.

The towers and the strong network run in float64, float32 and bfloat16, and in float16 where a CUDA device is. CLIP is
the committed stand-in; prompts and the strong network are random.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import cast, get_args

import numpy as np
import torch

from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.model import FrameEncoder
from pipeline.runtime import seed_everything
from pipeline.config import EncoderConfig, Recipe
from pipeline.stability.case import NETWORKS, Bound, Case, Dtype, Floats
from pipeline.stability.condition import magnification, rounded

PART = "encoder"
CLASSES = (3, 3, 3)
SIDE = 64
MOMENTS = torch.tensor([0, 1, 40_000, 10**6])
"""Numbers of the frames in their videos: float32 no longer holds the sinusoid of the last."""
KINDS = ("base", "base of release", *get_args(Recipe))
LONGEST = 4 * 128
"""Terms of the longest sum in the stand-in CLIP: its widest layer. The strong network's is no longer: 9 x 48."""


def cases(clip: Path) -> list[Case]:
    """Frames through every encoder.

    Args:
        clip: Folder of the CLIP.
    """
    return list(_frames(clip))


def hard_frames() -> Mapping[str, torch.Tensor]:
    """Frames without signal and with too much of it, by name: uint8, 4 x side x side x RGB."""
    noise = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (4, SIDE, SIDE, 3), dtype=np.uint8))
    shown = {"noise": noise}
    for name, value in (("black", 0), ("grey", 128), ("white", 255)):
        frames = torch.full_like(noise, value)
        frames[1, : SIDE // 2] = 255 - value
        shown[f"{name}, one half the opposite"] = frames
    return shown


def settings(clip: Path, kind: str) -> EncoderConfig:
    """What makes an encoder of that kind."""
    recipe = "release" if kind == "base of release" else "paper" if kind == "base" else cast(Recipe, kind)
    return EncoderConfig(recipe=recipe, weights=str(clip), reference="subtract" if recipe == "strong" else "none")


def encoder(clip: Path, kind: str) -> FrameEncoder:
    """An encoder of one of `KINDS`, in float32; equal at every call."""
    seed_everything(0)
    config = settings(clip, kind)
    if kind.startswith("base"):
        return base_encoder(config).eval()
    made = property_classifier(config, CLASSES).encoder
    return (seasoned(made) if isinstance(made, SceneEncoder) else made).eval()


def seasoned(network: SceneEncoder) -> SceneEncoder:
    """With running statistics of some pictures: a fresh network's are 0 and 1."""
    draw = torch.Generator().manual_seed(7)
    for _ in range(20):
        network.train()(torch.randint(0, 256, (8, 32, 32, 3), dtype=torch.uint8, generator=draw), torch.zeros(8))
    return network.eval()


def _frames(clip: Path) -> Iterator[Case]:
    for kind, (name, frames) in itertools.product(KINDS, hard_frames().items()):
        yield Case(
            PART,
            f"{kind}: {name}",
            NETWORKS,
            partial(_embedded, clip, kind, frames),
            Bound(
                partial(_network, clip, kind, name),
                "condition: the encoder's magnification of rounded weights on these frames, times roundings a layer",
            ),
        )


def _embedded(clip: Path, kind: str, frames: torch.Tensor, dtype: Dtype) -> Floats:
    """What the language model and the classifier are given, side by side."""
    model = _made(clip, kind, dtype)
    with torch.no_grad():
        return np.asarray(_both(model, frames.to(dtype.device)).double().cpu())


def _both(model: FrameEncoder, frames: torch.Tensor) -> torch.Tensor:
    moments = MOMENTS.to(frames.device)
    return torch.cat([model(frames, moments), model.describe(frames, moments)], dim=1)


@cache
def _made(clip: Path, kind: str, dtype: Dtype) -> FrameEncoder:
    return encoder(clip, kind).to(dtype.device, dtype.torch)


@cache
def _magnified(clip: Path, kind: str, name: str) -> float:
    model = _made(clip, kind, Dtype.FLOAT64)
    return magnification(model, lambda: _both(model, hard_frames()[name]))


def _network(clip: Path, kind: str, name: str, dtype: Dtype) -> float:
    return rounded(_magnified(clip, kind, name), LONGEST, dtype)
