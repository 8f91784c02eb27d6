"""Models of contact: milliseconds a frame against errors in pictures and for a classifier.

Every model is held against the finest, an elastic layer with as many cells as pixels, on scenes of the catalogue's
objects.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.classifier import features, heads_error, weights
from benchmarks.table import WRONG, Row, machine, make_rows, mean_of, timed
from pipeline.config import ScenesConfig
from pipeline.config.params import load_params
from pipeline.core.parallel import run_parallel
from pipeline.core.runtime import derive_seed
from pipeline.scenes.light import Image, make_sensor
from pipeline.scenes.recipe import Recipe, load_recipes
from pipeline.scenes.render import make_scene, render
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.frames.reference import reference_indices
from pipeline.videos.frames.subtraction import subtract

CELLS = (32, 64, 128, 256)
WIDTH, HEIGHT, FRAMES, SHOWN = 160, 120, 40, 5
"""Size and frames of a rendered video, and how many of its frames the classifier is shown."""


def models() -> dict[str, ScenesConfig]:
    """What is compared; the first is what the others are held against."""
    base = ScenesConfig(frames=FRAMES, width=WIDTH, height=HEIGHT)
    changes: dict[str, dict[str, object]] = {
        "layer, every pixel": {"tier": "layer", "cells": 1024},
        "winkler": {"tier": "winkler"},
        **{f"layer, {cells} cells": {"tier": "layer", "cells": cells} for cells in CELLS},
        "half_space, 128 cells": {"tier": "half_space", "cells": 128},
        **{f"auto, tolerance {t:g}": {"tier": "auto", "tolerance": t} for t in (0.1, 0.2, 0.4)},
    }
    return {name: base.model_copy(update=changed) for name, changed in changes.items()}


def measure(root: Path, objects: int | None = None, videos: int = 3, folds: int = 5, deals: int = 3) -> list[Row]:
    """Both questions, on scenes of `objects` objects, evenly spaced in the catalogue of params.yaml; None takes all."""
    data = load_params(root / "params.yaml").data
    catalogue = load_catalogue(root / data.catalogue)
    recipes = load_recipes(root / data.catalogue, catalogue, 0)
    names = sorted(recipes)[:: -(-len(recipes) // objects) if objects else 1]
    jobs = [_Job(name, number, recipes[name]) for name in names for number in range(videos)]
    with weights() as folder:
        seen = list(run_parallel(partial(_look, folder), jobs, "models of contact", "scene"))
    owners = [job.object_id for job in jobs]
    pictures = [mean_of([scene.pictures[i] for scene in seen], owners) for i in range(len(models()))]
    # Heads learn from the scenes of each model and are tested on those of the finest.
    clips = [np.stack([scene.features[i] for scene in seen]) for i in range(len(models()))]
    wrong = [heads_error(learnt, clips[0], owners, catalogue, folds, deals) for learnt in clips]
    steps = "root mean square error of a frame in contact, 8-bit steps"
    costs = {name: [scene.costs[i] for scene in seen] for i, name in enumerate(models())}
    rows: list[Row] = []
    for question, baseline, found, error_of in (
        ("contact", "winkler", pictures, steps),
        ("contact, for a classifier", "layer, every pixel", wrong, WRONG),
    ):
        rows += make_rows(
            question,
            costs,
            unit="ms a frame",
            baseline=baseline,
            errors=dict(zip(costs, found, strict=True)),
            error_of=error_of,
            machine=machine("1 thread a scene"),
        )
    return rows


@dataclass(frozen=True)
class _Job:
    object_id: str
    number: int
    recipe: Recipe


@dataclass(frozen=True)
class _Scene:
    """One scene by every model, in the order of `models`."""

    costs: tuple[float, ...]
    """Milliseconds a frame, contact included."""
    pictures: tuple[float, ...]
    """Distance to the finest in the frame of most force, in 8-bit steps."""
    features: tuple[np.ndarray, ...]
    """Frames x features."""


def _look(weights: Path, job: _Job) -> _Scene:
    seed = derive_seed("bench", job.object_id, job.number)
    sensor = make_sensor(WIDTH, HEIGHT, job.number % 3)
    # Springs first, untimed, to fill the caches with what all models share.
    springs = ScenesConfig(frames=FRAMES, width=WIDTH, height=HEIGHT, tier="winkler")
    hardest = int(np.argmax(make_scene(job.recipe, springs, FRAMES, seed).motion.force))

    def film(config: ScenesConfig) -> list[Image]:
        return list(render(make_scene(job.recipe, config, FRAMES, seed), config, sensor, seed))

    films, costs = [], []
    for config in models().values():
        frames, spent = timed(partial(film, config))
        films.append(frames)
        costs.append(spent / FRAMES)
    # Noise is drawn from the seed alone, so that pictures of two models share it.
    truth = films[0][hardest].astype(np.float32)
    pictures = [float(np.sqrt(np.mean((frames[hardest] - truth) ** 2))) for frames in films]
    chosen, described = np.linspace(0, FRAMES - 1, SHOWN + 2).round().astype(int)[1:-1], []
    for frames in films:
        reference = np.mean([frames[i] for i in reference_indices(FRAMES)], axis=0).round().astype(np.uint8)
        described.append(features(subtract(np.stack([frames[i] for i in chosen]), reference), weights))
    return _Scene(tuple(costs), tuple(pictures), tuple(described))
