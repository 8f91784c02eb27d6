"""A small convolutional encoder of difference pictures, pretrained on synthetic ones (`pipeline.encoder.pretrain`)."""

from __future__ import annotations

import torch
from torch import nn

from pipeline.encoder.model import FrameEncoder
from pipeline.videos.frames.subtraction import GAIN, MIDDLE

STEPS = 12
"""8-bit steps of difference that count as 1: about the deviation where something touches."""
CHANNELS = ((16, 2), (32, 2), (48, 1), (64, 2), (96, 1), (128, 2), (128, 1))
"""Outputs and stride of each convolution; the first is 5 x 5, the others 3 x 3."""


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

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """Embed difference pictures, uint8, batch x side x side x RGB: batch x dim, in the weights' number format."""
        # The bytes lie as channels-last wants them: a view, no copy.
        pixels = (frames.permute(0, 3, 1, 2).to(next(self.parameters()).dtype) - MIDDLE) / (GAIN * STEPS)
        maps = self.layers(pixels)
        return torch.cat([maps.mean((2, 3)), maps.amax((2, 3))], dim=1)
