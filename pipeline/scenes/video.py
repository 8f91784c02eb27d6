"""From an object to video files: approach, press, twist, let go, as the real videos were recorded."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from pipeline.errors import UserError
from pipeline.physiclear.catalogue import Catalogue
from pipeline.runtime import cores, derive_seed
from pipeline.scenes.contact import indentation, press
from pipeline.scenes.geometry import IMAGE_MM, Heights, heights
from pipeline.scenes.light import Image, Sensor, make_sensor, shade
from pipeline.scenes.recipe import Recipe, recipe_of
from pipeline.sections import ScenesConfig

cv2.setNumThreads(1)  # Videos are what runs in parallel.

SENSORS = 3
"""The data set was recorded with several sensors; each video draws one of these."""
FORCE_N = (3.0, 12.0)
"""Range of the peak force."""
TWIST_DEGREES = (8.0, 30.0)
OFFSET_MM = 2.5
"""How far from the image's centre the object's centre may lie."""
JPEG_QUALITY = 92

Track = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """What the hand does, one value a frame."""

    force: Track
    """In N; 0 before first touch."""
    angle: Track
    """Turn of the object against the sensor, in degrees."""
    x: Track
    """Place of the object's centre in mm, from the image's centre."""
    y: Track


def make_motion(frames: int, rng: np.random.Generator) -> Motion:
    """Rest, a ramp of force, a twist under force, and letting go (not always before the video ends)."""
    time = np.linspace(0, 1, frames)
    touch, hold, release = rng.uniform(0.08, 0.2), rng.uniform(0.35, 0.45), rng.uniform(0.75, 0.9)
    left = rng.uniform(0.1, 0.6)  # The share of the force that is still there at the end.
    force = rng.uniform(*FORCE_N) * _ramp(time, touch, hold) * (1 - (1 - left) * _ramp(time, release, 1.0))
    twist = rng.choice((-1, 1)) * rng.uniform(*TWIST_DEGREES)
    tremor = 0.15 / np.sqrt(frames)  # A random walk of 0.15 mm in all, at any frame rate.
    x, y = (rng.uniform(-OFFSET_MM, OFFSET_MM) + tremor * np.cumsum(rng.standard_normal(frames)) for _ in "xy")
    return Motion(force, rng.uniform(0, 360) + twist * _ramp(time, hold, release), x, y)


def render(recipe: Recipe, config: ScenesConfig, sensor: Sensor, seed: int) -> Iterator[Image]:
    """The frames of one video (height x width x BGR, uint8); everything random in it follows from `seed`."""
    rng = np.random.default_rng(seed)
    pitch = IMAGE_MM[0] / config.width
    motion = make_motion(config.frames, rng)
    margin = OFFSET_MM + 1.0
    side = int(np.hypot(config.width, config.height) + 2 * margin / pitch) | 1
    patch = heights(recipe.surface, side, pitch, rng)
    for number in range(config.frames):
        force = float(motion.force[number])
        if force > 0:
            place = (float(motion.x[number]), float(motion.y[number]))
            shown = _place(patch, float(motion.angle[number]), place, config, pitch)
            contact = press(shown.max() - shown, force, recipe.modulus, pitch)
            skin = indentation(contact, recipe.modulus, pitch)
        else:
            skin = np.zeros((config.height, config.width), np.float32)
        yield shade(skin, sensor, pitch, derive_seed(seed, number))


def synthesize(catalogue: Catalogue, config: ScenesConfig, folder: Path) -> list[Path]:
    """Write `<object>_<number>.avi` for every object asked for, several at a time; return the files, sorted.

    Motion JPEG by OpenCV's own writer: it is in every build of OpenCV and writes no time stamps, so that equal
    seeds give equal files on one machine. Processes are spawned: a script that calls this needs a main guard.

    Raises:
        UserError: if the catalogue lacks an object asked for, or OpenCV cannot write.
    """
    unknown = sorted(set(config.objects) - catalogue.objects.keys())
    if unknown:
        raise UserError(f"scenes.objects: {', '.join(unknown)} is not in the catalogue; take ids from objects.csv")
    object_ids = sorted(set(config.objects) or catalogue.objects)
    names = [(o, number) for o in object_ids for number in range(config.videos_per_object)]
    folder.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    # The writer goes by the suffix, so a video waits under its own name in a hidden folder until it is whole.
    with tempfile.TemporaryDirectory(prefix=".", dir=folder) as staging:
        jobs = [
            _Job(
                recipe_of(o, catalogue, config.seed),
                config,
                derive_seed(config.seed, o, n),
                f"{o}_{n}.avi",
                Path(staging),
            )
            for o, n in names
        ]
        with ProcessPoolExecutor(min(cores(), len(jobs)), mp_context=context) as pool:
            written: Any = pool.map(_write, jobs, chunksize=4)
            try:
                for path in tqdm(written, total=len(jobs), desc="scenes", unit="video", disable=None):
                    os.replace(path, folder / path.name)
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    return sorted(folder / job.name for job in jobs)


@dataclass(frozen=True)
class _Job:
    """All that a process needs to make one video."""

    recipe: Recipe
    config: ScenesConfig
    seed: int
    name: str
    staging: Path


def _write(job: _Job) -> Path:
    config, path = job.config, job.staging / job.name
    sensor = make_sensor(config.width, config.height, derive_seed(config.seed, "sensor", job.seed % SENSORS))
    size = (config.width, config.height)
    writer = cv2.VideoWriter(str(path), cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), config.fps, size)
    if not writer.isOpened():
        raise UserError(f"{path.parent.parent / path.name}: cannot be written; is the folder writable, the disk full?")
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, JPEG_QUALITY)
    for frame in render(job.recipe, config, sensor, job.seed):
        writer.write(frame)
    writer.release()
    return path


def _place(patch: Heights, angle: float, place: tuple[float, float], config: ScenesConfig, pitch: float) -> Heights:
    """Cut the image's part out of the object's patch, turned by `angle` degrees and moved to `place` (mm)."""
    centre = (patch.shape[0] - 1) / 2
    turn = cv2.getRotationMatrix2D((centre, centre), angle, 1.0)
    turn[:, 2] += (
        (config.width - 1) / 2 - centre + place[0] / pitch,
        (config.height - 1) / 2 - centre + place[1] / pitch,
    )
    size = (config.width, config.height)
    shown: Heights = cv2.warpAffine(patch, turn, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return shown


def _ramp(time: Track, start: float, stop: float) -> Track:
    """0 before `start`, 1 after `stop`, smooth between (3 s^2 - 2 s^3)."""
    s = np.clip((time - start) / (stop - start), 0, 1)
    return s * s * (3 - 2 * s)
