"""Size of frames, on one core: what it costs the encoder pretrained on scenes, and what it brings.

The encoder is frozen and has seen no label; each size is judged by a grouped cross-validation of heads on its features.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from benchmarks.classifier import heads_error
from benchmarks.frames import bench_videos
from benchmarks.table import WRONG, Row, machine, make_rows, timed
from pipeline.config import FramesConfig
from pipeline.core.layout import PRETRAINED
from pipeline.encoder.data import ClipDataset, LabelledVideo
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.running.errors import UserError
from pipeline.training.trainable import load_trainable
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import FrameStore

SIDES, FRAMES = (120, 90, 60, 30), 5
"""Sides of frames in pixels, the baseline first, and frames per video."""


def measure(root: Path, folds: int = 5, deals: int = 3) -> list[Row]:
    """Errors over all `frames.bench_videos`, costs over them but the first; UserError without pretrained weights."""
    folder, catalogue = bench_videos(root, folds)
    pretrained = root / PRETRAINED
    if not pretrained.is_file():
        raise UserError(f"{pretrained}: no such file; `octopi scale small`, `dvc repro pretrain` make it")
    torch.set_num_threads(1)
    encoder = SceneEncoder()
    load_trainable(encoder, pretrained)
    encoder.eval()

    @torch.inference_mode()
    def describe(pictures: torch.Tensor, frame_indices: torch.Tensor) -> np.ndarray:
        return np.asarray(encoder.describe(pictures, frame_indices))

    config = FramesConfig(selection="salient", pixels=SIDES[0])
    found: dict[str, list[tuple[np.ndarray, float]]] = {f"{side} pixels": [] for side in SIDES}
    with TemporaryDirectory() as made:
        videos = extract_frames(folder, catalogue, config, Path(made) / "frames", Path(made) / "partial").videos
        store = FrameStore(Path(made) / "frames", "subtract")
        clips = ClipDataset(store, [LabelledVideo(v.video_id, ()) for v in videos], per_video=FRAMES)
        # All sizes have their turn at a video before the next, so that a busy machine slows all alike.
        for item in (clips[place] for place in range(len(videos))):
            for side, own in zip(SIDES, found.values(), strict=True):
                # Difference pictures, uint8, k x side x side x RGB, by area.
                shape, method = (side, side), cv2.INTER_AREA
                resized = [cv2.resize(p, shape, interpolation=method) for p in item["frames"].numpy()]
                own.append(timed(partial(describe, torch.from_numpy(np.stack(resized)), item["frame_indices"])))
    objects = [video.object_id for video in videos]
    return make_rows(
        "frame size",
        {name: [spent for _, spent in own[1:]] for name, own in found.items()},  # The first one warms up.
        unit="ms a video, encoder alone",
        baseline=f"{SIDES[0]} pixels",
        errors={
            name: heads_error(np.stack([seen for seen, _ in own]), objects, catalogue, folds, deals)
            for name, own in found.items()
        },
        error_of=WRONG,
        counts={name: {"frames": float(FRAMES)} for name in found},
        machine=machine("1 thread"),
    )
