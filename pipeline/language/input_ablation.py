"""Is touch used at all? Stores that hand out something else than what the sensor felt."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence

import torch

from pipeline.embeddings import EmbeddingStore, TactileFeatures
from pipeline.errors import UserError
from pipeline.records import Flip, Question, Touch
from pipeline.runtime import derive_seed


class SwappedTouch:
    """Each video's embeddings are those of a video of another object.

    The objects of the questions are put in a random ring and each is given the touch of the next, so no object keeps
    its own. It may have the same classes all the same.
    """

    def __init__(self, store: EmbeddingStore, questions: Iterable[Question], seed: int) -> None:
        self._store = store
        self._instead = _ring(_videos(questions), seed)

    @property
    def dim(self) -> int:
        """As the store's."""
        return self._store.dim

    def count(self, video_id: str) -> int:
        """Frames of the other video."""
        return self._store.count(self._instead[video_id])

    def features(self, video_id: str, positions: Sequence[int], flip: Flip = "none") -> torch.Tensor:
        """Embeddings of the other video: positions x dim."""
        return self._store.features(self._instead[video_id], positions, flip)


class NoisyTouch:
    """Normal noise with the mean and deviation of each dimension over all embeddings, the same at each call."""

    def __init__(self, store: EmbeddingStore, seed: int) -> None:
        self._store = store
        self._seed = seed
        self._mean = store.tensor.mean(0)
        self._deviation = store.tensor.std(0, correction=0)

    @property
    def dim(self) -> int:
        """As the store's."""
        return self._store.dim

    def count(self, video_id: str) -> int:
        """As the store's."""
        return self._store.count(video_id)

    def features(self, video_id: str, positions: Sequence[int], flip: Flip = "none") -> torch.Tensor:
        """Noise of this video, frame and mirroring: positions x dim."""
        rows = [self._row(video_id, position, flip) for position in positions]
        return torch.stack(rows) if rows else self._store.tensor[:0]

    def _row(self, video_id: str, position: int, flip: Flip) -> torch.Tensor:
        generator = torch.Generator().manual_seed(derive_seed(self._seed, "noise", video_id, position, flip))
        return self._mean + self._deviation * torch.randn(self.dim, generator=generator)


def ablate_input(store: EmbeddingStore, touch: Touch, questions: Sequence[Question], seed: int) -> TactileFeatures:
    """What a variant is given of the questions' videos.

    `removed` is no matter of the embeddings but of the prompt, which then has no frame to put one at.
    """
    match touch:
        case Touch.SWAPPED:
            return SwappedTouch(store, questions, seed)
        case Touch.NOISE:
            return NoisyTouch(store, seed)
    return store


def _videos(questions: Iterable[Question]) -> dict[str, list[str]]:
    """Object to its videos, both in alphabetical order."""
    found: dict[str, set[str]] = {}
    for question in questions:
        for object_id, video_id in zip(question.objects, question.videos, strict=True):
            found.setdefault(object_id, set()).add(video_id)
    return {o: sorted(found[o]) for o in sorted(found)}


def _ring(videos: Mapping[str, Sequence[str]], seed: int) -> dict[str, str]:
    objects = list(videos)
    if len(objects) == 1:
        raise UserError(
            "ablation.touch: swapped needs questions about two objects at least; leave it out or add objects"
        )
    random.Random(derive_seed(seed, "swapped")).shuffle(objects)
    return {
        video: videos[other][i % len(videos[other])]
        for own, other in zip(objects, objects[1:] + objects[:1], strict=True)
        for i, video in enumerate(videos[own])
    }
