"""Clips: a few frames of each video, drawn at random for training or at even distances for evaluation."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional as F
from torch.utils.data import DataLoader

from pipeline.core.records import Flip, Part
from pipeline.core.runtime import derive_seed
from pipeline.encoder.model import PropertyClassifier
from pipeline.encoder.records import Classification
from pipeline.running.errors import UserError
from pipeline.training.sampling import EpochDataset, sample_evaluation, sample_training
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.records import Assignment

AXES: dict[Flip, tuple[int, ...]] = {"none": (), "horizontal": (2,), "vertical": (1,), "both": (1, 2)}
"""Axes of frames x height x width that a flip reverses."""


@dataclass(frozen=True)
class LabelledVideo:
    """A video and its classes, in the catalogue's order of properties."""

    video_id: str
    labels: tuple[int, ...]


@dataclass
class ClipDataset(EpochDataset[dict[str, torch.Tensor]]):
    """Items: `frames`, uint8, k x side x side x RGB; `frame_indices` in the video, int64, k; `labels`, int64.

    What is drawn depends on seed, epoch and video alone, so a resumed training sees what an uninterrupted one does.
    """

    store: FrameStore
    videos: Sequence[LabelledVideo]
    per_video: int
    """k, frames a clip."""
    seed: int | None = None
    """Of the draws; None gives the evaluation clip (uniform intervals, no flips)."""
    flip_probability: float = 0.0

    def __len__(self) -> int:
        return len(self.videos)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        video = self.videos[index]
        rows = self.store.rows(video.video_id)
        flip: Flip = "none"
        if self.seed is None:
            positions = sample_evaluation(len(rows), self.per_video)
        else:
            rng = random.Random(derive_seed(self.seed, self.epoch, video.video_id))
            positions = sample_training(len(rows), self.per_video, rng)
            flip = draw_flip(rng, self.flip_probability)
        frames = np.flip(self.store.pictures(video.video_id, positions), AXES[flip])
        return {
            "frames": torch.from_numpy(np.ascontiguousarray(frames)),
            "frame_indices": torch.tensor([self.store.index[rows[p]].frame_index for p in positions]),
            "labels": torch.tensor(video.labels),
        }


def draw_flip(rng: random.Random, probability: float) -> Flip:
    """Draw a horizontal and, independently, a vertical flip of a clip, each with this probability."""
    across, down = (rng.random() < probability for _ in range(2))
    return tuple(AXES)[across + 2 * down]


@dataclass(frozen=True)
class EncoderData:
    """Frames, labels and parts: what an encoder is trained and evaluated on."""

    store: FrameStore
    catalogue: Catalogue
    assignments: Sequence[Assignment]
    per_video: int

    def videos(self, part: Part) -> list[LabelledVideo]:
        """The labelled videos of a part."""
        return [
            LabelledVideo(a.video_id, self.catalogue.labels(a.object_id)) for a in self.assignments if a.part == part
        ]

    @property
    def classes(self) -> list[int]:
        """Number of classes of each property."""
        return [len(p.levels) for p in self.catalogue.properties]


@torch.inference_mode()
def classify(
    model: PropertyClassifier, data: EncoderData, parts: Sequence[Part], batch_size: int, device: torch.device
) -> list[Classification]:
    """Classify the evaluation clips of these parts: part by part, property by property, video by video."""
    model = model.to(device).eval()
    objects = {a.video_id: a.object_id for a in data.assignments}
    records = []
    for part in parts:
        videos = data.videos(part)
        clips = ClipDataset(data.store, videos, per_video=data.per_video)
        outputs = [
            model(batch["frames"].to(device), batch["frame_indices"].to(device))["logits"].cpu()
            for batch in DataLoader(clips, batch_size=batch_size)
        ]
        if not outputs:
            continue
        logits = torch.cat(outputs)
        check_finite(logits, videos)
        decided = model.decide(logits)
        for index, property_ in enumerate(data.catalogue.properties):
            rows = F.softmax(logits.split(data.classes, dim=1)[index].double(), dim=1)
            records += [
                Classification(
                    video_id=video.video_id,
                    object_id=objects[video.video_id],
                    part=part,
                    property=property_.name,
                    expected=video.labels[index],
                    predicted=classes[index],
                    probabilities=tuple(row.tolist()),
                )
                for video, row, classes in zip(videos, rows, decided.tolist(), strict=True)
            ]
    return records


def check_finite(values: torch.Tensor, videos: Sequence[LabelledVideo]) -> None:
    """Raise UserError naming the first video whose row of `values`, videos x whatever, is not finite."""
    for video, finite in zip(videos, values.isfinite().all(1).tolist(), strict=True):
        if not finite:
            raise UserError(
                f"{video.video_id}: what the encoder says of it is not finite; check the video and encoder.weights"
            )
