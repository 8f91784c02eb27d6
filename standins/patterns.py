"""Height fields of ordinary surfaces: stripes, bricks, weave, pebbles, clouds and the like."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating[Any]]

PATTERNS = (
    "plain",
    "striped",
    "dotted",
    "checked",
    "wavy",
    "grainy",
    "wooden",
    "brick",
    "marbled",
    "woven",
    "pebbled",
    "cracked",
    "ribbed",
    "cloudy",
)


def draw_pattern(name: str, u: Array, v: Array, periods: float, rng: np.random.Generator) -> Array:
    """The pattern's height, 0 to 1, at coordinates (u, v) in -1 .. 1, with about `periods` repeats across."""
    u, v = u + rng.uniform(0, 1), v + rng.uniform(0, 1)
    w = np.float32(np.pi * periods)
    match name:
        case "plain":
            height = np.full_like(u, 0.6)
        case "striped":
            height = np.where(np.sin(w * u) > 0, 1.0, 0.0)
        case "dotted":
            height = np.where(np.hypot(_saw(u * periods / 2), _saw(v * periods / 2)) < 0.28, 0.0, 1.0)
        case "checked":
            height = np.where(np.sin(w * u) * np.sin(w * v) > 0, 1.0, 0.0)
        case "wavy":
            height = 0.5 + 0.5 * np.sin(w * (v + 0.15 * np.sin(1.5 * np.pi * u)))
        case "grainy":
            height = np.clip(0.5 + 0.35 * _noise(u.shape[0], int(4 * periods), rng), 0, 1)
        case "wooden":
            height = 0.5 + 0.5 * np.sin(w * (0.8 * u + 0.25 * _noise(u.shape[0], 3, rng)) + 0.4 * v)
        case "brick":
            row = np.floor(v * periods)
            gap = np.maximum(np.abs(_saw(v * periods)), np.abs(_saw(u * periods / 2 + row / 2)) * 1.05)
            height = np.where(gap > 0.42, 0.0, 0.9)
        case "marbled":
            height = np.abs(np.sin(0.4 * w * u + 2.5 * _clouds(u.shape[0], rng)))
        case "woven":
            over = np.sin(w * u) * np.sin(w * v) > 0
            height = np.where(over, np.abs(np.sin(w * u)), np.abs(np.sin(w * v)))
        case "pebbled":
            near, _ = _cells(u, v, periods, rng)
            height = np.clip(1 - (near * periods * 0.9) ** 2, 0, 1)
        case "cracked":
            near, second = _cells(u, v, periods * 0.7, rng)
            height = np.clip((second - near) * periods * 1.5, 0, 1)
        case "ribbed":
            height = np.abs(np.sin(w * u / 2))
        case "cloudy":
            height = np.clip(0.5 + 0.4 * _clouds(u.shape[0], rng, int(periods)), 0, 1)
        case _:
            raise ValueError(f"unknown pattern {name}")
    return height.astype(np.float32)


def _saw(t: Array) -> Array:
    return t - np.round(t)


@cache
def _interpolation(pixels: int, knots: int) -> Array:
    """Linear interpolation from `knots` values to `pixels`, as a matrix (pixels x knots)."""
    at = np.linspace(0, knots - 1, pixels)
    matrix: Array = np.maximum(0, 1 - np.abs(at[:, None] - np.arange(knots)[None])).astype(np.float32)
    return matrix


def _noise(pixels: int, knots: int, rng: np.random.Generator) -> Array:
    """Smooth normal noise, pixels x pixels."""
    matrix = _interpolation(pixels, min(max(knots, 2), pixels))
    return matrix @ rng.standard_normal((matrix.shape[1], matrix.shape[1]), dtype=np.float32) @ matrix.T


def _clouds(pixels: int, rng: np.random.Generator, knots: int = 3) -> Array:
    """Noise of several sizes from `knots` across on, each half as strong as the next larger one."""
    octaves = [_noise(pixels, knots * 2**k, rng) * 0.5**k for k in range(4)]
    clouds: Array = np.sum(octaves, axis=0, dtype=np.float32)
    return clouds


def _cells(u: Array, v: Array, periods: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Distances to the nearest and second nearest of jittered seed points, one in each cell (Worley 1996)."""
    side = np.float32(2 / (np.ceil(periods) + 1))
    column, row = np.floor(u / side).astype(np.int64), np.floor(v / side).astype(np.int64)
    first, top = column.min() - 1, row.min() - 1
    jitter = rng.uniform(0.2, 0.8, (2, row.max() - top + 2, column.max() - first + 2)).astype(np.float32)
    near, second = np.full(u.shape, np.inf, np.float32), np.full(u.shape, np.inf, np.float32)
    # The jitter is small enough that both lie in the cell or in one beside it.
    for down, right in itertools.product((-1, 0, 1), repeat=2):
        i, j = row + down, column + right
        du = u - (j + jitter[0, i - top, j - first]) * side
        dv = v - (i + jitter[1, i - top, j - first]) * side
        squared = du * du + dv * dv
        second = np.minimum(second, np.maximum(near, squared))
        near = np.minimum(near, squared)
    return np.sqrt(near), np.sqrt(second)
