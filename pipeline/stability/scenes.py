"""Contact at its edges: any force and modulus, flats, needles, fields that touch everywhere.

The solver runs in the format of its gap, float64 or float32, and what is made of it for the camera in float32.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterator
from functools import partial

import numpy as np

from pipeline.scenes.contact import Method, press
from pipeline.scenes.elastic.kernels import Gel, Kernel, half_space_table, layer_table, make_kernel
from pipeline.scenes.elastic.solver import NotConverged, Solution, solve
from pipeline.stability.case import SOLVED, Bound, Case, Dtype, Floats, summing

PART = "scenes"
FORCES = (0.0, 1e-12, 1e-6, 1.0, 1e6, 1e12)
"""In N."""
RATIOS = (1e-4, 1e-2, 1.0, 1e2, 1e4)
"""Of the object's modulus to the gel's."""
PRESSES = (0.1, 10.0)
"""Forces at each ratio."""
TOLERANCE = 1e-4
"""Of the solver's residual."""
SIDE, PITCH, RADIUS = 32, 0.2, 10.0
FLOAT32 = (Dtype.FLOAT32,)
METHODS = (Method("winkler"), Method("layer", 32), Method("layer"), Method("half_space", 32), None)
"""None chooses by itself."""


def cases() -> list[Case]:
    """The solver, and imprints by every method."""
    return [*_contacts(), *_imprints()]


# Contact


def ball(pitch: float = PITCH, side: int = SIDE, radius: float = RADIUS) -> Floats:
    """The gap under a ball in its parabolic approximation, side x side, in mm."""
    axis = (np.arange(side) - (side - 1) / 2) * pitch
    return np.asarray((axis[None] ** 2 + axis[:, None] ** 2) / (2 * radius))


def half_space(dtype: Dtype, side: int = SIDE, pitch: float = PITCH, modulus: float = 1.0) -> Kernel:
    """The kernel of a half-space of some modulus in MPa."""
    return make_kernel(half_space_table((side, side), pitch, modulus), np.zeros((side, side), dtype.numpy))


def contact_under(force: float, dtype: Dtype) -> Solution:
    """A ball under a force in N."""
    return solve(ball().astype(dtype.numpy), force, half_space(dtype), PITCH, tolerance=TOLERANCE)


def contact_of(ratio: float, dtype: Dtype) -> Solution:
    """A ball of `ratio` times the gel's modulus on it, under each of `PRESSES`."""
    gap, gel = ball(0.3).astype(dtype.numpy), Gel()
    table = layer_table(gap.shape, 0.3, gel) + half_space_table(gap.shape, 0.3, gel.modulus * ratio)
    return solve(gap, list(PRESSES), make_kernel(table, gap), 0.3, tolerance=TOLERANCE)


def needle(dtype: Dtype) -> Solution:
    """A single pixel stands out by 50 mm."""
    gap = np.full((SIDE + 1, SIDE + 1), 50.0, dtype.numpy)
    gap[SIDE // 2, SIDE // 2] = 0
    return solve(gap, 1e-3, half_space(dtype, SIDE + 1), PITCH)


def carried(found: Solution, pitch: float) -> Floats:
    """The force that a contact's pressures add up to, in N; NaN where the solver did not get there."""
    force = np.asarray(found.pressure, dtype=np.float64).sum(axis=(1, 2)) * pitch**2
    return np.where(found.converged, force, np.nan)


def _contacts() -> Iterator[Case]:
    sums = Bound(lambda d: summing(SIDE * SIDE, d), "roundings: the pressures' mean is a sum over all pixels")
    for force in FORCES:
        yield Case(
            PART,
            f"ball under {force:g} N: force carried",
            SOLVED,
            partial(_force, force),
            sums,
            partial(np.full, 1, force),
        )
    for ratio in RATIOS:
        name = f"modulus {ratio:g} of the gel's: force carried"
        yield Case(PART, name, SOLVED, partial(_forces, ratio), sums, lambda: PRESSES)
    for name, gap, force in (
        ("flat on flat", np.zeros((SIDE, SIDE)), 2.0),
        ("contact everywhere", ball(radius=500.0), 1e3),
    ):
        exact = partial(np.full, 1, force)
        yield Case(PART, f"{name}: force carried", SOLVED, partial(_pressed, gap, force), sums, exact)
    yield Case(
        PART,
        "needle: approach",
        SOLVED,
        lambda d: needle(d).approach,
        Bound(_transforms, "roundings: two transforms, log2 N steps each (Higham 2002, theorem 24.2)"),
        # Love's formula for one pixel.
        lambda: 1e-3 / PITCH**2 * half_space_table((1, 1), PITCH, 1.0)[0],
    )
    rough = ball(0.15) + 0.02 * np.random.default_rng(1).random((SIDE, SIDE))
    yield Case(
        PART,
        "rough ball: energy",
        SOLVED,
        partial(_energy, rough - rough.min()),
        Bound(
            lambda d: 2 * (TOLERANCE + 2 * summing(SIDE * SIDE, d)),
            "the residual bounds how far the energy is from its minimum: each of two solutions is off by twice the "
            "tolerance at most, since an energy is at least half of pressure times sink; the residual's two sums are "
            "rounded",
        ),
    )


def _force(force: float, dtype: Dtype) -> Floats:
    return carried(contact_under(force, dtype), PITCH)


def _forces(ratio: float, dtype: Dtype) -> Floats:
    return carried(contact_of(ratio, dtype), 0.3)


def _pressed(gap: Floats, force: float, dtype: Dtype) -> Floats:
    found = solve(gap.astype(dtype.numpy), force, half_space(dtype), PITCH, tolerance=TOLERANCE)
    return carried(found, PITCH)


def _transforms(dtype: Dtype) -> float:
    """Of a convolution in the doubled domain: 2 log2 N steps, each with some 4 roundings, for the sum of N squares."""
    pixels = (2 * (SIDE + 1)) ** 2
    return 8 * math.log2(pixels) * math.sqrt(pixels) * dtype.roundoff


def _energy(gap: Floats, dtype: Dtype) -> Floats:
    """Half of pressure times sink, and pressure times gap, in N mm, of three forces."""
    found = solve(gap.astype(dtype.numpy), [0.3, 2.0, 30.0], half_space(dtype, pitch=0.15), 0.15, tolerance=TOLERANCE)
    pressure = np.asarray(found.pressure, dtype=np.float64)
    sink = half_space(Dtype.FLOAT64, pitch=0.15).sink(pressure)
    energy = (pressure * (sink / 2 + gap)).sum(axis=(1, 2)) * 0.15**2
    return np.where(found.converged, energy, np.nan)


# Imprints: what the camera would see of a body, by every method


def bodies(side: int = 61) -> dict[str, Floats]:
    """Heights in mm of a ball, smooth and rough, a flat, and a needle of one pixel, side x side."""
    spike = np.full((side, side), -50.0)
    spike[side // 2, side // 2] = 0
    smooth = -ball(30 / side, side, 25.0)
    rough = smooth + 0.02 * np.random.default_rng(0).standard_normal((side, side))
    return {"ball": smooth, "rough ball": rough, "flat": np.zeros((side, side)), "needle": spike}


def _imprints() -> Iterator[Case]:
    for method, (body, heights) in itertools.product(METHODS, bodies().items()):
        yield Case(
            PART,
            f"imprint of a {body}, {method or 'auto'}: forces to 1e6 N, moduli to 1e4",
            FLOAT32,
            partial(_imprint, heights.astype(np.float32), method),
        )


def _imprint(heights: np.ndarray, method: Method | None, _: Dtype) -> Floats:
    with warnings.catch_warnings():
        # What has not converged is rendered with its residual; here it must be finite all the same.
        warnings.simplefilter("ignore", NotConverged)
        found = [
            press(heights, force, 0.25 * ratio, 30 / len(heights), method)
            for force, ratio in ((0.0, 1.0), (1e-9, 1.0), (1e6, 1.0), (8.0, 1e-4), (8.0, 1e4))
        ]
    return np.concatenate([np.r_[imprint.skins.ravel(), imprint.radii] for imprint in found])
