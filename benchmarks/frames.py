"""Frames: what each rule for choosing them, and their number, cost a video and make a predictor get wrong.

Errors are those of heads on a frozen EfficientNet-lite0; costs are the pass that selects, and the features of what it
selects.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import get_args

import numpy as np

from benchmarks.classifier import features, heads_error, weights
from benchmarks.table import WRONG, Row, machine, make_rows, timed
from pipeline.config import FramesConfig, Selection
from pipeline.config.params import load_params
from pipeline.core.errors import UserError
from pipeline.core.parallel import run_parallel
from pipeline.training.sampling import sample_evaluation
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.files import VideoFile, list_videos
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.subtraction import subtract

FRACTION, PIXELS = 0.3, 224
BASELINE = "salient, 5 frames"


def bench_videos(root: Path, folds: int) -> tuple[Path, Catalogue]:
    """The videos to measure with: the folder that OCTOPI_DATA_DIR names, else the chain's own.

    Raises:
        UserError: where there are no videos, or too few objects for folds.
    """
    data = load_params(root / "params.yaml").data
    folder, catalogue = (
        Path(os.environ.get("OCTOPI_DATA_DIR") or root / data.dir),
        load_catalogue(root / data.catalogue),
    )
    if len({f.object_id for f in list_videos(folder, catalogue).files}) < 2 * folds:
        raise UserError(f"{folder}: this section needs videos of {2 * folds} objects or more")
    return folder, catalogue


SETTINGS: dict[str, tuple[Selection, int]] = {
    f"{rule}, {count} frame{'s' * (count > 1)}": (rule, count)
    for rule in get_args(Selection)
    for count in (1, 3, 5, 10)
}
"""Rules, and how many of the frames that they keep."""


@dataclass(frozen=True)
class Sample:
    """One video under every setting."""

    object_id: str
    features: tuple[np.ndarray, ...]
    """Frames x features."""
    frames: tuple[int, ...]
    costs: tuple[float, ...]
    """Milliseconds of the pass that selects and of the chosen frames' features."""


def measure(root: Path, folds: int = 5, deals: int = 10) -> list[Row]:
    """Every setting on the same videos by the same folds; frames are drawn as for evaluation.

    With three deals of the folds in place of ten, a setting moves by a point or two.
    """
    videos, catalogue = bench_videos(root, folds)
    files = list_videos(videos, catalogue).files
    with weights() as folder:
        found = run_parallel(partial(_sample, folder), files, "frame selection", "video")
        samples = [s for s in found if s is not None]
    objects = [s.object_id for s in samples]
    costs, errors, counts = {}, {}, {}
    for place, setting in enumerate(SETTINGS):
        clips = np.stack([s.features[place] for s in samples])
        errors[setting] = heads_error(clips, clips, objects, catalogue, folds, deals)
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
        config = FramesConfig(selection=rule, fraction=FRACTION, pixels=PIXELS)
        found, spent = timed(partial(scan, file, config))
        if not isinstance(found, Scan) or not found.kept:
            return None
        passes[rule] = found, spent
    costs, clips, counts = [], [], []
    for rule, count in SETTINGS.values():
        chosen, spent = passes[rule]
        # Where fewer frames were kept than are asked for, some come twice: as in evaluation.
        places = sample_evaluation(len(chosen.kept), count)
        once = sorted(set(places))
        pictures = subtract(np.stack([chosen.kept[p].image for p in once]), chosen.reference)
        rows, described = timed(partial(features, pictures, weights))
        clips.append(rows[[once.index(p) for p in places]])
        costs.append(spent + described)
        counts.append(len(once))
    return Sample(file.object_id, tuple(clips), tuple(counts), tuple(costs))
