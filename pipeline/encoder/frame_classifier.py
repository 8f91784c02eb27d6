"""A per-frame classifier on the features of a pretrained encoder, with joint decoding.

Each property has a logistic regression on the standardised features of single frames. Its one setting, the penalty on
weights, is chosen by a cross-validation inside the training objects. A video's probabilities are the mean over its
frames. The properties are then decided together, as objects that share one class often share others.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from pipeline.core.records import Measurement
from pipeline.core.runtime import derive_seed
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.running.errors import UserError

FARTHEST = 5.0
"""Standardised features are clipped to this absolute value, so that one outlier frame does not outweigh all others."""
STRENGTHS = (3e-4, 1e-3, 3e-3, 1e-2)
"""Inverse weights of the penalty (scikit-learn's C) that are tried."""
FOLDS = 5
ROUNDS = 500
"""Maximum number of iterations of the solver."""
ABSENT = -10.0
"""Bias of a class that training lacks: a probability of some 5e-5."""
SMOOTHING = 1 / 6
"""Objects added to each combination of classes, so that none is impossible."""
MOST_COMBINATIONS = 100_000
"""Maximum number of combinations of classes; joint decoding of more would need too large a table."""

Probabilities = npt.NDArray[np.float64]
Clips = npt.NDArray[np.float32]
"""Videos x frames x features."""
Labels = npt.NDArray[np.int64]
"""Videos x properties: classes from 0."""


class JointFrameClassifier(PropertyClassifier):
    """Standardised features, one linear layer a property, probabilities averaged over frames, one joint decision."""

    def __init__(self, encoder: FrameEncoder, classes: Sequence[int]) -> None:
        super().__init__(encoder, Heads(encoder.dim, classes), classes)
        self.centre: torch.Tensor
        self.spread: torch.Tensor
        self.dependence: torch.Tensor
        self.register_buffer("centre", torch.zeros(encoder.dim))
        self.register_buffer("spread", torch.ones(encoder.dim))
        self.register_buffer("dependence", torch.zeros(tuple(classes)))

    def standardise(self, features: torch.Tensor) -> torch.Tensor:
        """Features on the training frames' scale, within `FARTHEST`."""
        scaled = (features - self.centre) / self.spread
        # Infinite values are not clipped, so that `check_finite` still finds a broken frame; finite outliers are.
        return torch.where(scaled.isinf(), scaled, scaled.clamp(-FARTHEST, FARTHEST))

    def classify(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Log of the mean probability a property, batch x classes, of features, batch x frames x dim."""
        logits: list[torch.Tensor] = self.heads(self.standardise(features))
        return [pooled(z) for z in logits]

    def decide(self, logits: torch.Tensor) -> torch.Tensor:
        """The most probable combination: int64, batch x properties."""
        evidence = [z.log_softmax(1).numpy() for z in logits.detach().cpu().double().split(self.classes, dim=1)]
        return torch.from_numpy(decode_jointly(evidence, self.dependence.cpu().double().numpy()))


def pooled(logits: torch.Tensor) -> torch.Tensor:
    """Log of the mean probability over frames, batch x classes, from batch x frames x classes."""
    # In logarithms throughout: a frame that is sure of a class gives the others a probability of 0 in float32.
    return logits.log_softmax(-1).logsumexp(1) - torch.tensor(float(logits.shape[1]), dtype=logits.dtype).log()


@dataclass(frozen=True)
class FittedHeads:
    """What `fit_frame_heads` finds, in the form in which `JointFrameClassifier` holds it."""

    centre: npt.NDArray[np.float32]
    spread: npt.NDArray[np.float32]
    weights: list[npt.NDArray[np.float64]]
    """Classes x features of each property."""
    biases: list[npt.NDArray[np.float64]]
    dependence: npt.NDArray[np.float64]

    def linear(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Weights, classes of all properties x features, and biases that give a frame's logits, nothing clipped."""
        weights = np.concatenate(self.weights) / self.spread
        return weights, np.concatenate(self.biases) - weights @ self.centre

    def evidence(self, clips: Clips) -> list[npt.NDArray[np.float64]]:
        """Log of the mean probability over frames, videos x classes of each property."""
        scaled = np.clip((clips - self.centre) / self.spread, -FARTHEST, FARTHEST).astype(np.float64)
        logits = [scaled @ w.T + b for w, b in zip(self.weights, self.biases, strict=True)]
        return [pooled(torch.from_numpy(z)).numpy() for z in logits]

    def predict(self, clips: Clips) -> Labels:
        """The most probable combination, videos x properties."""
        return decode_jointly(self.evidence(clips), self.dependence)

    def copy_into(self, model: JointFrameClassifier) -> None:
        """Copy the fitted heads into a model, so that it decides alike."""
        own = [model.centre, model.spread, model.dependence, *model.heads.parameters()]
        heads = [array for pair in zip(self.weights, self.biases, strict=True) for array in pair]
        with torch.no_grad():
            for tensor, value in zip(own, [self.centre, self.spread, self.dependence, *heads], strict=True):
                tensor.copy_(torch.from_numpy(value))


def fit_frame_heads(
    clips: Clips, labels: Labels, objects: Sequence[str], classes: Sequence[int], strength: float
) -> FittedHeads:
    """Fit one head per property, with `classes` classes each; a class that training lacks gets a probability near 0."""
    from sklearn.linear_model import LogisticRegression
    from threadpoolctl import threadpool_limits

    frames = clips.reshape(-1, clips.shape[2])
    centre, spread = frames.mean(axis=0), frames.std(axis=0)
    # A feature that does not vary is only centred: dividing by its deviation would blow up rounding errors.
    spread = np.where(spread > 1e-6, spread, 1).astype(np.float32)
    scaled = np.clip((frames - centre) / spread, -FARTHEST, FARTHEST)
    weights, biases = [], []
    for position, count in enumerate(classes):
        wanted = np.repeat(labels[:, position], clips.shape[1])
        present = np.unique(wanted)
        weight, bias = np.zeros((count, scaled.shape[1])), np.full(count, ABSENT)
        if len(present) > 1:
            # Small matrices: threads that wait for each other were seven times slower on two busy cores.
            with threadpool_limits(1):
                fitted = LogisticRegression(C=strength, max_iter=ROUNDS).fit(scaled, wanted)
            rows, offsets = fitted.coef_, fitted.intercept_
            # scikit-learn gives one row, for the second class; halves of opposite sign have the same softmax.
            if len(present) == 2:
                rows, offsets = np.concatenate([-rows, rows]) / 2, np.concatenate([-offsets, offsets]) / 2
            weight[present], bias[present] = rows, offsets
        else:
            # A constant label leaves nothing to fit; a logit of 0 against ABSENT makes its class near certain.
            bias[present] = 0
        weights.append(weight)
        biases.append(bias)
    # Rounded as a model holds it, so that both decide alike.
    dependence = log_dependence(labels, objects, classes).astype(np.float32).astype(np.float64)
    return FittedHeads(centre, spread, weights, biases, dependence)


def choose_strength(
    clips: Clips, labels: Labels, objects: Sequence[str], classes: Sequence[int], seed: int
) -> tuple[float, list[Measurement]]:
    """The strength with the best combined accuracy in a grouped cross-validation over these objects (ties: the first).

    Also returned is the accuracy of each strength: step i is the i-th of `STRENGTHS`. With fewer than two objects there
    is nothing to compare, and the second is taken.
    """
    if len(set(objects)) < 2:
        return STRENGTHS[1], []
    folds = deal(objects, min(FOLDS, len(set(objects))), derive_seed(seed, "strength"))
    reached = []
    for strength in STRENGTHS:
        right = np.zeros(len(objects), bool)
        for held in folds:
            tested = np.array([o in held for o in objects])
            inner = [o for o in objects if o not in held]
            heads = fit_frame_heads(clips[~tested], labels[~tested], inner, classes, strength)
            right[tested] = (heads.predict(clips[tested]) == labels[tested]).all(axis=1)
        reached.append(float(right.mean()))
    curve = [Measurement(step=i, name="inner_combined", value=value) for i, value in enumerate(reached)]
    return STRENGTHS[int(np.argmax(reached))], curve


def deal(objects: Sequence[str], folds: int, seed: int) -> list[frozenset[str]]:
    """Deal the distinct objects, shuffled, into folds whose numbers of objects differ by at most one.

    All videos of an object are in one fold, as they look alike.
    """
    names = sorted(set(objects))
    order = np.random.default_rng(seed).permutation(len(names))
    return [frozenset(names[i] for i in order[fold::folds]) for fold in range(folds)]


def log_dependence(labels: Labels, objects: Sequence[str], classes: Sequence[int]) -> Probabilities:
    """log[P(a, b, ...) / (P(a) P(b) ...)] of each combination: an array with one axis a property.

    The joint distribution counts every object once and adds `SMOOTHING` to each cell; P(a), P(b), ... are its
    marginals. More than `MOST_COMBINATIONS` are a UserError.
    """
    if (number := math.prod(classes)) > MOST_COMBINATIONS:
        raise UserError(
            f"{number} combinations of classes are too many to decide jointly ({MOST_COMBINATIONS} at most); name "
            "fewer properties in properties.yaml, or set encoder.recipe=paper"
        )
    joint = np.full(tuple(classes), SMOOTHING)
    for row in dict(zip(objects, map(tuple, labels.tolist()), strict=True)).values():
        joint[row] += 1
    joint /= joint.sum()
    result: Probabilities = np.log(joint)
    for axis in range(joint.ndim):
        others = tuple(a for a in range(joint.ndim) if a != axis)
        result = result - np.log(joint.sum(axis=others, keepdims=True))
    return result


def decode_jointly(evidence: Sequence[Probabilities], dependence: Probabilities) -> Labels:
    """The combination of each video that maximises the sum of log probabilities and the `log_dependence`.

    The log probabilities are, for each property, videos x classes. This is Bayes' rule where the properties' evidence
    is independent given the classes. Ties go to the combination that comes first in lexicographic order.
    """
    combinations = np.array(list(itertools.product(*map(range, dependence.shape))), dtype=np.int64)
    scores = np.broadcast_to(dependence.ravel(), (len(evidence[0]), dependence.size)).copy()
    for position, table in enumerate(evidence):
        scores += table[:, combinations[:, position]]
    best: Labels = combinations[scores.argmax(axis=1)]
    return best
