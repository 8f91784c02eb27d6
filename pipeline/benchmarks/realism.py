"""How like the real videos the synthetic ones are: distances of their features, transfer of what is learnt, a picture.

Scenes stand in for videos of the objects that they are made for. So the objects are cut into random halves, and the
real videos of one half are compared with the scenes of the other; the real videos of the other give the scale. Perfect
scenes would have ratio 1. Transfer is in `pipeline.benchmarks.transfer`.

Parameters of scenes were fitted to training objects of the development split only (`pipeline.scenes`), so distances to
all objects are a little kinder than those to objects never looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from pipeline.io import atomic
from pipeline.encoder.baseline.features import HEIGHT, VIDEO_FEATURE_NAMES, WIDTH, Vector, video_features
from pipeline.encoder.baseline.recordings import mean_reference
from pipeline.encoder.baseline.validation import deal
from pipeline.benchmarks import DATA_VARIABLE, BenchRow, bench_videos
from pipeline.benchmarks.distance import frechet, mean_differences, principal_axes, told_apart, wasserstein
from pipeline.benchmarks.transfer import Kind, transfer
from pipeline.params import load_params
from pipeline.videos.decoding import Image, decode
from pipeline.errors import UserError
from pipeline.sampling import sample_evaluation
from pipeline.videos.frames.scan import Scan, scan
from pipeline.parallel import run_parallel
from pipeline.videos.catalogue import Catalogue
from pipeline.runtime import derive_seed
from pipeline.scenes.recipe import Recipe, load_recipes
from pipeline.scenes.video import synthesize
from pipeline.config import FramesConfig, ScenesConfig
from pipeline.videos.files import VideoFile, list_videos

FRAMES = 5
FEWEST = 10
"""Objects: each half of them is dealt into five folds."""
SPLITS, REPEATS = 5, 3
"""How often objects are halved for distances, and dealt into folds for transfer."""
SEED = 0
REFERENCE = "real halves"
SHOWN, SMALL, AMPLIFIED = 12, (160, 120), 4
"""The picture: objects, size of a frame, and by how much differences are amplified."""
PICTURE = Path("runs") / "realism.png"
"""Ignored by git, since it shows frames whose publishers state no licence."""


@dataclass(frozen=True)
class Look:
    """What is kept of one video."""

    object_id: str
    features: Vector
    frame: Image
    """The frame that differs most from the reference, small."""
    change: Image
    """Its difference to the reference, absolute and amplified."""


def measure(root: Path) -> Sequence[BenchRow]:
    """Compare the videos of `bench_videos` with scenes of the same objects; draws `PICTURE`.

    Raises:
        UserError: where there are no real videos, or of too few objects.
    """
    folder, catalogue = bench_videos(root)
    objects = sorted({f.object_id for f in list_videos(folder, catalogue).files})
    if len(objects) < FEWEST:
        raise UserError(f"{folder}: bench realism needs real videos of {FEWEST} objects or more; set {DATA_VARIABLE}")
    with TemporaryDirectory() as made:
        synthesize(_recipes(root, catalogue), scenes_config(objects), Path(made))
        seen = looks(folder, catalogue), looks(Path(made), catalogue)
    draw(*seen, root / PICTURE)
    real, scenes = (kind_of(s, catalogue) for s in seen)
    classes = [len(p.levels) for p in catalogue.properties]
    names = [p.name for p in catalogue.properties]
    kinds = {"real": real, "scenes": scenes}
    return [*distances(real, scenes, SPLITS), *transfer(kinds, classes, names, REPEATS)]


def _recipes(root: Path, catalogue: Catalogue) -> dict[str, Recipe]:
    """What the chain makes its scenes from."""
    return load_recipes(root / load_params(root / "params.yaml").data.catalogue, catalogue, SEED)


def scenes_config(objects: Sequence[str]) -> ScenesConfig:
    """Scenes as long, as many and as large as the real videos."""
    return ScenesConfig(
        objects=tuple(objects), videos_per_object=5, frames="recorded", width=WIDTH, height=HEIGHT, seed=SEED
    )


def looks(folder: Path, catalogue: Catalogue) -> list[Look]:
    """Look at every video of a folder; those that cannot be read are left out."""
    files = list_videos(folder, catalogue).files
    return [look for look in run_parallel(_look, files, "realism", "video") if look is not None]


def kind_of(videos: Sequence[Look], catalogue: Catalogue) -> Kind:
    """The features and labels of many."""
    objects = tuple(v.object_id for v in videos)
    return Kind(np.stack([v.features for v in videos]), objects, np.array([catalogue.labels(o) for o in objects]))


def distances(real: Kind, scenes: Kind, splits: int) -> list[BenchRow]:
    """Each feature group's and the overall distances: medians and quartiles over features, or over halvings.

    `ratio` is to the distance between the real videos of both halves.
    """
    deviation = real.features.std(axis=0, dtype=np.float64)
    used = np.flatnonzero(deviation > 1e-6)
    scale, groups = deviation[used], np.array([VIDEO_FEATURE_NAMES[i].split(".")[0] for i in used])
    real, scenes = (replace(kind, features=kind.features[:, used]) for kind in (real, scenes))
    axes = principal_axes(real.features, scale)
    halves = [deal(real.objects, 2, derive_seed(0, "halves", split)) for split in range(splits)]
    # The real videos of one half, and of the other half its scenes and its real videos.
    trios = [(real.take(real.of(a)), scenes.take(scenes.of(b)), real.take(real.of(b))) for a, b in halves]
    rows = []
    for name, compare in (("mean difference", mean_differences), ("Wasserstein", wasserstein)):
        found = np.mean([compare(here.features, made.features, scale) for here, made, _ in trios], axis=0)
        usual = np.mean([compare(here.features, there.features, scale) for here, _, there in trios], axis=0)
        rows.append(_row(f"{name}, all", "deviations", found, usual))
        for group in dict.fromkeys(groups.tolist()):
            rows.append(_row(f"{name}, {group}", "deviations", found[groups == group], usual[groups == group]))
    gaps = [[frechet(here.features, o.features, axes) for o in others] for here, *others in trios]
    told = [
        [told_apart(here.features, o.features, (here.objects, o.objects), seed) for o in others]
        for seed, (here, *others) in enumerate(trios)
    ]
    rows.append(_row("Frechet", "deviations", *np.transpose(gaps)))
    rows.append(_row("told apart", "share", *np.transpose(told)))
    return rows


def _row(case: str, unit: str, found: np.ndarray, usual: np.ndarray) -> BenchRow:
    low, middle, high = np.quantile(found, (0.25, 0.5, 0.75))
    return BenchRow(
        case=case,
        cost=round(float(middle), 4),
        unit=unit,
        baseline=REFERENCE,
        ratio=round(float(middle / max(np.median(usual), 1e-9)), 3),
        low=round(float(low), 4),
        high=round(float(high), 4),
    )


def draw(real: Sequence[Look], scenes: Sequence[Look], path: Path) -> None:
    """Objects in rows: frame and difference, of two real videos on the left and of two scenes on the right."""
    shared = sorted({v.object_id for v in real} & {v.object_id for v in scenes})
    chosen = [shared[i * len(shared) // SHOWN] for i in range(SHOWN)] if len(shared) > SHOWN else shared
    rows = []
    for object_id in chosen:
        pictures = []
        for videos in (real, scenes):
            own = [v for v in videos if v.object_id == object_id]
            pictures += [p for v in (own[0], own[-1]) for p in (v.frame, v.change)]
        row = np.hstack(pictures)
        cv2.putText(row, object_id, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(row)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", np.vstack(rows))[1].tobytes())


def _look(file: VideoFile) -> Look | None:
    """What the baseline predictor sees of a video; None where it cannot be read."""
    result = scan(file, FramesConfig(selection="uniform", size=64))
    if not isinstance(result, Scan):
        return None
    frames = list(decode(file.path))
    reference = mean_reference(frames, result.probe.starts_touching)
    shown = [frames[result.kept[p].index] for p in sample_evaluation(len(result.kept), FRAMES)]
    changes = [np.abs(frame - reference) for frame in shown]
    most = int(np.argmax([change.sum() for change in changes]))
    small = [cv2.resize(p, SMALL, interpolation=cv2.INTER_AREA) for p in (shown[most], changes[most])]
    change = cv2.convertScaleAbs(small[1], alpha=AMPLIFIED)
    return Look(file.object_id, video_features(shown, reference), small[0], change)
