"""Ordinary pictures with captions, drawn by code: coloured shapes, filled surfaces, light from a side.

A scene is a handful of words and numbers; `draw` turns it into a picture and `caption` into a sentence about it.
Some pairs of words never meet in a training scene, so that a test shows composition and not memory.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from standins.patterns import PATTERNS, draw_pattern

Array = npt.NDArray[np.floating[Any]]

COLOURS = {
    "red": (0.85, 0.12, 0.12),
    "green": (0.15, 0.65, 0.2),
    "blue": (0.15, 0.25, 0.85),
    "yellow": (0.95, 0.85, 0.15),
    "orange": (0.95, 0.5, 0.1),
    "purple": (0.55, 0.2, 0.7),
    "pink": (0.95, 0.6, 0.7),
    "brown": (0.45, 0.28, 0.14),
    "grey": (0.5, 0.5, 0.5),
    "white": (0.95, 0.95, 0.95),
    "black": (0.12, 0.12, 0.12),
    "cyan": (0.2, 0.8, 0.85),
}
SHAPES = ("circle", "square", "triangle", "ring", "cross", "star", "ellipse", "hexagon", "crescent", "surface")
LIGHTS = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "above": (0.0, -1.0), "below": (0.0, 1.0)}
SIZES = {"small": 0.5, "large": 0.8}
PLACES = {"left": (-0.35, 0.0), "right": (0.35, 0.0), "top": (0.0, -0.35), "bottom": (0.0, 0.35), "middle": (0.0, 0.0)}
DEPTHS = {"flat": 0.0, "raised": 1.0}
HELD_OUT_EVERY = 7
OPENINGS = ("", "a photo of ", "a picture of ", "an image of ", "here is ", "this is ")
GRAINS = ("fine", "coarse")
WORDS: dict[str, tuple[str, ...]] = {
    "colour": tuple(COLOURS),
    "pattern": PATTERNS,
    "shape": SHAPES[:-1],
    "light": tuple(LIGHTS),
    "depth": tuple(DEPTHS),
    "grain": GRAINS,
    "size": tuple(SIZES),
    "place": tuple(PLACES),
    "ground": tuple(COLOURS),
}
"""What a caption can be about, and the words for it where it can be seen."""
TOPICS = tuple(WORDS)


@dataclass(frozen=True)
class Scene:
    """One picture in words. `surface` as shape fills the whole picture with the pattern."""

    shape: str
    colour: str
    ground: str
    pattern: str
    grain: str
    light: str
    size: str
    place: str
    depth: str
    seed: int

    @property
    def held_out(self) -> bool:
        """Whether the scene shows a pair (colour, pattern) or (shape, colour) that training never shows."""
        colour = list(COLOURS).index(self.colour)
        first = (colour + 3 * PATTERNS.index(self.pattern)) % HELD_OUT_EVERY == 0
        return first or (2 * colour + SHAPES.index(self.shape)) % HELD_OUT_EVERY == 0


def draw_scene(rng: random.Random, *, held_out: bool) -> Scene:
    """A random scene from one side of the held-out border."""
    while True:
        colour, ground = rng.sample(list(COLOURS), 2)
        scene = Scene(
            shape=rng.choice(SHAPES) if rng.random() < 0.6 else "surface",
            colour=colour,
            ground=ground,
            pattern=rng.choice(PATTERNS),
            grain=rng.choice(GRAINS),
            light=rng.choice(list(LIGHTS)),
            size=rng.choice(list(SIZES)),
            place=rng.choice(list(PLACES)),
            depth=rng.choice(list(DEPTHS)),
            seed=rng.getrandbits(32),
        )
        if scene.held_out == held_out:
            return scene


def shows(scene: Scene, topic: str) -> bool:
    """Whether one can see it: a surface has no outline and no place, no plain thing grain, no plain surface relief."""
    if topic in ("shape", "ground", "place", "size"):
        return scene.shape != "surface"
    if topic == "grain":
        return scene.pattern != "plain"
    return topic != "depth" or scene.shape != "surface" or scene.pattern != "plain"


def with_word(scene: Scene, topic: str, word: str) -> Scene:
    """The scene with another word for one topic."""
    return dataclasses.replace(scene, **{topic: word})  # type: ignore[arg-type]


def caption(scene: Scene, topics: Collection[str] = TOPICS, opening: str = "") -> str:
    """A sentence about those topics of a scene that can be seen in it."""
    seen = [topic for topic in topics if shows(scene, topic)]
    words = [getattr(scene, topic) for topic in ("depth", "size", "grain", "colour", "pattern") if topic in seen]
    words.append(scene.shape if "shape" in topics else "thing")
    if "ground" in seen:
        words.append(f"on {_article(scene.ground)} background")
    if "place" in seen:
        words.append("in the middle" if scene.place == "middle" else f"at the {scene.place}")
    if "light" in seen:
        words.append(f"lit from {'the ' if scene.light in ('left', 'right') else ''}{scene.light}")
    return opening + _article(" ".join(words))


def _article(words: str) -> str:
    return f"an {words}" if words[0] in "aeio" else f"a {words}"


def draw(scene: Scene, pixels: int) -> Array:
    """The picture of a scene: float32, pixels x pixels x RGB, 0 to 1."""
    rng = np.random.default_rng(scene.seed)
    y, x = _grid(pixels)
    angle = rng.uniform(-0.4, 0.4)
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    periods = rng.uniform(7, 10) if scene.grain == "fine" else rng.uniform(3, 4.5)
    height = draw_pattern(scene.pattern, u, v, periods, rng)
    inside = _inside(scene, x, y, rng)
    base = _tint(scene.colour, rng) * (0.45 + 0.65 * height[..., None])
    if scene.depth == "raised":
        base = _tint(scene.colour, rng) * (0.8 + 0.25 * height[..., None])
        base = base * _relief(height * 0.12 + inside * 0.15, scene.light)[..., None]
    picture = inside[..., None] * base + (1 - inside[..., None]) * _tint(scene.ground, rng)
    dx, dy = LIGHTS[scene.light]
    falloff = 1 + 0.3 * (dx * x + dy * y)
    noise = 0.015 * rng.standard_normal(picture.shape, dtype=np.float32)
    picture = picture * falloff[..., None] * rng.uniform(0.85, 1.1) + noise
    return np.clip(picture, 0, 1).astype(np.float32)


def _grid(pixels: int) -> tuple[Array, Array]:
    axis = np.linspace(-1, 1, pixels, dtype=np.float32)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return y, x


def _tint(colour: str, rng: np.random.Generator) -> Array:
    tint: Array = np.clip(np.asarray(COLOURS[colour]) + rng.normal(0, 0.03, 3), 0, 1).astype(np.float32)
    return tint


def _relief(height: Array, light: str) -> Array:
    """Lambert shading of a height field (heights in units of half the picture) under one oblique light."""
    slope_y, slope_x = np.gradient(height, 2 / height.shape[0])
    dx, dy = LIGHTS[light]
    # The normal is (-slope_x, -slope_y, 1) up to its length; the light stands 45 degrees above the horizon.
    shade = (1 - dx * slope_x - dy * slope_y) / np.sqrt(2 * (1 + slope_x**2 + slope_y**2))
    shading: Array = (0.35 + 0.9 * np.clip(shade, 0, None)).astype(np.float32)
    return shading


def _inside(scene: Scene, x: Array, y: Array, rng: np.random.Generator) -> Array:
    """How far each pixel lies inside the shape: 0 to 1 with a soft edge."""
    if scene.shape == "surface":
        return np.ones(x.shape, np.float32)
    cx, cy = PLACES[scene.place] if scene.size == "small" else np.multiply(PLACES[scene.place], 0.5)
    scale, turn = SIZES[scene.size] * rng.uniform(0.9, 1.1), rng.uniform(-0.3, 0.3)
    px, py = (x - cx - rng.normal(0, 0.03)) / scale, (y - cy - rng.normal(0, 0.03)) / scale
    px, py = px * np.cos(turn) + py * np.sin(turn), py * np.cos(turn) - px * np.sin(turn)
    distance = _signed_distance(scene.shape, px, py)
    inside: Array = np.clip(0.5 - distance * 12 * scale, 0, 1).astype(np.float32)
    return inside


def _signed_distance(shape: str, x: Array, y: Array) -> Array:
    """Roughly the distance to the shape's outline, negative inside; the shape fits the unit circle."""
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    distance: Array
    match shape:
        case "circle":
            distance = r - 0.9
        case "square":
            distance = np.maximum(np.abs(x), np.abs(y)) - 0.75
        case "triangle":
            distance = np.maximum(np.abs(x) * 0.87 + y * 0.5, -y) - 0.45
        case "ring":
            distance = np.abs(r - 0.7) - 0.22
        case "cross":
            distance = np.maximum(np.minimum(np.abs(x), np.abs(y)) - 0.25, np.maximum(np.abs(x), np.abs(y)) - 0.9)
        case "star":
            distance = r - 0.62 - 0.33 * np.cos(5 * angle + np.pi / 2)
        case "ellipse":
            distance = np.hypot(x, y / 0.5) * 0.6 - 0.57
        case "hexagon":
            distance = np.maximum(np.abs(x) * 0.87 + np.abs(y) * 0.5, np.abs(y)) - 0.78
        case "crescent":
            distance = np.maximum(r - 0.9, 0.75 - np.hypot(x - 0.45, y))
        case _:
            raise ValueError(f"unknown shape {shape}")
    return distance
