"""From an object to the frames of one video: a patch of its surface, pressed once, cut out frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.config import ScenesConfig
from pipeline.core.runtime import derive_seed
from pipeline.running.errors import UserError
from pipeline.scenes.contact import GEL, LADDER, Imprint, Method, press
from pipeline.scenes.elastic.torsion import slip_turn, twist
from pipeline.scenes.geometry import IMAGE_MM, heights
from pipeline.scenes.grid import Heights
from pipeline.scenes.light import Image, Sensor, shade
from pipeline.scenes.measure import Measured, bump_share, texture
from pipeline.scenes.motion import REACH_MM, Motion, make_motion
from pipeline.scenes.recipe import SceneRecipe


@dataclass(frozen=True)
class Scene:
    """One video before it is seen: what is pressed, how, and how the hand moves."""

    surface: Heights
    """The undeformed patch, in mm."""
    imprint: Imprint
    motion: Motion
    pitch: float
    """In mm a pixel."""


def make_scene(recipe: SceneRecipe, config: ScenesConfig, frames: int, seed: int) -> Scene:
    """Draw a patch and a motion, and press; everything random follows from `seed`."""
    rng = np.random.default_rng(seed)
    pitch = IMAGE_MM[0] / config.width
    motion = make_motion(frames, rng, twist=recipe.twist)
    # A patch reaches beyond the view at every angle and wherever the hand moves. An odd side has a pixel in the middle,
    # which is what turns.
    side = int(np.hypot(config.width, config.height) + 2 * REACH_MM / pitch) | 1
    patch = heights(recipe.body, recipe.relief, side, pitch, rng)
    needed = math.ceil(2 * side * pitch / GEL.thickness)
    most = {"layer": config.cells, "auto": LADDER[-1].cells}.get(config.tier, side)
    if most < min(needed, side):
        raise UserError(
            f"scenes.tier={config.tier} has {most} cells, but pictures of {config.width} x {config.height} need "
            f"{needed} or more; take scenes.tier=layer and scenes.cells={needed}, or a shape nearer to 4:3"
        )
    method = None if config.tier == "auto" else Method(config.tier, 0 if config.tier == "winkler" else config.cells)
    force = float(motion.force.max())
    imprint = press(patch, force, recipe.modulus, pitch, method, tolerance=config.tolerance)
    return Scene(patch, imprint, motion, pitch)


def measure_scene(scene: Scene, recipe: SceneRecipe, config: ScenesConfig) -> Measured:
    """What the object's classes can be told from, in the middle of the patch under the largest force."""
    top, left = (scene.surface.shape[0] - config.height) // 2, (scene.surface.shape[1] - config.width) // 2
    view = (slice(top, top + config.height), slice(left, left + config.width))
    rough, bump = texture(scene.surface[view], scene.pitch), bump_share(scene.imprint.skins[-1][view], scene.pitch)
    return Measured(recipe.modulus, rough, bump)


def render(scene: Scene, config: ScenesConfig, sensor: Sensor, seed: int) -> Iterator[Image]:
    """The frames of one video (height x width x BGR, uint8)."""
    motion, start = scene.motion, float(scene.motion.angle[0])
    untouched = np.zeros((config.height, config.width), np.float32)
    for number, force in enumerate(motion.force.tolist()):
        noise = derive_seed(seed, number)
        if force <= 0:
            yield shade(untouched, sensor, scene.pitch, noise)
            continue
        angle = float(motion.angle[number])
        centre = (
            (config.width - 1) / 2 + float(motion.x[number]) / scene.pitch,
            (config.height - 1) / 2 + float(motion.y[number]) / scene.pitch,
        )
        skin = place(scene.imprint.at(force), angle, centre, (config.width, config.height))
        drift = None
        if angle != start:
            # The motion's angle is counterclockwise; with y downwards, turning from x to y is clockwise.
            radius = scene.imprint.radius(force)
            most = slip_turn(force, radius, GEL.shear_modulus)
            turn = max(-most, min(most, math.radians(start - angle)))
            drift = twist((config.height, config.width), centre, radius, turn, scene.pitch)
        yield shade(skin, sensor, scene.pitch, noise, drift)


def place(patch: Heights, angle: float, centre: Sequence[float], size: tuple[int, int]) -> Heights:
    """Cut a view, width x height, out of a patch turned by `angle` degrees and with its middle at `centre` (pixels)."""
    middle = (patch.shape[0] - 1) / 2
    turn = cv2.getRotationMatrix2D((middle, middle), angle, 1.0)
    turn[:, 2] += (centre[0] - middle, centre[1] - middle)
    # Cubic would ripple on slopes; away from them the skin hardly changes within a pixel.
    shown: Heights = cv2.warpAffine(patch, turn, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return shown
