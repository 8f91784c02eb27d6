"""Size of frames, on one core: what it costs the encoder pretrained on scenes, and what it brings.

The encoder is frozen and has seen no label; each size is judged by a grouped cross-validation of heads on its features.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from benchmarks.classifier import heads_error
from benchmarks.frames import bench_videos
from benchmarks.table import WRONG, Row, interleaved, machine, make_rows
from pipeline.config import PRETRAINED, FramesConfig
from pipeline.core.errors import UserError
from pipeline.encoder.data import ClipDataset, LabelledVideo
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.training.trainable import load_trainable
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import FrameStore

SIDES, FRAMES = (120, 90, 60, 30), 5
"""Sides of frames in pixels, the baseline first, and frames per video."""


def measure(root: Path, timed: int = 25, repeats: int = 5, folds: int = 5, deals: int = 3) -> list[Row]:
    """Errors over all `frames.bench_videos`, costs over `timed` of them; UserError without pretrained weights."""
    folder, catalogue = bench_videos(root, folds)
    pretrained = root / PRETRAINED
    if not pretrained.is_file():
        raise UserError(f"{pretrained}: no such file; `octopi scale small`, `dvc repro pretrain` make it")
    torch.set_num_threads(1)
    encoder = SceneEncoder()
    load_trainable(encoder, pretrained)
    encoder.eval()

    @torch.inference_mode()
    def describe(pictures: Sequence[torch.Tensor], video: int) -> np.ndarray:
        found: np.ndarray = encoder.describe(pictures[video], items[video]["frame_indices"]).numpy()
        return found

    config = FramesConfig(selection="salient", pixels=SIDES[0])
    with TemporaryDirectory() as made:
        videos = extract_frames(folder, catalogue, config, Path(made) / "frames", Path(made) / "partial").videos
        store = FrameStore(Path(made) / "frames", "subtract")
        clips = ClipDataset(store, [LabelledVideo(v.video_id, ()) for v in videos], per_video=FRAMES)
        items = [clips[video] for video in range(len(videos))]
    objects = [video.object_id for video in videos]
    runs, errors = {}, {}
    for side in SIDES:
        # Difference pictures, uint8, k x side x side x RGB, by area.
        shape, method = (side, side), cv2.INTER_AREA
        resized = [[cv2.resize(p, shape, interpolation=method) for p in item["frames"].numpy()] for item in items]
        pictures = [torch.from_numpy(np.stack(own)) for own in resized]
        runs[f"{side} pixels"] = partial(describe, pictures)
        seen = np.stack([describe(pictures, video) for video in range(len(videos))])
        errors[f"{side} pixels"] = heads_error(seen, seen, objects, catalogue, folds, deals)
    # At equal distances in the order of the videos, which is by object.
    count = min(timed, len(videos))
    return make_rows(
        "frame size",
        interleaved(runs, [i * len(videos) // count for i in range(count)], repeats),
        unit="ms a video, encoder alone",
        baseline=f"{SIDES[0]} pixels",
        errors=errors,
        error_of=WRONG,
        counts={name: {"frames": float(FRAMES)} for name in runs},
        machine=machine("1 thread"),
    )
