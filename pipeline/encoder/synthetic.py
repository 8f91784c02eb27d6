"""Pictures of invented objects with all that is known of each: what an encoder is pretrained on.

Each invented object (`pipeline.scenes.invent`) is pressed at a few forces into as many sensors of different light. Its
pictures are differences to the no-contact frame, made as those of real videos are. Nothing of any real object goes in
but the sensor's measured light.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.config import FramesConfig, PretrainConfig
from pipeline.core.io import atomic
from pipeline.core.runtime import derive_seed
from pipeline.running.parallel import run_parallel
from pipeline.scenes.contact import Method, press_by
from pipeline.scenes.geometry import IMAGE_MM, heights
from pipeline.scenes.grid import Heights
from pipeline.scenes.invent import LAYERS, invent
from pipeline.scenes.light import Image, Sensor, make_sensor, shade
from pipeline.scenes.measure import CUTOFF, bump_share, texture
from pipeline.scenes.motion import CENTRE_MM
from pipeline.scenes.render import place
from pipeline.videos.frames.subtraction import subtract

WIDTH, HEIGHT = 160, 120
"""Pixels that pictures are drawn at before they are fitted to the encoder's size."""
PITCH = IMAGE_MM[0] / WIDTH
SIDE = int(np.hypot(WIDTH, HEIGHT) + 8 / PITCH) | 1
"""Side of the pressed patch in pixels: the view at every angle and 4 mm around it; odd, to have a middle pixel."""
METHOD = Method("layer", 64)
"""Takes half the time of 128 cells; frames have errors of 1.7 steps of 255, not 0.9 (reports/speed_error.csv)."""
FORCES = (0.1, 8.0)
"""In N, drawn evenly on a logarithmic axis: wider than the real videos' range."""
SENSORS = 24
QUALITY = (60, 96)
"""Range of the JPEG quality of pictures: real frames went through a lossy codec too."""
BANDS_MM = (0.3, 0.6, 1.2, 2.4, 4.8)
"""Borders between the wavelengths whose heights are to be predicted."""
KINDS: tuple[str, ...] = (*LAYERS, "flat", "round", "bar", "wedge")
"""Kinds of relief and of body; the encoder predicts for each object which of them it has."""
CHUNK = 50
"""Objects that one process draws at a time, and that a killed drawing loses at most for each process."""


class SyntheticPictures(NamedTuple):
    """Drawn pictures and what is known of them; arrays have one row an object."""

    pictures: npt.NDArray[np.uint8]
    """Objects x presses x size x size x RGB."""
    quantities: npt.NDArray[np.float32]
    """Objects x presses x what `draw_object` measures."""
    kinds: npt.NDArray[np.uint8]
    """Objects x `KINDS`."""


class _Job(NamedTuple):
    numbers: range
    config: PretrainConfig
    frames: FramesConfig
    file: Path

    def __str__(self) -> str:
        return f"synthetic objects {self.numbers.start} to {self.numbers.stop}"


def draw_pictures(config: PretrainConfig, frames: FramesConfig, folder: Path) -> SyntheticPictures:
    """Draw all objects, in as many processes as there are cores; what is finished waits in `folder`.

    Object i depends on the seed and i alone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    chunks = [range(i, min(i + CHUNK, config.objects)) for i in range(0, config.objects, CHUNK)]
    jobs = [_Job(chunk, config, frames, folder / f"{chunk.start:06d}.npz") for chunk in chunks]
    for _ in run_parallel(_draw, [job for job in jobs if not job.file.is_file()], "synthetic pictures", "chunk"):
        pass
    parts = []
    for job in jobs:
        with np.load(job.file) as part:  # Closed one by one: a process may hold a thousand files open.
            parts.append([part[name] for name in SyntheticPictures._fields])
    return SyntheticPictures(*map(np.concatenate, zip(*parts, strict=True)))


def draw_object(number: int, config: PretrainConfig, frames: FramesConfig) -> SyntheticPictures:
    """One object, in arrays of one row."""
    rng = np.random.default_rng(derive_seed(config.seed, "lesson", number))
    recipe = invent(rng)
    surface = heights(recipe.body, recipe.relief, SIDE, PITCH, rng)
    forces = np.sort(np.exp(rng.uniform(math.log(FORCES[0]), math.log(FORCES[1]), config.presses)))
    pressed = press_by(METHOD, surface, forces, recipe.modulus, PITCH)
    rough = texture(surface, PITCH)
    pictures, quantities = [], []
    for force, whole, area in zip(forces.tolist(), pressed.skins, pressed.areas.tolist(), strict=True):
        angle = rng.uniform(0, 360)
        centre = [(n - 1) / 2 + rng.normal(*at) / PITCH for n, at in zip((WIDTH, HEIGHT), CENTRE_MM, strict=True)]
        skin, shown = (place(field, angle, centre, (WIDTH, HEIGHT)) for field in (whole, surface))
        touched = skin > 0.15 * max(float(skin.max()), 1e-6)
        quantities.append(
            [  # What is added keeps logarithms finite.
                np.log10(recipe.modulus),
                np.log10(force),
                np.log10(area / np.pi + 0.05) / 2,  # The radius of contact.
                np.log10(rough + 5e-4),
                bump_share(skin, PITCH),
                np.log10(float(skin.max()) + 1e-3),  # The depth.
                *_bands(shown, touched),
                *_bands(skin, touched),
            ]
        )
        pictures.append(_picture(skin, sensors()[int(rng.integers(SENSORS))], rng, frames))
    present = {layer.kind for layer in recipe.relief} | {recipe.body.kind}
    return SyntheticPictures(
        pictures=np.stack(pictures)[None],
        quantities=np.array(quantities, np.float32)[None],
        kinds=np.array([[kind in present for kind in KINDS]], np.uint8),
    )


@lru_cache(maxsize=1)
def sensors() -> list[Sensor]:
    """The sensors that objects are seen through; each has its own background, tints and dust."""
    return [make_sensor.__wrapped__(WIDTH, HEIGHT, seed) for seed in range(SENSORS)]


def _draw(job: _Job) -> None:
    cv2.setNumThreads(1)
    drawn = [draw_object(number, job.config, job.frames) for number in job.numbers]
    rows = SyntheticPictures(*map(np.concatenate, zip(*drawn, strict=True)))
    with atomic(job.file) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **rows._asdict())


def _bands(field: Heights, where: npt.NDArray[np.bool_]) -> list[float]:
    """Logarithm of the root mean square height in mm of each band of wavelengths, where the body touches."""
    found = []
    for band in BANDS_MM:
        smooth = cv2.GaussianBlur(field, (0, 0), CUTOFF * band / PITCH)
        rest = (field - smooth)[where]
        found.append(float(np.log10(rest.std() + 1e-3)) if rest.size else -3.0)
        field = smooth
    return found


def _picture(skin: Heights, sensor: Sensor, rng: np.random.Generator, frames: FramesConfig) -> Image:
    """The difference picture of one press: size x size x RGB, fitted as `pipeline.videos.decoding.fit` does it."""
    frame = shade(skin, sensor, PITCH, int(rng.integers(2**40)))
    coded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*QUALITY))])[1]
    fitted = []
    for picture in (np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR)), cv2.convertScaleAbs(sensor.background)):
        if frames.fit == "crop":
            left = (WIDTH - HEIGHT) // 2
            picture = picture[:, left : left + HEIGHT]
        way = cv2.INTER_AREA if frames.pixels < HEIGHT else cv2.INTER_LINEAR
        fitted.append(cv2.resize(picture, (frames.pixels, frames.pixels), interpolation=way)[:, :, ::-1])
    shown, untouched = np.asarray(fitted, dtype=np.uint8)
    difference: Image = subtract(shown[None], untouched)[0]
    return difference
