"""The classifier of the strong recipe: each frame votes, and the properties are decided together."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from pipeline.encoder.baseline.predictor import decode_jointly
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier

FARTHEST = 5.0
"""Standardised features are held within: one wild frame must not outvote all others."""


class FrameVotes(PropertyClassifier):
    """Standardised features, one linear layer a property, probabilities averaged over frames, one joint decision.

    The decision is the combination of classes that maximises the sum of log probabilities and the log of how much more
    often the training objects show the combination than its classes would meet by chance.
    """

    def __init__(self, encoder: FrameEncoder, classes: Sequence[int]) -> None:
        super().__init__(encoder, Heads(encoder.dim, classes), classes)
        self.centre = nn.Parameter(torch.zeros(encoder.dim))
        self.spread = nn.Parameter(torch.ones(encoder.dim))
        self.dependence = nn.Parameter(torch.zeros(tuple(classes)))

    def standardise(self, features: torch.Tensor) -> torch.Tensor:
        """Features on the training frames' scale, within `FARTHEST`."""
        scaled = (features - self.centre) / self.spread
        # What is infinite stays so, and is found: a wild frame is held, a broken one is not.
        return torch.where(scaled.isinf(), scaled, scaled.clamp(-FARTHEST, FARTHEST))

    def classify(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Log of the mean probability a property, batch x classes, of features, batch x frames x dim."""
        votes: list[torch.Tensor] = self.heads(self.standardise(features))
        # In logarithms throughout: a frame that is sure of a class gives the others a probability of 0 in float32.
        return [v.log_softmax(-1).logsumexp(1) - torch.tensor(float(v.shape[1])).log() for v in votes]

    def decide(self, logits: torch.Tensor) -> torch.Tensor:
        """The most probable combination: int64, batch x properties."""
        evidence = [z.log_softmax(1).numpy() for z in logits.detach().cpu().double().split(self.classes, dim=1)]
        return torch.from_numpy(decode_jointly(evidence, self.dependence.detach().cpu().double().numpy()))
