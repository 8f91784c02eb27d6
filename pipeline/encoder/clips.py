"""Clips for the encoder: a few frames of each video, freshly drawn in each epoch of training."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pipeline.runtime import derive_seed
from pipeline.sampling import EpochDataset, sample_evaluation, sample_training
from pipeline.videos.frames.store import FrameStore


@dataclass(frozen=True)
class LabelledVideo:
    """A video and its classes, in the catalogue's order of properties."""

    video_id: str
    labels: tuple[int, ...]


class ClipDataset(EpochDataset[dict[str, torch.Tensor]]):
    """Items: `frames`, uint8, k x side x side x RGB; their numbers in the video, `moments`, int64, k; `labels`, int64.

    What is drawn depends on seed, epoch and video alone, so a resumed training sees what an uninterrupted one does.

    Args:
        store: The frames.
        videos: What to draw from.
        per_video: k, frames a clip.
        seed: Of the draws; None gives the evaluation clip (uniform intervals, no flips).
        flip_probability: Chance of a horizontal and, independently, of a vertical flip of the whole clip.
    """

    def __init__(
        self,
        store: FrameStore,
        videos: Sequence[LabelledVideo],
        *,
        per_video: int,
        seed: int | None = None,
        flip_probability: float = 0.0,
    ) -> None:
        super().__init__()
        self.store = store
        self.videos = videos
        self.per_video = per_video
        self.seed = seed
        self.flip_probability = flip_probability

    def __len__(self) -> int:
        return len(self.videos)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        video = self.videos[index]
        rows = self.store.rows(video.video_id)
        flips: tuple[int, ...] = ()
        if self.seed is None:
            positions = sample_evaluation(len(rows), self.per_video)
        else:
            rng = random.Random(derive_seed(self.seed, self.epoch, video.video_id))
            positions = sample_training(len(rows), self.per_video, rng)
            # Axes of frames x height x width: 2 mirrors left and right, 1 top and bottom.
            flips = tuple(axis for axis in (2, 1) if rng.random() < self.flip_probability)
        frames = self.store.pictures(video.video_id, positions)
        frames = np.flip(frames, flips) if flips else frames
        return {
            "frames": torch.from_numpy(np.ascontiguousarray(frames)),
            "moments": torch.tensor([self.store.index[rows[p]].frame_index for p in positions], dtype=torch.int64),
            "labels": torch.tensor(video.labels, dtype=torch.int64),
        }


def collate_clips(items: Iterable[dict[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """Stack clips of equal length."""
    items = list(items)
    return {name: torch.stack([item[name] for item in items]) for name in items[0]}
