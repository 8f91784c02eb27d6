"""Single bumps on a lattice: domes, ridges, plates and digits."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from pipeline.scenes.grid import Degrees, Grid, Heights, Layer, Length, Relief, Share, cap, shifted, window

DRAWN_MM = 0.06
"""Digits are drawn at least this fine, whatever the grid."""


class Domes(Layer):
    """Round bumps on a hexagonal lattice, each strayed at random: peel, dots, buttons, loops of pile, ends of bristles.

    Where none meet they cover occupied pi w^2 / (2 sqrt 3 s^2) of the surface (density of a hexagonal packing).
    """

    kind: Literal["domes"] = "domes"
    height: Relief
    width: Length
    spacing: Length
    """Between centres."""
    edge: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the radius over which the flank falls: 1 a dome, little a button with a flat top."""
    jitter: Share = 0.3
    """How far they stray, as a share of half the spacing; bumps that meet do not add up."""
    occupied: Share = 1.0
    """Share of the lattice's places that bear a bump."""
    uneven: Share = 0.2
    """By which share heights differ."""

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """One bump after the other, each into the few pixels that it covers."""
        half, stray = self.width / 2, self.jitter * self.spacing / 2
        rise = self.spacing * math.sqrt(3) / 2
        reach = grid.span / 2 + half + stray
        numbers = np.arange(-math.ceil(reach / rise) - 1, math.ceil(reach / rise) + 2)
        column, row = np.meshgrid(numbers, numbers)
        places = np.stack([(column + row % 2 / 2) * self.spacing, row * rise], axis=-1).reshape(-1, 2)
        places += rng.uniform(0, 1, 2) * (self.spacing, rise) + stray * rng.uniform(-1, 1, places.shape)
        tall = 1 - self.uneven * rng.random(len(places), dtype=np.float32)
        kept = (rng.random(len(places)) < self.occupied) & (np.abs(places).max(axis=1) < grid.span / 2 + half)
        total, x = np.zeros((grid.side, grid.side), np.float32), grid.line()
        for (px, py), height in zip(places[kept], tall[kept], strict=True):
            columns, rows = window(px, half, grid), window(py, half, grid)
            radius: Heights = np.hypot(x[None, columns] - np.float32(px), x[rows, None] - np.float32(py))
            radius /= np.float32(half)
            seen = total[rows, columns]
            np.maximum(seen, height * cap(radius, self.edge), out=seen)
        return total * np.float32(self.height)


class Ridges(Layer):
    """Parallel ridges with the profile of `Domes`: ribs, grooves, corrugation, seams."""

    kind: Literal["ridges"] = "ridges"
    height: Relief
    width: Length
    spacing: Length
    edge: Annotated[float, Field(gt=0, le=1)] = 1.0
    angle: Degrees = 0.0
    """Direction of the ridges; 0 along the body."""

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """In a random place."""
        spacing = max(self.spacing, self.width)
        u, _ = shifted(grid, self.angle, spacing, spacing, rng)
        offset: Heights = np.abs(u - np.round(u / spacing) * spacing)
        return np.float32(self.height) * cap(offset / np.float32(self.width / 2), self.edge)


class Plates(Layer):
    """Raised rectangles with round corners (superellipses of power 4) on a lattice: keys, tiles, basketwork."""

    kind: Literal["plates"] = "plates"
    height: Relief
    size: tuple[Length, Length]
    """Across and along the body."""
    gap: Length
    edge: Annotated[float, Field(gt=0, le=1)] = 0.3
    uneven: Share = 0.0

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """In a random place of the lattice."""
        across, along = self.size[0] + self.gap, self.size[1] + self.gap
        u, v = shifted(grid, 0.0, across, along, rng)
        column, row = np.round(u / across), np.round(v / along)
        du, dv = (u - column * across) / (self.size[0] / 2), (v - row * along) / (self.size[1] / 2)
        radius: Heights = np.sqrt(np.hypot(np.square(du), np.square(dv)))
        table = rng.random((64, 64), dtype=np.float32)
        tall = 1 - self.uneven * table[row.astype(np.intp) & 63, column.astype(np.intp) & 63]
        raised: Heights = np.float32(self.height) * tall * cap(radius, self.edge)
        return raised


class Digits(Layer):
    """Random digits in rows, embossed or (height below 0) engraved: number wheels, stamped codes."""

    kind: Literal["digits"] = "digits"
    height: Relief
    size: Length
    """Height of a digit."""
    stroke: Length
    spacing: tuple[Length, Length]
    """Between digits and between rows."""

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """Hershey's strokes (OpenCV), rounded by a Gaussian of a quarter of their width."""
        finer = math.ceil(grid.pitch / DRAWN_MM)
        pixel, side = grid.pitch / finer, grid.side * finer
        canvas = np.zeros((side, side), np.uint8)
        scale = self.size / pixel / 21  # Digits of this font are 21 pixels high.
        steps = (self.spacing[0] / pixel, self.spacing[1] / pixel)
        for y in np.arange(rng.uniform(0, steps[1]), side + steps[1], steps[1]):
            for x in np.arange(rng.uniform(-1, 0) * steps[0], side, steps[0]):
                place = (round(x), round(y))
                thick = max(1, round(self.stroke / pixel))
                cv2.putText(canvas, str(rng.integers(10)), place, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thick)
        smooth = cv2.GaussianBlur(canvas.astype(np.float32), (0, 0), max(0.5, self.stroke / 4 / pixel))
        drawn: Heights = cv2.resize(smooth, (grid.side, grid.side), interpolation=cv2.INTER_AREA)
        return drawn * np.float32(self.height / 255)
