"""A small convolutional encoder of difference pictures, and the lessons' head that pretrains it on scenes."""

from __future__ import annotations

from typing import cast

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.encoder.model import FrameEncoder
from pipeline.videos.frames.subtraction import GAIN, MIDDLE

STEPS = 12
"""8-bit steps of difference that count as 1: about the deviation where something touches."""
CHANNELS = ((16, 2), (32, 2), (48, 1), (64, 2), (96, 1), (128, 2), (128, 1))
"""Outputs and stride of each convolution; the first is 5 x 5, the others 3 x 3."""
HIDDEN = 192
WEIGHTS = {"quantities": 2.0, "kinds": 0.6}
"""Of the two parts of the loss."""


class SceneEncoder(FrameEncoder):
    """Seven convolutions with batch normalisation, then mean and maximum over the picture: 256 numbers a frame.

    It takes difference pictures (`pipeline.videos.frames.subtraction`) of any side from 16 pixels.
    """

    def __init__(self) -> None:
        super().__init__(dim=2 * CHANNELS[-1][0])
        layers: list[nn.Module] = []
        width = 3
        for number, (channels, stride) in enumerate(CHANNELS):
            kernel = 3 if number else 5
            convolution = nn.Conv2d(width, channels, kernel, stride, kernel // 2, bias=False)
            layers += [convolution, nn.BatchNorm2d(channels), nn.ReLU(inplace=True)]
            width = channels
        self.layers = nn.Sequential(*layers).to(memory_format=torch.channels_last)

    def forward(self, frames: torch.Tensor, moments: torch.Tensor) -> torch.Tensor:
        """Embed difference pictures, uint8, batch x side x side x RGB: batch x dim, in the weights' number format."""
        # The bytes lie as channels-last wants them: a view, no copy.
        pixels = (frames.permute(0, 3, 1, 2).to(next(self.parameters()).dtype) - MIDDLE) / (GAIN * STEPS)
        maps = self.layers(pixels)
        return torch.cat([maps.mean((2, 3)), maps.amax((2, 3))], dim=1)


class LessonModel(nn.Module):
    """The encoder with a head that tells what is known of invented objects from single pictures.

    Args:
        encoder: To be pretrained.
        quantities: Mean and deviation of each quantity over the lessons, 2 x quantities.
        kinds: How many flags there are.
    """

    _keys_to_ignore_on_save = None  # read by transformers' Trainer when it reloads a checkpoint

    def __init__(self, encoder: SceneEncoder, quantities: torch.Tensor, kinds: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.scale = quantities
        told = quantities.shape[1] + kinds
        self.head = nn.Sequential(nn.Dropout(0.1), nn.Linear(encoder.dim, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, told))

    def forward(self, frames: torch.Tensor, quantities: torch.Tensor, kinds: torch.Tensor) -> dict[str, torch.Tensor]:
        """The loss of some lessons: quantities, standardised, by Huber's loss, kinds by cross-entropy.

        Args:
            frames: uint8, lessons x presses x side x side x RGB.
            quantities: float32, lessons x presses x quantities.
            kinds: float32, lessons x kinds.
        """
        lessons, presses = frames.shape[:2]
        features = self.encoder(frames.flatten(0, 1), torch.zeros(lessons * presses, dtype=torch.int64))
        numbers, flags = self.head(features).split([quantities.shape[2], kinds.shape[1]], dim=1)
        mean, deviation = self.scale.to(quantities)
        wanted = ((quantities - mean) / deviation).flatten(0, 1)
        parts = {
            "quantities": F.smooth_l1_loss(numbers, wanted),
            "kinds": F.binary_cross_entropy_with_logits(flags, kinds.repeat_interleave(presses, dim=0)),
        }
        return {"loss": cast(torch.Tensor, sum(WEIGHTS[name] * part for name, part in parts.items())), **parts}
