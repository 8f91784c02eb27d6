"""Frames: what their number costs a video and makes a predictor get wrong.

Errors are those of heads on a frozen EfficientNet-lite0; costs are the pass that selects, and the features of what it
selects.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.classifier import features, heads_error, weights
from benchmarks.table import WRONG, Row, machine, make_rows, timed
from pipeline.config import FramesConfig
from pipeline.config.params import load_params
from pipeline.running.errors import UserError
from pipeline.running.parallel import run_parallel
from pipeline.training.sampling import sample_evaluation
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.files import VideoFile, list_videos
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.subtraction import subtract

COUNTS = (1, 3, 5, 10)
"""Of the frames that are kept, how many are shown."""
BASELINE = "salient, 5 frames"


def bench_videos(root: Path, folds: int) -> tuple[Path, Catalogue]:
    """The videos to measure with: the folder that OCTOPI_DATA_DIR names, else the chain's own.

    Raises:
        UserError: where there are no videos, or too few objects for folds.
    """
    data = load_params(root / "params.yaml").data
    folder = Path(os.environ.get("OCTOPI_DATA_DIR") or root / data.dir)
    catalogue = load_catalogue(root / data.catalogue)
    if len({f.object_id for f in list_videos(folder, catalogue).files}) < 2 * folds:
        raise UserError(f"{folder}: this section needs videos of {2 * folds} objects or more")
    return folder, catalogue


def measure(root: Path, folds: int = 5, deals: int = 10) -> list[Row]:
    """Every number on the same videos by the same folds; frames are drawn as for evaluation.

    With three deals of the folds in place of ten, a setting moves by a point or two.
    """
    videos, catalogue = bench_videos(root, folds)
    files = list_videos(videos, catalogue).files
    with weights() as folder:
        found = list(run_parallel(partial(_shown, folder), files, "frame selection", "video"))
    objects = [file.object_id for file, shown in zip(files, found, strict=True) if shown]
    costs, errors, counts = {}, {}, {}
    for place, count in enumerate(COUNTS):
        setting = f"salient, {count} frame{'s' * (count > 1)}"
        clips, costs[setting] = zip(*(shown[place] for shown in found if shown), strict=True)
        errors[setting] = heads_error(np.stack(clips), objects, catalogue, folds, deals)
        counts[setting] = {"frames": float(count)}
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


def _shown(weights: Path, file: VideoFile) -> list[tuple[np.ndarray, float]]:
    """For each of `COUNTS`: features, frames x dim, and milliseconds of selecting and of these; empty if unreadable."""
    found, spent = timed(partial(scan, file, FramesConfig()))
    if not isinstance(found, Scan) or not found.kept:
        return []
    shown = []
    for count in COUNTS:
        # Where fewer frames were kept than are asked for, some come twice: as in evaluation.
        places = sample_evaluation(len(found.kept), count)
        once = sorted(set(places))
        pictures = subtract(np.stack([found.kept[p].image for p in once]), found.reference)
        rows, described = timed(partial(features, pictures, weights))
        shown.append((rows[[once.index(p) for p in places]], spent + described))
    return shown
