"""What stands out of a body: layers of relief, each a few numbers in mm and a formula, sampled on any grid.

A layer is a frozen record with the key `kind`, so that a line of YAML is a layer. Its `sample` gives one random patch
(side x side, mm, pointing towards the sensor) from a generator; layers of a surface add up. Statistics do not depend on
the grid's pitch, down to what the grid can carry. First come textures that cover everything, then bumps that stand
alone.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import cv2
import numpy as np
import scipy.fft
from pydantic import Field

from pipeline.core.records import Record
from pipeline.scenes.grid import Grid, Heights, Length

Relief = Annotated[float, Field(ge=-5, le=5, allow_inf_nan=False)]
"""Height in mm; below 0 for pits, grooves and engraving."""
Share = Annotated[float, Field(ge=0, le=1)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
DRAWN_MM = 0.06
"""Digits are drawn at least this fine, whatever the grid."""


def cap(radius: Heights, edge: float) -> Heights:
    """1 inside, 0 from radius 1 on, a raised cosine over the outer `edge`."""
    flank: Heights = np.cos(np.clip((radius - (1 - edge)) / edge, 0, 1) * np.float32(math.pi / 2)) ** 2
    return flank


def thread(offset: Heights, radius: float) -> Heights:
    """The upper half of a cylinder, 0 on top; beside it as deep as its middle."""
    upper: Heights = np.sqrt(np.maximum(np.float32(radius * radius) - offset * offset, 0)) - np.float32(radius)
    return upper


def shifted(grid: Grid, angle: float, across: float, along: float, rng: np.random.Generator) -> tuple[Heights, Heights]:
    """Coordinates across and along the body, turned by `angle` and shifted by a random part of a period."""
    u, v = grid.axes(angle)
    return u + np.float32(rng.uniform(0, across)), v + np.float32(rng.uniform(0, along))


def waves(grid: Grid, degrees: float = 0.0, stretch: float = 1.0) -> Heights:
    """Wave numbers 1 / wavelength in 1/mm of a half spectrum, lengthened `stretch` times along a direction."""
    side = scipy.fft.next_fast_len(grid.side, real=True)
    qx = np.fft.rfftfreq(side, grid.pitch).astype(np.float32)[None, :]
    qy = np.fft.fftfreq(side, grid.pitch).astype(np.float32)[:, None]
    cosine, sine = np.float32(math.cos(math.radians(degrees))), np.float32(math.sin(math.radians(degrees)))
    return np.hypot(qx * cosine + qy * sine, (qy * cosine - qx * sine) * np.float32(stretch))


def field(grid: Grid, amplitude: Heights, rng: np.random.Generator) -> Heights:
    """A Gaussian random field with these amplitudes, mean 0 and variance 1 over the patch (0 where all are 0)."""
    side = amplitude.shape[0]
    noise = scipy.fft.rfft2(rng.standard_normal((side, side), dtype=np.float32))
    values: Heights = scipy.fft.irfft2(noise * amplitude, s=(side, side))[: grid.side, : grid.side]
    values = values - values.mean()
    spread = float(values.std())
    return values / np.float32(spread) if spread > 0 else values


def window(centre: float, radius: float, grid: Grid) -> slice:
    """The pixels of a row or column within `radius` mm of a place; may be empty."""
    middle = (grid.side - 1) / 2
    first = max(0, math.ceil((centre - radius) / grid.pitch + middle))
    return slice(first, max(first, math.floor((centre + radius) / grid.pitch + middle) + 1))


class Rough(Record):
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


class Creases(Record):
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


class Weave(Record):
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


class Strands(Record):
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


class Grains(Record):
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


class Domes(Record):
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
    """By up to which share a bump is lower than `height`."""

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


class Ridges(Record):
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


class Plates(Record):
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


class Digits(Record):
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


AnyLayer = Annotated[
    Rough | Creases | Domes | Ridges | Plates | Weave | Strands | Grains | Digits, Field(discriminator="kind")
]
