"""Pressing an object into the gel with the cheapest model that is good enough for the scene.

Three models ("tiers"): springs (`winkler`), and elastic bodies whose pressures are solved for, the gel a layer bonded
to its window (`layer`) or a half-space (`half_space`). The elastic ones work in two scales: a grid of `cells` across
the patch carries the body and its larger bumps. Of what is finer, a pressure p flattens the share
erf(sqrt(2) p / (E* h')), where h' is the root mean square slope of that fine part (the contact share of a rough
surface: Persson 2001, J. Chem. Phys. 115).

The gel is uniform, so a contact depends on the force and not on its place or rotation. A body is therefore pressed at a
few forces once a video, and frames are interpolated between these.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.special import erf

from pipeline.scenes.elastic.kernels import Gel, Kernel, half_space_table, layer_table, make_kernel
from pipeline.scenes.elastic.solver import solve
from pipeline.scenes.elastic.winkler import hang_skin, press_springs, series
from pipeline.scenes.grid import Heights

Tier = Literal["winkler", "layer", "half_space"]
GEL = Gel()
FORCES = 6
"""Forces at which a body is pressed. Between them slopes were off by .13 on average at a tenth of the largest force, by
.03 or less from a fifth (15 objects of the catalogue); with eight levels by .09 and .05."""
VISIBLE_SLOPE = 0.01
"""What a slope must be for its light to stand out of the camera's noise."""
RESIDUAL = 0.03
"""Tolerance of the solver, times cells across: on finer grids slopes are a smaller part of the energy. Measured on the
catalogue's objects at 32 to 256 cells, slopes are then within 2 % of those of a finished solution."""


@dataclass(frozen=True)
class Method:
    """A tier, and how finely it is solved."""

    tier: Tier
    cells: int = 0
    """Across the patch; 0 is every pixel."""

    def __str__(self) -> str:
        return f"{self.tier}, {self.cells} cells" if self.cells else self.tier


LADDER = tuple(Method("layer", cells) for cells in (32, 64, 128, 256))
"""What `auto` chooses from, besides springs."""


@dataclass(frozen=True)
class Imprint:
    """A body pressed at forces from 0 to the largest; all in the body's own frame."""

    skins: npt.NDArray[np.float32]
    """How far the gel's skin is pushed in, in mm, (FORCES + 1) x side x side; the first is 0."""
    radii: npt.NDArray[np.float64]
    """Radius of the circle with the contact's area, in mm."""
    force: float
    """The largest force, in N."""
    method: Method
    error: float | None
    """The method's relative error in slopes as `auto` estimates it; None where the method was given."""
    residual: float
    """The largest residual of the solver."""

    def at(self, force: float) -> Heights:
        """The skin under a force, between the two nearest that were pressed."""
        place, share = self._between(force)
        lower: Heights = self.skins[place]
        if share == 0:
            return lower
        skin: Heights = cv2.addWeighted(lower, 1 - share, self.skins[place + 1], share, 0)
        return skin

    def radius(self, force: float) -> float:
        """The contact's radius under a force, in mm."""
        place, share = self._between(force)
        return float(self.radii[place] * (1 - share) + (self.radii[place + 1] * share if share else 0))

    def _between(self, force: float) -> tuple[int, float]:
        # A ball sinks as F^(2/3) (Hertz): in that measure skins change almost evenly.
        measure = FORCES * min(1.0, force / self.force) ** (2 / 3) if self.force > 0 and force > 0 else 0.0
        place = min(int(measure), FORCES)
        return place, measure - place


def press(
    heights: Heights,
    force: float,
    modulus: float,
    pitch: float,
    method: Method | None = None,
    *,
    tolerance: float = 0.25,
) -> Imprint:
    """Press a body with forces from 0 to `force` N.

    Heights are side x side in mm, towards the gel; the pitch is in mm a pixel, the object's reduced modulus in MPa.
    Without a method, the cheapest is taken whose estimated error is below the tolerance: the relative error of the
    skin's slopes, which are what the light shows.
    """
    forces = force * (np.arange(1, FORCES + 1) / FORCES) ** 1.5
    error = None
    if method is None:
        method, error, last = choose(heights, force, modulus, pitch, tolerance)
        pressed = [press_by(method, heights, forces[:-1], modulus, pitch), last]
    else:
        pressed = [press_by(method, heights, forces, modulus, pitch)]
    flat = np.zeros((1, *heights.shape), np.float32)
    return Imprint(
        skins=np.concatenate([flat, *(p.skins for p in pressed)]),
        radii=np.sqrt(np.concatenate([[0.0], *(p.areas for p in pressed)]) / math.pi),
        force=force,
        method=method,
        error=error,
        residual=max(p.residual for p in pressed),
    )


def choose(
    heights: Heights, force: float, modulus: float, pitch: float, tolerance: float
) -> tuple[Method, float, Pressed]:
    """The cheapest method whose slopes under the largest force are near enough to those of the next finer one.

    A grid's error is estimated as its distance to the next finer grid, which exceeds the true error as long as
    grids converge; springs are compared with the finest grid solved so far. The search stops at the first method
    whose estimate is within the tolerance. The finest grid has no reference: it gets half the error of the one before.
    Returns the method, its error as estimated, and the body by it under the largest force.
    """
    side, top, winkler = heights.shape[0], np.array([force]), Method("winkler")
    # A layer's influence is smooth on cells of half its thickness only.
    ladder = [m for m in LADDER if side * pitch <= m.cells * GEL.thickness / 2]
    rungs = [m for m in ladder if m.cells < side]
    if len(rungs) < max(2, len(ladder)):  # A single rung has no finer one to estimate its error.
        rungs.append(Method("layer"))
    springs, coarse = (press_by(method, heights, top, modulus, pitch) for method in (winkler, rungs[0]))
    error = 0.0
    for method, finer in itertools.pairwise(rungs):
        fine = press_by(finer, heights, top, modulus, pitch)
        for candidate, pressed in ((winkler, springs), (method, coarse)):
            error = slope_error(pressed.skins[0], fine.skins[0], pitch)
            if error <= tolerance:
                return candidate, error, pressed
        coarse = fine
    return rungs[-1], error / 2, coarse


def slope_error(skin: Heights, reference: Heights, pitch: float) -> float:
    """Root mean square error of the slopes over the reference's, or over what is visible where that is more."""
    off = _rms_slope(skin - reference, pitch)
    return off / max(_rms_slope(reference, pitch), VISIBLE_SLOPE)


@dataclass(frozen=True)
class Pressed:
    """A body under some forces."""

    skins: npt.NDArray[np.float32]
    """As in `Imprint`."""
    areas: npt.NDArray[np.float64]
    """Areas of the contacts, in mm^2."""
    residual: float


def press_by(
    method: Method, heights: Heights, forces: npt.NDArray[np.float64], modulus: float, pitch: float
) -> Pressed:
    """Press a body with each of the forces (N) by one method; further arguments as for `press`."""
    side = heights.shape[0]
    if method.tier == "winkler":
        gap = heights.max() - heights
        overlaps = [press_springs(gap, force, modulus, pitch, GEL) for force in forces.tolist()]
        skins = [hang_skin(overlap, modulus, pitch, GEL) for overlap in overlaps]
        return Pressed(np.stack(skins), np.array([np.count_nonzero(o) * pitch**2 for o in overlaps]), 0.0)
    cells = min(method.cells or side, side)
    coarse = cv2.resize(heights, (cells, cells), interpolation=cv2.INTER_AREA)
    cell = side * pitch / cells
    gel, unit = _compliances(cells, cell, method.tier)
    # Compliances of gel and object add.
    solution = solve(coarse.max() - coarse, forces, gel.plus(unit, 1 / modulus), cell, tolerance=RESIDUAL / cells)
    sinks = gel.sink(solution.pressure)
    areas, residual = np.count_nonzero(solution.pressure > 0, axis=(1, 2)) * cell**2, float(solution.residual.max())
    if cells == side:
        return Pressed(sinks, areas, residual)
    fine = heights - _enlarge(coarse, side)
    together = series(GEL.modulus, modulus)
    # erf's argument for each MPa of pressure, and the gel's part of the fine relief once it is pressed flat.
    per_pressure = math.sqrt(2) / (together * max(_rms_slope(fine, pitch), 1e-9))
    gels_part = np.float32(together / GEL.modulus) * fine
    skins = [
        _enlarge(sink, side) + gels_part * erf(np.float32(per_pressure) * _enlarge(pressure, side))
        for sink, pressure in zip(sinks, solution.pressure, strict=True)
    ]
    return Pressed(np.stack(skins), areas, residual)


@lru_cache(maxsize=16)
def _compliances(cells: int, pitch: float, tier: Tier) -> tuple[Kernel, Kernel]:
    """The kernels of the gel, and of a half-space of modulus 1."""
    shape = (cells, cells)
    gel = layer_table(shape, pitch, GEL) if tier == "layer" else half_space_table(shape, pitch, GEL.modulus)
    return make_kernel(gel, np.float32), make_kernel(half_space_table(shape, pitch, 1.0), np.float32)


def _enlarge(field: Heights, side: int) -> Heights:
    """Enlarge by cubic splines, as light shows slopes: linear interpolation makes jumps, OpenCV's cubic one ripples."""
    spline = _spline(field.shape[0], side)
    return np.asarray(spline @ field @ spline.T)


@lru_cache(maxsize=8)
def _spline(cells: int, side: int) -> Heights:
    """The matrix from values at the centres of cells to values at the centres of pixels: side x cells."""
    centres, pixels = (np.arange(cells) + 0.5) / cells, (np.arange(side) + 0.5) / side
    return np.asarray(CubicSpline(centres, np.eye(cells))(pixels), dtype=np.float32)


def _rms_slope(field: Heights, pitch: float) -> float:
    """Root mean square slope over the middle of the patch, which is what the camera sees."""
    margin = field.shape[0] // 4
    middle = field[margin:-margin, margin:-margin]
    squares = float(np.mean(np.diff(middle, axis=0) ** 2) + np.mean(np.diff(middle, axis=1) ** 2))
    return math.sqrt(squares) / pitch
