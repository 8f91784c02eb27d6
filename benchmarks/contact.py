"""Models of contact: milliseconds a frame against errors in slopes, in pictures, in Hertz's ball and for a classifier.

On the catalogue's objects every model is held against the finest, an elastic layer with as many cells as pixels; the
solver alone against a ball on a half-space, whose answer is known (Johnson, Contact Mechanics, 4.2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from statistics import fmean, median

import numpy as np

from benchmarks.classifier import features, heads_error, weights
from benchmarks.errors import WRONG, Error, mean_of
from benchmarks.table import Row, make_rows
from benchmarks.timing import counting_ffts, interleaved, machine, timed
from pipeline.config import ScenesConfig
from pipeline.config.params import load_params
from pipeline.core.parallel import run_parallel
from pipeline.core.runtime import derive_seed
from pipeline.scenes.contact import GEL, slope_error
from pipeline.scenes.elastic.kernels import Kernel, half_space_table, make_kernel
from pipeline.scenes.elastic.solver import solve
from pipeline.scenes.elastic.winkler import press_springs
from pipeline.scenes.light import Image, make_sensor
from pipeline.scenes.recipe import Recipe, load_recipes
from pipeline.scenes.render import make_scene, render
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.frames.reference import reference_indices
from pipeline.videos.frames.subtraction import subtract

RADIUS, FORCES = 10.0, (0.8, 0.9, 1.0, 1.1, 1.2)
"""The ball, in mm, and forces in N on a body of 1 MPa: several, as one is as lucky as its circle fits the grid."""
CELLS = (32, 64, 128, 256)
WIDTH, HEIGHT, FRAMES, SHOWN = 160, 120, 40, 5
"""Of a rendered video, and how many of its frames the classifier looks at."""


def models() -> dict[str, ScenesConfig]:
    """What is compared on the catalogue's objects; the first is what the others are held against."""
    base = ScenesConfig(frames=FRAMES, width=WIDTH, height=HEIGHT)
    changes: dict[str, dict[str, object]] = {
        "layer, every pixel": {"tier": "layer", "cells": 1024},
        "winkler": {"tier": "winkler"},
        **{f"layer, {cells} cells": {"tier": "layer", "cells": cells} for cells in CELLS},
        "half_space, 128 cells": {"tier": "half_space", "cells": 128},
        **{f"auto, tolerance {t:g}": {"tier": "auto", "tolerance": t} for t in (0.1, 0.2, 0.4)},
    }
    return {name: base.model_copy(update=changed) for name, changed in changes.items()}


def measure(
    root: Path, objects: int | None = None, videos: int = 3, repeats: int = 5, folds: int = 5, deals: int = 3
) -> list[Row]:
    """All questions, on objects of the catalogue of params.yaml.

    Args:
        objects: How many, at equal distances in the catalogue; all by default.
        videos: Scenes an object.
        repeats: Of the ball's contacts.
        folds: Of the classifier's cross-validation.
        deals: How often they are dealt.
    """
    data = load_params(root / "params.yaml").data
    catalogue = load_catalogue(root / data.catalogue)
    recipes = load_recipes(root / data.catalogue, catalogue, 0)
    names = sorted(recipes)[:: -(-len(recipes) // objects) if objects else 1]
    with weights() as folder:
        jobs = [_Job(name, number, recipes[name], folder) for name in names for number in range(videos)]
        seen = list(run_parallel(_look, jobs, "models of contact", "scene"))
    return [*hertz(repeats), *_against_finest(seen), *_for_a_classifier(seen, catalogue, folds, deals)]


# --- Hertz


def hertz(repeats: int) -> list[Row]:
    """The error in the force at the approach found, mean over `FORCES` with its smallest and largest."""
    settings: dict[str, Callable[[float], float]] = {
        "springs, 256 cells": _springs,
        **{
            f"half-space, {cells} cells, tolerance {tolerance:.0e}": partial(_half_space, cells, tolerance)
            for cells in CELLS
            for tolerance in (1e-2, 1e-4)
        },
    }
    costs = interleaved(settings, FORCES, repeats)
    errors, counts = {}, {}
    for name, press in settings.items():
        with counting_ffts() as ffts:
            # Hertz's force goes as the approach to the power 3/2.
            off = [abs((press(force) / hertz_approach(force)) ** 1.5 - 1) for force in FORCES]
        errors[name] = Error(fmean(off), min(off), max(off), len(off))
        counts[name] = {"ffts": ffts.value / len(FORCES)}
    return make_rows(
        "contact, Hertz's ball",
        costs,
        unit="ms a contact",
        baseline="springs, 256 cells",
        errors=errors,
        error_of="relative error of the force, its smallest and largest over the forces",
        counts=counts,
        machine=machine("1 thread"),
    )


def hertz_approach(force: float) -> float:
    """In mm, of the rigid ball under a force in N: radius of contact squared over that of the ball."""
    return float((3 * force * RADIUS / 4) ** (2 / 3) / RADIUS)


@cache
def _ball(cells: int) -> tuple[np.ndarray, float, Kernel]:
    """The gap in mm, a cell's side, and how a half-space of modulus 1 MPa sinks."""
    pitch = 2.6 * (3 * RADIUS / 4) ** (1 / 3) / cells
    axis = (np.arange(cells, dtype=np.float32) - (cells - 1) / 2) * pitch
    gap = ((axis[None] ** 2 + axis[:, None] ** 2) / (2 * RADIUS)).astype(np.float32)
    return gap, pitch, make_kernel(half_space_table(gap.shape, pitch, 1.0), gap)


def _half_space(cells: int, tolerance: float, force: float) -> float:
    gap, pitch, kernel = _ball(cells)
    return float(solve(gap, force, kernel, pitch, tolerance=tolerance).approach[0])


def _springs(force: float) -> float:
    gap, pitch, _ = _ball(256)
    # By Hertz all goes with force over modulus.
    return float(press_springs(gap, force * GEL.modulus, 1e9, pitch, GEL).approach)


# --- The catalogue's objects


@dataclass(frozen=True)
class _Job:
    object_id: str
    number: int
    recipe: Recipe
    weights: Path


@dataclass(frozen=True)
class _Scene:
    """One scene by every model, in the order of `models`."""

    object_id: str
    costs: tuple[float, ...]
    """Milliseconds a frame, contact included."""
    ffts: tuple[float, ...]
    """A frame."""
    slopes: tuple[float, ...]
    pictures: tuple[float, ...]
    features: tuple[np.ndarray, ...]
    """Frames x features."""


def _look(job: _Job) -> _Scene:
    seed = derive_seed("bench", job.object_id, job.number)
    sensor = make_sensor(WIDTH, HEIGHT, job.number % 3)
    scenes, frames, costs, ffts = [], [], [], []
    for config in models().values():
        # What all models share is in the caches for all of them.
        make_scene(job.recipe, config.model_copy(update={"tier": "winkler"}), FRAMES, seed)

        def make(config: ScenesConfig = config) -> None:
            scenes.append(make_scene(job.recipe, config, FRAMES, seed))
            frames.append(list(render(scenes[-1], config, sensor, seed)))

        with counting_ffts() as count:
            costs.append(timed(make)[1] / FRAMES)
        ffts.append(count.value / FRAMES)
    hardest = int(np.argmax(scenes[0].motion.force))
    finest, truth = scenes[0].imprint.skins[-1], frames[0][hardest].astype(np.float32)
    return _Scene(
        object_id=job.object_id,
        costs=tuple(costs),
        ffts=tuple(ffts),
        slopes=tuple(slope_error(s.imprint.skins[-1], finest, s.pitch) for s in scenes),
        # Noise is drawn from the seed alone, so that pictures of two models share it.
        pictures=tuple(float(np.sqrt(np.mean((f[hardest] - truth) ** 2))) for f in frames),
        features=tuple(_features(f, job.weights) for f in frames),
    )


def _features(frames: Sequence[Image], weights: Path) -> np.ndarray:
    reference = np.mean(np.stack([frames[i] for i in reference_indices(len(frames))]), axis=0).round().astype(np.uint8)
    chosen = np.linspace(0, len(frames) - 1, SHOWN + 2).round().astype(int)[1:-1]
    return features(subtract(np.stack([frames[i] for i in chosen]), reference), weights)


def _question(
    question: str, seen: Sequence[_Scene], baseline: str, errors: Sequence[Error], error_of: str
) -> list[Row]:
    names = list(models())
    return make_rows(
        question,
        {name: [s.costs[i] for s in seen] for i, name in enumerate(names)},
        unit="ms a frame",
        baseline=baseline,
        errors=dict(zip(names, errors, strict=True)),
        error_of=error_of,
        counts={name: {"ffts": median(s.ffts[i] for s in seen)} for i, name in enumerate(names)},
        machine=machine("1 thread a scene"),
    )


def _against_finest(seen: Sequence[_Scene]) -> list[Row]:
    places, owners = range(len(models())), [s.object_id for s in seen]
    pictures = [mean_of([s.pictures[i] for s in seen], owners) for i in places]
    slopes = [mean_of([s.slopes[i] for s in seen], owners) for i in places]
    steps = "root mean square error of a frame in contact, 8-bit steps"
    return [
        *_question("contact", seen, "winkler", pictures, steps),
        *_question("contact, slopes", seen, "winkler", slopes, "relative error of the slopes of the gel's skin"),
    ]


def _for_a_classifier(seen: Sequence[_Scene], catalogue: Catalogue, folds: int, deals: int) -> list[Row]:
    """Heads on frozen features learn from the scenes of each model and are tested on those of the finest."""
    objects = [s.object_id for s in seen]
    labels = np.array([catalogue.labels(o) for o in objects])
    classes = [len(p.levels) for p in catalogue.properties]
    clips = [np.stack([s.features[i] for s in seen]) for i in range(len(models()))]
    errors = [heads_error(learnt, clips[0], labels, objects, classes, folds, deals) for learnt in clips]
    return _question("contact, for a classifier", seen, "layer, every pixel", errors, WRONG)
