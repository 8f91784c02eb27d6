"""Encoders on one core: whole candidates, then the side of the frames that the pretrained one is shown.

A candidate's cost is a video's from the file to the decided classes; weights are random where cost depends on no
training, and errors are those of the report with most candidates in its cross-validation. On frames of each side the
pretrained encoder, frozen, is timed alone, and judged by a grouped cross-validation of its heads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from benchmarks.classifier import heads_error
from benchmarks.errors import WRONG, error_of
from benchmarks.frames import bench_videos
from benchmarks.table import Row, make_rows
from benchmarks.timing import counted, interleaved, machine, megabytes
from pipeline.config import PRETRAINED, EncoderConfig, FramesConfig
from pipeline.config.params import load_params
from pipeline.core.errors import UserError
from pipeline.core.io import read_csv
from pipeline.core.records import ScoreRow
from pipeline.core.runtime import seed_everything
from pipeline.encoder.candidates import CANDIDATES, Candidate
from pipeline.encoder.clips import ClipDataset, LabelledVideo
from pipeline.encoder.frame_classifier import JointFrameClassifier
from pipeline.encoder.model import Heads, PropertyClassifier, base_encoder
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.training.sampling import sample_evaluation
from pipeline.training.trainable import load_trainable
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import VideoFile, list_videos
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.frames.subtraction import subtract
from pipeline.weights import CLIP_CONFIG

SIDE, FRAMES = 120, 5
"""Pixels and frames a video, where these are not what differs."""
SIDES = (SIDE, 90, 60, 30)
CONFIG = FramesConfig(selection="salient", pixels=SIDE)
Clip = tuple[torch.Tensor, torch.Tensor]
"""Difference pictures and the frames' places in the video."""
WHOLE = ("probe", "paper", "scratch", "pretrained", "pretrained-one-frame", "pretrained-ten-frames")


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
        UserError: without pretrained weights or a CLIP, or where there are too few objects for folds.
    """
    size = size or Size()
    folder, catalogue = bench_videos(root)
    pretrained = root / PRETRAINED
    if not pretrained.is_file():
        raise UserError(f"{pretrained}: no such file; `octopi scale small`, `dvc repro pretrain` make it")
    files = list_videos(folder, catalogue).files
    if len({f.object_id for f in files}) < 2 * size.folds:
        raise UserError(f"{folder}: bench encoder needs videos of {2 * size.folds} objects or more")
    params = load_params(root / "params.yaml").encoder
    clip = root / params.weights
    if not (clip / CLIP_CONFIG).is_file():
        raise UserError(f"{clip}: bench encoder compares with a CLIP; name its folder in encoder.weights")
    changed = {"recipe": "paper", "backbone": ("clip",), "reference": "none", "weights": str(clip)}
    # At equal distances in the order of the videos, which is by object.
    count = min(size.videos, len(files))
    timed = [files[i * len(files) // count] for i in range(count)]
    torch.set_num_threads(1)
    rows = whole(timed, params.model_copy(update=changed), catalogue, root / "reports", size.repeats)
    return [*rows, *frame_size(folder, [f.video_id for f in timed], catalogue, pretrained, size)]


def whole(
    files: Sequence[VideoFile], encoder: EncoderConfig, catalogue: Catalogue, reports: Path, repeats: int
) -> list[Row]:
    """Candidates from the file to the classes."""
    settings: dict[str, Callable[[VideoFile], object]] = {}
    counts: dict[str, dict[str, float]] = {}
    for name in WHOLE:
        candidate = CANDIDATES[name]
        frames = candidate.frames or FRAMES
        model = _classifier(candidate, encoder, [len(p.levels) for p in catalogue.properties]).eval()
        settings[name] = partial(_decide, model, candidate.reference == "own", frames)
        clip = torch.zeros(1, frames, SIDE, SIDE, 3, dtype=torch.uint8), torch.zeros(1, frames, dtype=torch.int64)
        counts[name] = {"frames": frames, "megabytes": megabytes(model), "flops": counted(partial(model, *clip))[1]}
    # Of the report that compares most of them, and of such the one over most videos.
    tables = [read_csv(path, ScoreRow) for path in sorted(reports.glob("*/scores.csv"))]
    scores = [[row for row in table if (row.task, row.measure) == ("cross_validation", "combined")] for table in tables]
    chosen = max(filter(None, scores), key=lambda rows: (len(rows), rows[0].n), default=[])
    return make_rows(
        "encoder",
        interleaved(settings, files, repeats),
        unit="ms a video",
        baseline="pretrained",
        errors={row.encoder: error_of(row) for row in chosen if row.encoder in WHOLE},
        error_of=WRONG,
        counts=counts,
        machine=machine("1 thread"),
    )


def _classifier(candidate: Candidate, config: EncoderConfig, classes: Sequence[int]) -> PropertyClassifier:
    """A candidate with heads that have learnt nothing."""
    seed_everything(0)
    if candidate.kind == "frame_heads":
        return JointFrameClassifier(base_encoder(config) if "clip" in candidate.backbone else SceneEncoder(), classes)
    if candidate.recipe == "scratch":
        encoder = SceneEncoder()
        return PropertyClassifier(encoder, Heads(encoder.dim, classes), classes)
    return property_classifier(config, classes)


@torch.inference_mode()
def _decide(model: PropertyClassifier, differences: bool, frames: int, file: VideoFile) -> torch.Tensor:
    found = scan(file, CONFIG)
    if not isinstance(found, Scan):
        raise UserError(f"{file}: {found.measured}")
    chosen = [found.kept[p] for p in sample_evaluation(len(found.kept), frames)]
    pictures = np.stack([kept.image for kept in chosen])
    if differences:
        pictures = subtract(pictures, found.reference)
    places = torch.tensor([[kept.index for kept in chosen]])
    return model.decide(model(torch.from_numpy(pictures)[None], places)["logits"])


def frame_size(folder: Path, timed: Sequence[str], catalogue: Catalogue, pretrained: Path, size: Size) -> list[Row]:
    """Cost and error of the frozen pretrained encoder on frames of several sides."""
    encoder = SceneEncoder()
    load_trainable(encoder, pretrained)
    encoder.eval()

    @torch.inference_mode()
    def describe(clips: Sequence[Clip], video: int) -> np.ndarray:
        found: np.ndarray = encoder.describe(*clips[video]).numpy()
        return found

    with TemporaryDirectory() as made:
        videos = extract_frames(folder, catalogue, CONFIG, Path(made) / "frames", Path(made) / "partial").videos
        dataset = ClipDataset(
            FrameStore(Path(made) / "frames", "subtract"),
            [LabelledVideo(video.video_id, ()) for video in videos],
            per_video=FRAMES,
        )
        items = [dataset[number] for number in range(len(dataset))]
    objects = [video.object_id for video in videos]
    labels, classes = np.array([catalogue.labels(o) for o in objects]), [len(p.levels) for p in catalogue.properties]
    runs, errors, counts = {}, {}, {}
    for side in SIDES:
        name = f"{side} pixels"
        clips = [(_resized(item["frames"], side), item["frame_indices"]) for item in items]
        runs[name] = partial(describe, clips)
        seen = np.stack([runs[name](video) for video in range(len(videos))])
        errors[name] = heads_error(seen, seen, labels, objects, classes, size.folds, size.deals)
        flops = counted(partial(runs[name], 0))[1]
        counts[name] = {"frames": float(FRAMES), "megabytes": megabytes(encoder), "flops": flops}
    places = [place for place, video in enumerate(videos) if video.video_id in timed]
    return make_rows(
        "frame size",
        interleaved(runs, places, size.repeats),
        unit="ms a video, encoder alone",
        baseline=f"{SIDE} pixels",
        errors=errors,
        error_of=WRONG,
        counts=counts,
        machine=machine("1 thread"),
    )


def _resized(pictures: torch.Tensor, side: int) -> torch.Tensor:
    """Difference pictures, uint8, k x side x side x RGB, by area."""
    smaller = [cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA) for picture in pictures.numpy()]
    return torch.from_numpy(np.stack(smaller))
