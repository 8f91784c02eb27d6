"""Models of contact: milliseconds a frame against errors in pictures.

Every model is held against the finest, an elastic layer with as many cells as pixels, on scenes of the catalogue's
objects.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.table import Row, machine, make_rows, mean_of, timed
from pipeline.config import ScenesConfig
from pipeline.config.params import load_params
from pipeline.core.runtime import derive_seed
from pipeline.running.parallel import run_parallel
from pipeline.scenes.light import Image, make_sensor
from pipeline.scenes.recipe import SceneRecipe, load_recipes
from pipeline.scenes.render import make_scene, render
from pipeline.videos.catalogue import load_catalogue

CELLS = (32, 64, 128, 256)
WIDTH, HEIGHT, FRAMES = 160, 120, 40
"""Size and frames of a rendered video."""


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


def measure(root: Path, objects: int | None = None, videos: int = 3) -> list[Row]:
    """Every model on scenes of `objects` objects, evenly spaced in the catalogue of params.yaml; None takes all."""
    data = load_params(root / "params.yaml").data
    catalogue = load_catalogue(root / data.catalogue)
    recipes = load_recipes(root / data.catalogue, catalogue, 0)
    names = sorted(recipes)[:: -(-len(recipes) // objects) if objects else 1]
    jobs = [(name, number, recipes[name]) for name in names for number in range(videos)]
    seen = list(run_parallel(_look, jobs, "models of contact", "scene"))
    costs, errors = {}, {}
    for name, found in zip(models(), zip(*seen, strict=True), strict=True):
        costs[name], apart = zip(*found, strict=True)
        errors[name] = mean_of(apart, [owner for owner, *_ in jobs])
    return make_rows(
        "contact",
        costs,
        unit="ms a frame",
        baseline="winkler",
        errors=errors,
        error_of="root mean square error of a frame in contact, 8-bit steps",
        machine=machine("1 thread a scene"),
    )


def _look(job: tuple[str, int, SceneRecipe]) -> list[tuple[float, float]]:
    """One scene by every model: milliseconds a frame, contact included, and in the frame of most force the distance to
    the finest model, in 8-bit steps.
    """
    name, number, recipe = job
    seed, sensor = derive_seed("bench", name, number), make_sensor(WIDTH, HEIGHT, number % 3)
    # Springs first, untimed, to fill the caches with what all models share.
    hardest = int(np.argmax(make_scene(recipe, models()["winkler"], FRAMES, seed).motion.force))

    def film(config: ScenesConfig) -> list[Image]:
        return list(render(make_scene(recipe, config, FRAMES, seed), config, sensor, seed))

    films = [timed(partial(film, config)) for config in models().values()]
    # Noise is drawn from the seed alone, so that pictures of two models share it.
    truth = films[0][0][hardest].astype(np.float32)
    return [(spent / FRAMES, float(np.sqrt(np.mean((frames[hardest] - truth) ** 2)))) for frames, spent in films]
