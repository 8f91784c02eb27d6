"""What scenes cost, and what each way of computing a contact gets wrong.

Three questions: how near the solver comes to Hertz's ball, whose answer is known; how near each way comes to the
finest in the slopes and pictures of the catalogue's objects; and whether a classifier notices: one trained on the
videos of each way, tested on those of the finest, on objects that it has not seen. Last, a data set as large as the
public one is written and timed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median, stdev
from tempfile import TemporaryDirectory

import numpy as np

from pipeline.encoder.baseline.features import video_features
from pipeline.benchmarks import BenchRow
from pipeline.benchmarks.pareto import draw_rows
from pipeline.benchmarks.transfer import Kind, transfer
from pipeline.params import load_params
from pipeline.videos.frames.reference import reference_indices
from pipeline.parallel import run_parallel
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.runtime import derive_seed
from pipeline.scenes.contact import GEL, slope_error
from pipeline.scenes.elastic.kernels import half_space_table, make_kernel
from pipeline.scenes.elastic.solver import solve
from pipeline.scenes.elastic.winkler import press_springs
from pipeline.scenes.light import Image, make_sensor
from pipeline.scenes.recipe import Recipe, load_recipes
from pipeline.scenes.render import Scene, make_scene, render
from pipeline.scenes.video import synthesize
from pipeline.config import ScenesConfig

RADIUS, FORCES = 10.0, (0.8, 0.9, 1.0, 1.1, 1.2)
"""The ball, in mm, and forces in N on a body of 1 MPa: several, as one is as lucky as its circle fits the grid."""
CELLS, TOLERANCES = (32, 64, 128, 256), (1e-2, 1e-4, 1e-6)
SIZE = (160, 120)
FRAMES, SHOWN, VIDEOS = 40, 5, 3
"""Of a rendered video, of these looked at by the classifier, and videos an object."""
PICTURES = ("reports/bench/scenes.png", "reports/bench/scenes_labels.png")
PUBLIC_VIDEOS = 408


class SceneRow(BenchRow):
    """One way; `error` is what its group is judged by."""

    radius: float | None = None
    """Relative error of the contact's radius."""
    pressure: float | None = None
    """Relative error of the peak pressure."""
    image: float | None = None
    """Root mean square error of a frame in contact, in 8-bit steps: the mean over scenes."""
    image_low: float | None = None
    """Ends of its 95 % interval, Student's t over the objects' means."""
    image_high: float | None = None
    bytes: int | None = None


def ways() -> dict[str, ScenesConfig]:
    """What is compared on the catalogue's objects; the first is what the others are held against."""
    base = ScenesConfig(frames=FRAMES, width=SIZE[0], height=SIZE[1], videos_per_object=VIDEOS)

    def vary(**changes: object) -> ScenesConfig:
        return base.model_copy(update=changes)

    return {
        # As many cells as pixels.
        "layer, every pixel": vary(tier="layer", cells=1024),
        "winkler": vary(tier="winkler"),
        **{f"layer, {cells} cells": vary(tier="layer", cells=cells) for cells in CELLS},
        "half_space, 128 cells": vary(tier="half_space", cells=128),
        **{f"auto, tolerance {t:g}": vary(tier="auto", tolerance=t) for t in (0.1, 0.2, 0.4)},
    }


def measure(root: Path) -> Sequence[BenchRow]:
    """All three comparisons on the catalogue of `params.yaml`, and the large data set; draws two Pareto plots."""
    data = load_params(root / "params.yaml").data
    catalogue = load_catalogue(root / data.catalogue)
    recipes = load_recipes(root / data.catalogue, catalogue, 0)
    pictures, labels = look_at(recipes, catalogue)
    slopes = "relative error in slopes, quartiles over objects"
    draw_rows(pictures, root / PICTURES[0], f"Ways to compute a contact: {len(recipes)} objects", slopes)
    wrong = "not all properties right, object-clustered 95 % interval"
    draw_rows(labels, root / PICTURES[1], "What a classifier learns from each way, tested on the finest", wrong)
    return [*ball_rows(), *pictures, *labels, *write_rows(recipes)]


# --- Hertz


def ball_rows(repeats: int = 5) -> list[SceneRow]:
    """Errors in force, radius and peak pressure, with their largest and smallest over the forces."""
    rows = [_springs_row()]
    for cells in CELLS:
        for dtype in (np.float32, np.float64):
            for tolerance in TOLERANCES:
                # What float32 can carry ends at about 1e-6.
                rows.append(_ball_row(cells, max(tolerance, 2e-6 if dtype is np.float32 else 0), dtype, repeats))
    return rows


def _hertz(force: float) -> tuple[float, float, float]:
    """Radius, approach and peak pressure (Johnson, Contact Mechanics, 4.2)."""
    radius = (3 * force * RADIUS / 4) ** (1 / 3)
    return radius, radius**2 / RADIUS, 3 * force / (2 * np.pi * radius**2)


def _ball_gap(cells: int) -> tuple[np.ndarray, float]:
    pitch = 2.6 * _hertz(1.0)[0] / cells
    axis = (np.arange(cells) - (cells - 1) / 2) * pitch
    return (axis[None] ** 2 + axis[:, None] ** 2) / (2 * RADIUS), pitch


def _ball_row(cells: int, tolerance: float, dtype: type, repeats: int) -> SceneRow:
    gap, pitch = _ball_gap(cells)
    gap = gap.astype(dtype)
    kernel = make_kernel(half_space_table(gap.shape, pitch, 1.0), gap)
    found, seconds = [], []
    for force in FORCES:
        for _ in range(repeats):
            started = time.perf_counter()
            solution = solve(gap, force, kernel, pitch, tolerance=tolerance)
            seconds.append(time.perf_counter() - started)
        found.append((force, float(solution.approach[0]), solution.pressure[0]))
    name = f"ball, half_space {cells} cells {tolerance:.0e} {np.dtype(dtype).name}"
    return _judge_ball(name, found, pitch, 1000 * median(seconds))


def _springs_row() -> SceneRow:
    gap, pitch = _ball_gap(256)
    found, seconds = [], []
    for force in FORCES:
        started = time.perf_counter()
        # A rigid ball on the gel; by Hertz all goes with force over modulus.
        springs = press_springs(gap.astype(np.float32), force * GEL.modulus, 1e9, pitch, GEL)
        seconds.append(time.perf_counter() - started)
        found.append((force, springs.approach, springs.overlap / GEL.thickness))
    return _judge_ball("ball, winkler", found, pitch, 1000 * median(seconds))


def _judge_ball(
    case: str, found: Sequence[tuple[float, float, np.ndarray]], pitch: float, milliseconds: float
) -> SceneRow:
    off = []
    for force, approach, pressure in found:
        radius, depth, peak = _hertz(force)
        area = np.count_nonzero(pressure) * pitch**2
        # Hertz's force at the approach found, which goes as its power 3/2.
        off.append(
            (
                abs((approach / depth) ** 1.5 - 1),
                abs(np.sqrt(area / np.pi) / radius - 1),
                abs(float(pressure.max()) / peak - 1),
            )
        )
    force_errors = [o[0] for o in off]
    return SceneRow(
        case=case,
        cost=round(milliseconds, 3),
        unit="ms a contact",
        baseline=case,
        ratio=1.0,
        error=float(f"{fmean(force_errors):.3g}"),
        low=float(f"{min(force_errors):.3g}"),
        high=float(f"{max(force_errors):.3g}"),
        radius=float(f"{fmean(o[1] for o in off):.3g}"),
        pressure=float(f"{fmean(o[2] for o in off):.3g}"),
    )


# --- The catalogue's objects


@dataclass(frozen=True)
class _Job:
    object_id: str
    number: int
    recipe: Recipe


@dataclass(frozen=True)
class _Seen:
    """One scene by every way, in the order of `ways`."""

    object_id: str
    milliseconds: tuple[float, ...]
    """A frame, contact included."""
    slopes: tuple[float, ...]
    images: tuple[float, ...]
    features: tuple[np.ndarray, ...]


def look_at(recipes: dict[str, Recipe], catalogue: Catalogue) -> tuple[list[SceneRow], list[SceneRow]]:
    """Slopes and pictures of every way against the finest; then what a classifier makes of their videos."""
    jobs = [_Job(o, n, recipes[o]) for o in sorted(recipes) for n in range(VIDEOS)]
    seen = list(run_parallel(_look, jobs, "ways to compute a contact", "scene"))
    names = list(ways())
    costs = [median(s.milliseconds[place] for s in seen) for place in range(len(names))]
    baseline = names.index("winkler")
    pictures = []
    for place, name in enumerate(names):
        low, middle, high = np.quantile([s.slopes[place] for s in seen], (0.25, 0.5, 0.75))
        image_low, image_high = over_objects([(s.object_id, s.images[place]) for s in seen])
        pictures.append(
            SceneRow(
                case=name,
                cost=round(costs[place], 3),
                unit="ms a frame",
                baseline=names[baseline],
                ratio=round(costs[place] / costs[baseline], 3),
                error=round(float(middle), 4),
                low=round(float(low), 4),
                high=round(float(high), 4),
                image=round(fmean(s.images[place] for s in seen), 3),
                image_low=image_low,
                image_high=image_high,
            )
        )
    return pictures, _label_rows(seen, names, costs, catalogue)


def over_objects(errors: Sequence[tuple[str, float]]) -> tuple[float | None, float | None]:
    """Ends of the 95 % interval of a mean error, not below 0, as many scenes an object; None for a single object."""
    from scipy.stats import t

    owners = sorted({owner for owner, _ in errors})
    means = [fmean(error for owner, error in errors if owner == own) for own in owners]
    if len(means) < 2:
        return None, None
    half = float(t.ppf(0.975, len(means) - 1)) * stdev(means) / len(means) ** 0.5
    return round(max(fmean(means) - half, 0.0), 3), round(fmean(means) + half, 3)


def _label_rows(
    seen: Sequence[_Seen], names: Sequence[str], costs: Sequence[float], catalogue: Catalogue
) -> list[SceneRow]:
    objects = tuple(s.object_id for s in seen)
    labels = np.array([catalogue.labels(o) for o in objects])
    kinds = {name: Kind(np.stack([s.features[i] for s in seen]), objects, labels) for i, name in enumerate(names)}
    classes = [len(p.levels) for p in catalogue.properties]
    found = {row.case: row for row in transfer(kinds, classes, catalogue.property_names)}
    rows = []
    for name, cost in zip(names, costs, strict=True):
        row = found[f"all properties, {name} to {names[0]}"]
        rows.append(
            SceneRow(
                case=f"labels, {name}",
                cost=round(cost, 3),
                unit="ms a frame",
                baseline=f"labels, {names[0]}",
                ratio=round(cost / costs[0], 3),
                error=row.error,
                low=row.low,
                high=row.high,
            )
        )
    return rows


def _look(job: _Job) -> _Seen:
    seed = derive_seed("bench", job.object_id, job.number)
    sensor = make_sensor(*SIZE, job.number % 3)
    costs, frames, scenes = [], [], []
    for config in ways().values():
        make_scene(job.recipe, config.model_copy(update={"tier": "winkler"}), FRAMES, seed)  # Caches are warm for all.
        started = time.perf_counter()
        scene = make_scene(job.recipe, config, FRAMES, seed)
        frames.append(list(render(scene, config, sensor, seed)))
        costs.append(1000 * (time.perf_counter() - started) / FRAMES)
        scenes.append(scene)
    hardest = int(np.argmax(scenes[0].motion.force))
    truth = frames[0][hardest].astype(np.float32)
    return _Seen(
        object_id=job.object_id,
        milliseconds=tuple(costs),
        slopes=tuple(slope_error(_last(s), _last(scenes[0]), s.pitch) for s in scenes),
        # Noise is drawn from the seed alone, so that pictures of two ways share it.
        images=tuple(float(np.sqrt(np.mean((f[hardest] - truth) ** 2))) for f in frames),
        features=tuple(_features(f) for f in frames),
    )


def _last(scene: Scene) -> np.ndarray:
    return np.asarray(scene.imprint.skins[-1])


def _features(frames: Sequence[Image]) -> np.ndarray:
    reference = np.mean(np.stack([frames[i] for i in reference_indices(len(frames))]).astype(np.float32), axis=0)
    chosen = np.linspace(0, len(frames) - 1, SHOWN + 2).round().astype(int)[1:-1]
    return video_features([frames[i] for i in chosen], reference)


# --- As many as were published


def write_rows(recipes: dict[str, Recipe]) -> list[SceneRow]:
    """Time and bytes of a data set as large as the public one, at its size and lengths, and of the smoke scale's."""
    objects = tuple(sorted(recipes))
    each, more = divmod(PUBLIC_VIDEOS, len(objects))
    whole = ScenesConfig(objects=objects, videos_per_object=each, frames="recorded")
    parts = [whole]
    if more:
        parts.append(whole.model_copy(update={"objects": objects[:more], "videos_per_object": 1, "seed": 1}))
    case = f"write {PUBLIC_VIDEOS} videos"
    with TemporaryDirectory() as folder:
        started = time.perf_counter()
        made = [row for i, part in enumerate(parts) for row in synthesize(recipes, part, Path(folder) / str(i))]
        seconds = time.perf_counter() - started
        size = sum(p.stat().st_size for p in Path(folder).rglob("*.mp4"))
    assert len(made) == PUBLIC_VIDEOS
    return [
        SceneRow(
            case=f"{case}, {sum(row.frames for row in made)} frames",
            cost=round(seconds, 1),
            unit="s",
            baseline=f"{case}, {sum(row.frames for row in made)} frames",
            ratio=1.0,
            low=round(seconds, 1),
            high=round(seconds, 1),
            bytes=size,
        )
    ]
