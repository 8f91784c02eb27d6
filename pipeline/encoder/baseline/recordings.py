"""The baseline's features of whole recordings, decoded here: the frames that other models are given are cropped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.encoder.baseline.features import Plane, video_features
from pipeline.encoder.baseline.predictor import Features
from pipeline.parallel import run_parallel
from pipeline.videos.decoding import Image, decode
from pipeline.videos.frames.reference import reference_indices

FRAMES = 5


@dataclass(frozen=True)
class Recording:
    """A video to describe."""

    path: Path
    starts_touching: bool
    """Whether its no-contact reference has to come from its end (`Probe.starts_touching`)."""

    def __str__(self) -> str:
        return str(self.path)


def recording_features(recordings: Sequence[Recording]) -> Features:
    """Features of five frames at equal distances: float32, recordings x features; many recordings at once."""
    return np.stack(list(run_parallel(describe, recordings, "features", "video")))


def describe(recording: Recording) -> Features:
    """Features of one recording."""
    frames = list(decode(recording.path))
    inner = np.linspace(0, len(frames) - 1, FRAMES + 2).round().astype(int)[1:-1]
    return video_features([frames[i] for i in inner], mean_reference(frames, recording.starts_touching))


def mean_reference(frames: Sequence[Image], starts_touching: bool) -> Plane:
    """The mean of a video's no-contact frames: float32, height x width x BGR."""
    last = len(frames) - 1
    order = [last - i if starts_touching else i for i in reference_indices(len(frames))]
    mean: Plane = np.mean(np.stack([frames[i] for i in order]), axis=0, dtype=np.float32)
    return mean
