"""Size and number of frames, on one core: what they cost the encoder pretrained on scenes, and what they bring.

It is frozen and has seen no label; each setting is judged by a grouped cross-validation of heads on its features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from benchmarks.classifier import heads_error
from benchmarks.errors import WRONG
from benchmarks.frames import bench_videos
from benchmarks.table import Row, make_rows
from benchmarks.timing import counted, interleaved, machine, megabytes
from pipeline.config import PRETRAINED, FramesConfig
from pipeline.core.errors import UserError
from pipeline.encoder.clips import ClipDataset, LabelledVideo
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.training.trainable import load_trainable
from pipeline.videos.files import list_videos
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import FrameStore

SIDE, FRAMES = 120, 5
"""Pixels and frames a video, where these are not what differs."""
SETTINGS = {
    "frame size": {f"{side} pixels": (side, FRAMES) for side in (SIDE, 90, 60, 30)},
    "frames a video": {f"{number} frame{'s' * (number > 1)}": (SIDE, number) for number in (FRAMES, 1, 2, 10)},
}
"""Pixels and frames, by question and name; the first of each is its baseline."""
CONFIG = FramesConfig(selection="salient", pixels=SIDE)
Clip = tuple[torch.Tensor, torch.Tensor]
"""Difference pictures and the frames' places in the video."""


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    videos: int = 25
    """That are timed, spread over the objects."""
    repeats: int = 5
    folds: int = 5
    deals: int = 3


def measure(root: Path, size: Size | None = None) -> list[Row]:
    """Both questions, over the videos that `frames.bench_videos` finds.

    Raises:
        UserError: without pretrained weights, or where there are too few objects for folds.
    """
    size = size or Size()
    folder, catalogue = bench_videos(root)
    pretrained = root / PRETRAINED
    if not pretrained.is_file():
        raise UserError(f"{pretrained}: no such file; `octopi scale small`, `dvc repro pretrain` make it")
    if len({f.object_id for f in list_videos(folder, catalogue).files}) < 2 * size.folds:
        raise UserError(f"{folder}: bench encoder needs videos of {2 * size.folds} objects or more")
    torch.set_num_threads(1)
    encoder = SceneEncoder()
    load_trainable(encoder, pretrained)
    encoder.eval()

    @torch.inference_mode()
    def describe(clips: Sequence[Clip], video: int) -> np.ndarray:
        found: np.ndarray = encoder.describe(*clips[video]).numpy()
        return found

    with TemporaryDirectory() as made:
        videos = extract_frames(folder, catalogue, CONFIG, Path(made) / "frames", Path(made) / "partial").videos
        store = FrameStore(Path(made) / "frames", "subtract")
        named = [LabelledVideo(video.video_id, ()) for video in videos]
        items = {
            number: list(map(ClipDataset(store, named, per_video=number).__getitem__, range(len(named))))
            for _, number in {setting for own in SETTINGS.values() for setting in own.values()}
        }
    objects = [video.object_id for video in videos]
    labels, classes = np.array([catalogue.labels(o) for o in objects]), [len(p.levels) for p in catalogue.properties]
    # At equal distances in the order of the videos, which is by object.
    count = min(size.videos, len(videos))
    timed = [i * len(videos) // count for i in range(count)]
    rows: list[Row] = []
    for question, settings in SETTINGS.items():
        runs, errors, counts = {}, {}, {}
        for name, (side, number) in settings.items():
            clips = [(_resized(item["frames"], side), item["frame_indices"]) for item in items[number]]
            runs[name] = partial(describe, clips)
            seen = np.stack([runs[name](video) for video in range(len(videos))])
            errors[name] = heads_error(seen, seen, labels, objects, classes, size.folds, size.deals)
            flops = counted(partial(runs[name], 0))[1]
            counts[name] = {"frames": float(number), "megabytes": megabytes(encoder), "flops": flops}
        rows += make_rows(
            question,
            interleaved(runs, timed, size.repeats),
            unit="ms a video, encoder alone",
            baseline=next(iter(settings)),
            errors=errors,
            error_of=WRONG,
            counts=counts,
            machine=machine("1 thread"),
        )
    return rows


def _resized(pictures: torch.Tensor, side: int) -> torch.Tensor:
    """Difference pictures, uint8, k x side x side x RGB, by area."""
    smaller = [cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA) for picture in pictures.numpy()]
    return torch.from_numpy(np.stack(smaller))
