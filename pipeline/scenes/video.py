"""From recipes to video files, several at a time."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2

from pipeline.config import ScenesConfig
from pipeline.core.records import Record
from pipeline.core.runtime import derive_seed
from pipeline.running.errors import UserError
from pipeline.running.parallel import run_parallel
from pipeline.scenes.light import make_sensor
from pipeline.scenes.recipe import SceneRecipe
from pipeline.scenes.render import make_scene, measure_scene, render
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.film import write_film

cv2.setNumThreads(1)  # Videos are what runs in parallel.

SENSORS = 3
"""The data set was recorded with several sensors; each video draws one of these."""


class SceneRow(Record):
    """How one video was made."""

    video: str
    object_id: str
    frames: int
    fps: float
    force: float
    """The largest force, in N."""
    method: str
    """The contact model (`pipeline.scenes.contact.Method`)."""
    error: float | None
    """`auto`'s estimate of the relative error in slopes."""
    residual: float
    """Residual of the contact solver."""
    modulus: float
    """The object's modulus, in MPa. This and the next two decide its classes (`pipeline.scenes.measure`)."""
    texture: float
    """In mm."""
    bump: float
    """Over the image's height."""
    hardness: int
    roughness: int
    bumpiness: int


def synthesize(recipes: Mapping[str, SceneRecipe], config: ScenesConfig, folder: Path) -> list[SceneRow]:
    """Write `<object>_<number>.mp4` for every object asked for, several at a time; return how, sorted by name.

    Equal seeds give equal files on one machine.

    Raises:
        UserError: if there is no recipe for an object asked for, or a file cannot be written.
    """
    unknown = sorted(set(config.objects) - recipes.keys())
    if unknown:
        raise UserError(f"scenes.objects: {', '.join(unknown)} is not in the catalogue; take ids from objects.csv")
    folder.mkdir(parents=True, exist_ok=True)
    objects, numbers = sorted(set(config.objects) or recipes), range(config.videos_per_object)
    jobs = [_Job(o, n, recipes[o]) for o in objects for n in numbers]
    rows = []
    # A video waits in a hidden folder until it is whole.
    with tempfile.TemporaryDirectory(f".{os.getpid()}.part", ".", folder) as staging:
        for row in run_parallel(partial(_write, Path(staging), config), jobs, "scenes", "video"):
            os.replace(Path(staging) / row.video, folder / row.video)
            rows.append(row)
    return sorted(rows, key=lambda row: row.video)


def share_as_labelled(rows: Sequence[SceneRow], catalogue: Catalogue) -> float:
    """The share of the videos whose scene measures in all classes as the catalogue labels its object."""
    fitting = 0
    for row in rows:
        # Further properties of a catalogue leave no trace in a scene.
        labels = dict(zip(catalogue.property_names, catalogue.labels(row.object_id), strict=True))
        measured = {"hardness": row.hardness, "roughness": row.roughness, "bumpiness": row.bumpiness}
        fitting += all(labels.get(name, found) == found for name, found in measured.items())
    return round(fitting / len(rows), 4)


class _Job(NamedTuple):
    object_id: str
    number: int
    recipe: SceneRecipe

    def __str__(self) -> str:
        return f"{self.object_id}_{self.number}.mp4"


def _write(staging: Path, config: ScenesConfig, job: _Job) -> SceneRow:
    recipe, seed = job.recipe, derive_seed(config.seed, job.object_id, job.number)
    sensor = make_sensor(config.width, config.height, derive_seed(config.seed, "sensor", seed % SENSORS))
    scene = make_scene(recipe, config, config.frames, seed)
    write_film(staging / str(job), render(scene, config, sensor, seed), config.fps)
    imprint, measured = scene.imprint, measure_scene(scene, recipe, config)
    return SceneRow(
        video=str(job),
        object_id=job.object_id,
        frames=config.frames,
        fps=config.fps,
        force=round(imprint.force, 4),
        method=str(imprint.method),
        error=None if imprint.error is None else round(imprint.error, 4),
        residual=round(imprint.residual, 6),
        modulus=recipe.modulus,
        texture=round(measured.texture, 5),
        bump=round(measured.bump, 4),
        hardness=measured.hardness,
        roughness=measured.roughness,
        bumpiness=measured.bumpiness,
    )
