"""The backbone `scenes`: a small CNN of difference pictures that `pipeline.encoder.pretrain` pretrains."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.core.records import GAIN, MIDDLE
from pipeline.encoder.model import FrameEncoder
from pipeline.training.trainable import load_trainable

SIDE = 120
"""Maximum side in pixels of pretraining pictures, which are drawn at this height. Larger ones are averaged."""

STEPS = 12
"""Difference in 8-bit steps that is scaled to 1: about the standard deviation in contact."""
CHANNELS = ((16, 2), (32, 2), (48, 1), (64, 2), (96, 1), (128, 2), (128, 1))
"""Outputs and stride of each convolution; the first is 5 x 5, the others 3 x 3."""
TUNED = 2
"""Convolutions of the last stage: from the last halving of the map on."""


class SceneEncoder(FrameEncoder):
    """Seven convolutions with batch normalisation, then mean and maximum over the picture: 256 numbers a frame.

    It takes difference pictures (`pipeline.videos.frames.subtraction`) of any side from 16 pixels.
    """

    def __init__(self) -> None:
        super().__init__(dim=2 * CHANNELS[-1][0])
        layers: list[nn.Module] = []
        width, kernel = 3, 5
        for channels, stride in CHANNELS:
            convolution = nn.Conv2d(width, channels, kernel, stride, kernel // 2, bias=False)
            layers += [convolution, nn.BatchNorm2d(channels), nn.ReLU(inplace=True)]
            width, kernel = channels, 3
        self.layers = nn.Sequential(*layers).to(memory_format=torch.channels_last)

    @property
    def last(self) -> nn.Sequential:
        """The stage that fine-tuning changes."""
        return self.layers[-3 * TUNED :]

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        """Embeddings, batch x dim, in the weights' number format."""
        return self.stage(self.trunk(frames))

    def trunk(self, frames: torch.Tensor) -> torch.Tensor:
        """What enters the last stage: batch x channels x height x width."""
        # The bytes lie as channels-last wants them: a view, no copy.
        pixels = frames.permute(0, 3, 1, 2).to(next(self.parameters()).dtype)
        if pixels.shape[-1] > SIDE:
            pixels = F.interpolate(pixels, SIDE, mode="area")
        maps: torch.Tensor = self.layers[: -3 * TUNED]((pixels - MIDDLE) / (GAIN * STEPS))
        return maps

    def stage(self, entering: torch.Tensor) -> torch.Tensor:
        """Mean and maximum over the picture, batch x dim, from what `trunk` gave."""
        maps = self.last(entering)
        return torch.cat([maps.mean((2, 3)), maps.amax((2, 3))], dim=1)


def load_backbone(config: EncoderConfig, *, tuned: bool) -> SceneEncoder:
    """The network that the stage `pretrain` wrote; where there is none, or it does not fit, a UserError."""
    encoder = SceneEncoder()
    load_trainable(encoder, Path(config.pretrained))
    encoder.requires_grad_(False).eval()
    if tuned:
        encoder.last.requires_grad_(True)
    return encoder
