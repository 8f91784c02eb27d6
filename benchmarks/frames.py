"""Frames: what extracting them costs, and what each rule for choosing them makes a predictor get wrong.

The published code (github.com/clear-nus/octopi, utils/process_dataset.py) decodes each video twice, in one process, and
writes every chosen frame as a JPEG of its own. Bare decoding makes a picture of every frame and does nothing with it.
Errors are those of heads on a frozen EfficientNet-lite0, and costs the pass that selects and the features of what it
selects.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import get_args

import cv2
import numpy as np

from benchmarks.classifier import features, heads_error, weights
from benchmarks.errors import WRONG
from benchmarks.table import Row, make_rows
from benchmarks.timing import interleaved, machine, timed
from pipeline.config import FramesConfig, Selection
from pipeline.config.params import load_params
from pipeline.core.errors import UserError
from pipeline.core.parallel import run_parallel
from pipeline.training.sampling import sample_evaluation
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.decoding import Image, decode
from pipeline.videos.files import VideoFile, list_videos
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.selection import changed_pixels
from pipeline.videos.frames.subtraction import subtract

FRACTION, SMALL, LARGE = 0.3, 64, 224
PUBLISHED = "published way"
BASELINE = "salient, 5 frames"


def bench_videos(root: Path) -> tuple[Path, Catalogue]:
    """The videos to measure with: the folder that OCTOPI_DATA_DIR names, else the chain's own."""
    data = load_params(root / "params.yaml").data
    return Path(os.environ.get("OCTOPI_DATA_DIR") or root / data.dir), load_catalogue(root / data.catalogue)


def measure(root: Path, repeats: int = 3, folds: int = 5, deals: int = 10) -> list[Row]:
    """Both questions, over the videos of `bench_videos`.

    Args:
        repeats: Of the extractions.
        folds: Of the cross-validation.
        deals: How often folds are dealt; with three, a setting moves by a point or two.

    Raises:
        UserError: where there are no videos, or too few objects for folds.
    """
    folder, catalogue = bench_videos(root)
    if len({f.object_id for f in list_videos(folder, catalogue).files}) < 2 * folds:
        raise UserError(f"{folder}: bench frames needs videos of {2 * folds} objects or more")
    return [*extraction(folder, catalogue, repeats), *selection(folder, catalogue, folds, deals)]


def extraction(folder: Path, catalogue: Catalogue, repeats: int) -> list[Row]:
    """Every rule's extraction of all videos against bare decoding and the published way."""
    files = list_videos(folder, catalogue).files

    def extract(rule: Selection, size: int) -> Callable[[object], None]:
        def run(_: object) -> None:
            with TemporaryDirectory() as out:
                config = FramesConfig(selection=rule, pixels=size, fraction=FRACTION)
                extract_frames(folder, catalogue, config, Path(out) / "frames", Path(out) / "partial")

        return run

    def publish(_: object) -> None:
        with TemporaryDirectory() as out:
            for file in files:
                _publish(file.path, Path(out) / file.video_id)

    ways: dict[str, Callable[[object], object]] = {
        PUBLISHED: publish,
        "bare decoding": lambda _: sum(run_parallel(_decode, [f.path for f in files], "bare decoding", "video")),
        **{f"{rule}, {SMALL} pixels": extract(rule, SMALL) for rule in get_args(Selection)},
        f"salient, {LARGE} pixels": extract("salient", LARGE),
    }
    costs = interleaved(ways, [None], repeats, warm=False)
    each = {name: [ms / len(files) for ms in own] for name, own in costs.items()}
    return make_rows(
        "frame extraction", each, unit="ms a video", baseline=PUBLISHED, machine=machine("a process a core")
    )


def _decode(path: Path) -> int:
    return sum(1 for _ in decode(path))


def _opencv(path: Path) -> Iterator[Image]:
    """The frames as the published code reads them."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    while (read := capture.read())[0]:
        yield read[1]


def _publish(path: Path, out: Path) -> None:
    """Score in a first decode, write JPEGs in a second."""
    scores, before, count = [], None, 0
    for index, frame in enumerate(_opencv(path)):
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        if before is not None:
            scores.append((-changed_pixels(grey, before), index))
        before, count = grey, index + 1
    chosen = {index for _, index in sorted(scores)[: int(FRACTION * count)]}
    out.mkdir(parents=True)
    for index, frame in enumerate(_opencv(path), 1):
        if index in chosen:
            cv2.imwrite(str(out / f"{index:010d}.jpg"), frame)


@dataclass(frozen=True)
class Setting:
    """A rule, and how many of the frames that it keeps."""

    rule: Selection
    count: int

    def __str__(self) -> str:
        return f"{self.rule}, {self.count} frame{'s' * (self.count > 1)}"


SETTINGS = tuple(Setting(rule, count) for rule in get_args(Selection) for count in (1, 3, 5, 10))


@dataclass(frozen=True)
class Sample:
    """One video under every setting."""

    object_id: str
    features: tuple[np.ndarray, ...]
    """Frames x features."""
    frames: tuple[int, ...]
    costs: tuple[float, ...]
    """Milliseconds of the pass that selects and of the chosen frames' features."""


def selection(folder: Path, catalogue: Catalogue, folds: int, deals: int) -> list[Row]:
    """Frames against error: every setting on the same videos by the same folds, drawn as for evaluation."""
    files = list_videos(folder, catalogue).files
    with weights() as folder:
        found = run_parallel(partial(_sample, folder), files, "frame selection", "video")
        samples = [s for s in found if s is not None]
    objects = [s.object_id for s in samples]
    labels = np.array([catalogue.labels(o) for o in objects])
    classes = [len(p.levels) for p in catalogue.properties]
    costs, errors, counts = {}, {}, {}
    for place, setting in enumerate(map(str, SETTINGS)):
        clips = np.stack([s.features[place] for s in samples])
        errors[setting] = heads_error(clips, clips, labels, objects, classes, folds, deals)
        costs[setting] = [s.costs[place] for s in samples]
        counts[setting] = {"frames": fmean(s.frames[place] for s in samples)}
    return make_rows(
        "frames",
        costs,
        unit="ms a video",
        baseline=BASELINE,
        errors=errors,
        error_of=WRONG,
        counts=counts,
        machine=machine("1 thread a video"),
    )


def _sample(weights: Path, file: VideoFile) -> Sample | None:
    """None for a video that cannot be read or that the published rule leaves out."""
    passes: dict[Selection, tuple[Scan, float]] = {}
    for rule in get_args(Selection):
        config = FramesConfig(selection=rule, fraction=FRACTION, pixels=LARGE)
        found, spent = timed(partial(scan, file, config))
        if not isinstance(found, Scan) or not found.kept:
            return None
        passes[rule] = found, spent
    costs, clips, counts = [], [], []
    for setting in SETTINGS:
        chosen, spent = passes[setting.rule]
        # Where fewer frames were kept than are asked for, some come twice: as in evaluation.
        places = sample_evaluation(len(chosen.kept), setting.count)
        once = sorted(set(places))
        pictures = subtract(np.stack([chosen.kept[p].image for p in once]), chosen.reference)
        rows, described = timed(partial(features, pictures, weights))
        clips.append(rows[[once.index(p) for p in places]])
        costs.append(spent + described)
        counts.append(len(once))
    return Sample(file.object_id, tuple(clips), tuple(counts), tuple(costs))
