"""Fitting of the strong recipe's heads: logistic regression on the frozen features of single frames.

It is convex, so there is nothing to schedule; the one setting, how strongly weights are held down, is chosen by a
cross-validation inside the training objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from pipeline.encoder.baseline.predictor import Labels, decode_jointly, log_dependence
from pipeline.encoder.baseline.validation import deal
from pipeline.encoder.frame_classifier import FARTHEST, FrameVotes
from pipeline.records import Measurement
from pipeline.runtime import derive_seed

STRENGTHS = (3e-4, 1e-3, 3e-3, 1e-2)
"""Inverse weights of the penalty (scikit-learn's C) that are tried."""
FOLDS = 5
ROUNDS = 500
"""Of the solver, at most."""

Clips = npt.NDArray[np.float32]
"""Videos x frames x features."""


@dataclass(frozen=True)
class Votes:
    """Fitted heads, as `FrameVotes` holds them."""

    centre: npt.NDArray[np.float32]
    spread: npt.NDArray[np.float32]
    weights: list[npt.NDArray[np.float64]]
    """Classes x features of each property."""
    biases: list[npt.NDArray[np.float64]]
    dependence: npt.NDArray[np.float64]

    def evidence(self, clips: Clips) -> list[npt.NDArray[np.float64]]:
        """Log of the mean probability over frames, videos x classes of each property."""
        from scipy.special import log_softmax, logsumexp

        scaled = np.clip((clips - self.centre) / self.spread, -FARTHEST, FARTHEST).astype(np.float64)
        votes = [scaled @ w.T + b for w, b in zip(self.weights, self.biases, strict=True)]
        return [logsumexp(log_softmax(v, axis=-1), axis=1) - np.log(clips.shape[1]) for v in votes]

    def predict(self, clips: Clips) -> Labels:
        """The most probable combination, videos x properties."""
        return decode_jointly(self.evidence(clips), self.dependence)

    def put_into(self, model: FrameVotes) -> None:
        """Copy into a model's parameters."""
        with torch.no_grad():
            for parameter, value in ((model.centre, self.centre), (model.spread, self.spread)):
                parameter.copy_(torch.from_numpy(value))
            model.dependence.copy_(torch.from_numpy(self.dependence))
            for head, w, b in zip(model.heads.children(), self.weights, self.biases, strict=True):
                assert isinstance(head, torch.nn.Linear)
                head.weight.copy_(torch.from_numpy(w))
                head.bias.copy_(torch.from_numpy(b))


def fit_votes(
    clips: Clips, labels: Labels, objects: Sequence[str], classes: Sequence[int], strength: float, *, joint: bool = True
) -> Votes:
    """Fit the heads of all properties.

    Args:
        clips: Of the training videos.
        labels: Videos x properties.
        objects: Each video's object.
        classes: How many classes each property has; one that training lacks gets a probability near 0.
        strength: One of `STRENGTHS`.
        joint: Whether decisions weigh how often classes occur together.
    """
    from sklearn.linear_model import LogisticRegression
    from threadpoolctl import threadpool_limits

    frames = clips.reshape(-1, clips.shape[2])
    centre, spread = frames.mean(axis=0), frames.std(axis=0)
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
            if len(present) == 2:  # scikit-learn gives one row for the second class alone.
                rows, offsets = np.concatenate([-rows, rows]) / 2, np.concatenate([-offsets, offsets]) / 2
            weight[present], bias[present] = rows, offsets
        else:
            bias[present] = 0
        weights.append(weight)
        biases.append(bias)
    # Rounded as a model holds it, so that both decide alike.
    dependence = log_dependence(labels, objects, classes).astype(np.float32).astype(np.float64)
    return Votes(centre, spread, weights, biases, dependence if joint else np.zeros_like(dependence))


ABSENT = -10.0
"""Bias of a class that training lacks: a probability of some 5e-5."""


def choose_strength(
    clips: Clips, labels: Labels, objects: Sequence[str], classes: Sequence[int], seed: int, *, joint: bool = True
) -> tuple[float, list[Measurement]]:
    """The strength with the best combined accuracy in a grouped cross-validation over these objects (ties: the first).

    Returns:
        The strength, and what each reached: step i is the i-th of `STRENGTHS`. With fewer than two objects there is
        nothing to compare, and the second is taken.
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
            votes = fit_votes(clips[~tested], labels[~tested], inner, classes, strength, joint=joint)
            right[tested] = (votes.predict(clips[tested]) == labels[tested]).all(axis=1)
        reached.append(float(right.mean()))
    curve = [Measurement(step=i, name="inner_combined", value=value) for i, value in enumerate(reached)]
    return STRENGTHS[int(np.argmax(reached))], curve
