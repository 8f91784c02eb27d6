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

FRAMES = 5


@dataclass(frozen=True)
class Recording:
    """A video to describe."""

    path: Path
    frames: int
    """That decode (`Video.frames`)."""
    untouched: tuple[int, ...]
    """Numbers of the frames without contact (`Probe.untouched`)."""

    def __str__(self) -> str:
        return str(self.path)


def recording_features(recordings: Sequence[Recording]) -> Features:
    """Features of five frames at equal distances: float32, recordings x features; many recordings at once."""
    return np.stack(list(run_parallel(describe, recordings, "features", "video")))


def describe(recording: Recording) -> Features:
    """Features of one recording."""
    inner = np.linspace(0, recording.frames - 1, FRAMES + 2).round().astype(int)[1:-1].tolist()
    wanted = {*inner, *recording.untouched}  # A whole recording may be gigabytes.
    kept = {i: frame for i, frame in enumerate(decode(recording.path)) if i in wanted}
    return video_features([kept[i] for i in inner], mean([kept[i] for i in recording.untouched]))


def mean(frames: Sequence[Image]) -> Plane:
    """The mean of frames: float32, height x width x BGR."""
    whole: Plane = np.mean(np.stack(frames), axis=0, dtype=np.float32)
    return whole
