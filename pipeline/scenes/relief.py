"""What stands out of a body: layers of relief, each a few numbers in mm and a formula, sampled on any grid.

A layer is a frozen record with the key `kind`, so that a line of YAML is a layer. Its `sample` gives one random patch
(side x side, mm, pointing towards the sensor) from a generator; layers of a surface add up. Statistics do not depend on
the grid's pitch, down to what the grid can carry. Here are the textures that cover everything; `bumps` has those that
stand alone.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipeline.scenes.bumps import Digits, Domes, Plates, Ridges
from pipeline.scenes.grid import (
    Degrees,
    Grid,
    Heights,
    Layer,
    Length,
    Relief,
    Share,
    field,
    shifted,
    thread,
    waves,
    window,
)


class Rough(Layer):
    """Self-affine roughness: amplitude ~ q^-(1 + H) up to the wavelength `longest`, none beyond.

    Persson et al., J. Phys.: Condens. Matter 17 (2005) R1, eq. 3. Waves that the grid cannot carry are left out, not
    added to the longer ones: the root mean square is rms sqrt(1 - (2 pitch / longest)^2H), exactly.
    """

    kind: Literal["rough"] = "rough"
    rms: Length
    """Root mean square height of all waves."""
    longest: Length
    hurst: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Usual for worn and broken surfaces (ibid.)."""
    stretch: Annotated[float, Field(ge=1, le=50)] = 1.0
    """How much longer than wide its features are: brushed metal, wood, combed fibres."""
    angle: Degrees = 0.0
    """Direction of the long side; 0 along the body."""

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """White noise filtered by FFT."""
        low, high = 1 / self.longest, 1 / (2 * grid.pitch)
        if low >= high:
            return np.zeros((grid.side, grid.side), np.float32)
        carried = 1 - (low / high) ** (2 * self.hurst)
        q = waves(grid, self.angle, self.stretch)
        inside = (q >= low) & (q <= high)
        amplitude = np.where(inside, np.maximum(q, np.float32(low)) ** np.float32(-1 - self.hurst), np.float32(0))
        return field(grid, amplitude, rng) * np.float32(self.rms * math.sqrt(carried))


class Creases(Layer):
    """Crumpled paper: facets between folds; a height below 0 makes the facets cushions.

    height (1 - (sqrt(g^2 + fold^2) - fold) / 2), where g is a Gaussian field of one wavelength and variance 1.

    Facets between ridges: Witten, Rev. Mod. Phys. 79 (2007) 643. Folds lie where g = 0, whose mean distance along a
    line is the wavelength / sqrt 2 (Rice, Bell Syst. Tech. J. 24 (1945) 46, for an isotropic field).
    """

    kind: Literal["creases"] = "creases"
    height: Relief
    spacing: Length
    """Mean distance of folds along a line."""
    fold: Share = 0.1
    """How rounded the folds are: 0 sharp, 1 waves."""

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """A band of 20 % to either side of the wavelength."""
        q = waves(grid) * np.float32(self.spacing * math.sqrt(2))
        band: Heights = np.exp(np.float32(-0.5) * np.square((q - 1) / np.float32(0.2)))
        apart: Heights = np.hypot(field(grid, band, rng), np.float32(self.fold))
        return np.float32(self.height) * (1 - (apart - np.float32(self.fold)) * np.float32(0.5))


class Weave(Layer):
    """Cloth: two crossing families of round threads that bend over and under each other.

    Peirce, J. Textile Inst. 28 (1937) T45: the axis of thread k runs at (crimp / 2) cos(2 pi (v / s + k) / repeat),
    that of the crossing family opposite; the surface is the upper envelope of the threads.
    """

    kind: Literal["weave"] = "weave"
    spacing: Length
    """Between neighbouring threads."""
    thread: Length
    """Diameter of a thread."""
    crimp: Length
    """How far a thread goes up and down."""
    repeat: Annotated[int, Field(ge=2, le=8)] = 2
    """Threads until the pattern repeats: 2 plain weave, 4 twill with its diagonals."""

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """In a random place."""
        period = self.spacing * self.repeat
        u, v = shifted(grid, 0.0, period, period, rng)
        return np.maximum(self._family(u, v, 1.0), self._family(v, u, -1.0))

    def _family(self, across: Heights, along: Heights, sign: float) -> Heights:
        number: Heights = np.round(across / self.spacing)
        phase = (along / self.spacing + number) * np.float32(2 * math.pi / self.repeat)
        middle = np.float32(sign * self.crimp / 2) * np.cos(phase)
        offset: Heights = across - number * self.spacing
        bent: Heights = middle + thread(offset, self.thread / 2)
        return bent


class Strands(Layer):
    """Bundles of long round strands side by side: sides of bristles, wires, cords, hair, wool.

    Each strand is a cylinder at a depth of its own; a bundle meanders as a whole. Several bundles in random directions
    make a tangle; the surface is the upper envelope.
    """

    kind: Literal["strands"] = "strands"
    width: Length
    """Diameter of a strand."""
    spacing: Length
    uneven: Share = 0.2
    """Share of a diameter by which strands lie deeper than others."""
    waver: Annotated[float, Field(ge=0, le=5)] = 0.0
    """By how much a bundle meanders sideways, root mean square in mm, over 15 mm."""
    bundles: Annotated[int, Field(ge=1, le=8)] = 1

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """The first bundle lies along the body, others in any direction, each up to a diameter deeper."""
        total = np.full((grid.side, grid.side), -np.inf, np.float32)
        for bundle in range(self.bundles):
            u, v = shifted(grid, 0.0 if bundle == 0 else rng.uniform(0, 180), self.spacing, 15.0, rng)
            bend = np.float32(self.waver * math.sqrt(2)) * np.sin(v * np.float32(2 * math.pi / 15))
            across = u + bend
            number = np.round(across / self.spacing)
            deeper = self.uneven * self.width * rng.random(256, dtype=np.float32)[number.astype(np.intp) & 255]
            strand = thread(across - number * self.spacing, self.width / 2) - deeper
            np.maximum(total, strand - np.float32(rng.uniform(0, self.width) * (bundle > 0)), out=total)
        return total


class Grains(Layer):
    """A heap of ellipsoids in random places, directions and depths, seen from above: rice, millet, crumbs.

    Their outlines add up to `packing` of the surface; the envelope of the upper halves is what can be touched.
    """

    kind: Literal["grains"] = "grains"
    length: Length
    width: Length
    thickness: Length
    """They lie on their flat side."""
    packing: Annotated[float, Field(gt=0, le=4)] = 2.0
    depth: Annotated[float, Field(ge=0, le=1)] = 0.4
    """How far they lie below the topmost, as a share of the thickness."""

    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """Places are stratified, one a cell, so that no two heaps differ much in density."""
        reach = grid.span + 2 * max(self.length, self.width)
        cells = max(1, round(reach * math.sqrt(self.packing / (math.pi / 4 * self.length * self.width))))
        corners = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 2)
        places = ((corners + rng.random(corners.shape)) / cells - 0.5) * reach
        turns, drops = rng.uniform(0, math.pi, len(places)), rng.random(len(places)) * self.depth * self.thickness
        total = np.full((grid.side, grid.side), -(self.depth + 0.5) * self.thickness, np.float32)
        x, radius = grid.line(), max(self.length, self.width) / 2
        for (px, py), turn, drop in zip(places, turns, drops, strict=True):
            columns, rows = window(px, radius, grid), window(py, radius, grid)
            dx, dy = x[None, columns] - np.float32(px), x[rows, None] - np.float32(py)
            cosine, sine = np.float32(math.cos(turn)), np.float32(math.sin(turn))
            a = (dx * cosine + dy * sine) * np.float32(2 / self.length)
            b = (dy * cosine - dx * sine) * np.float32(2 / self.width)
            rest = 1 - a * a - b * b
            upper = np.float32(self.thickness / 2) * (np.sqrt(np.maximum(rest, 0)) - 1) - np.float32(drop)
            seen = total[rows, columns]
            np.maximum(seen, np.where(rest > 0, upper, -np.inf), out=seen)
        return total


AnyLayer = Annotated[
    Rough | Creases | Domes | Ridges | Plates | Weave | Strands | Grains | Digits, Field(discriminator="kind")
]
