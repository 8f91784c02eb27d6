"""Which pressure a rigid rough body makes when it is pressed on an elastic one: conjugate gradients with p >= 0.

Polonsky & Keer 1999, Wear 231: minimise the elastic energy over all pressures that are nowhere negative and add up to
the force. Directions are preconditioned by the kernel's periodic inverse, as short waves of the gap ask for much more
pressure than long ones (Bugnicourt et al. 2018, Tribol. Int. 121). Many contacts are solved at once; those that are
finished drop out. The residual is the share of the work that is not done yet, sum p (g - min g) / sum p u with the gap
g and the sink u: it bounds how far the energy is from its minimum (the duality gap of the quadratic programme), and is
0 where p g = 0 and g >= 0 everywhere.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.scenes.elastic.kernels import Array, Kernel

Values = npt.NDArray[np.float64]


class NotConverged(UserWarning):
    """The solver stopped before the residual was as small as asked for."""


@dataclass(frozen=True)
class Solution:
    """Contacts in equilibrium; the leading axis numbers them."""

    pressure: Array
    """In MPa, contacts x rows x columns."""
    approach: Values
    """How far the bodies come together after first touch, in mm."""
    residual: Values
    """Share of the work that is not done yet."""
    converged: npt.NDArray[np.bool_]


def solve(
    gap: Array,
    forces: npt.ArrayLike,
    kernel: Kernel,
    pitch: float,
    *,
    tolerance: float = 1e-5,
    iterations: int = 500,
) -> Solution:
    """Press bodies with forces; warns (`NotConverged`) where the residual stays above the tolerance.

    Args:
        gap: Distance of the undeformed surfaces at first touch in mm, contacts x rows x columns or one for all.
        forces: In N, one a contact; 0 is no contact.
        kernel: Of object and gel together, for fields like `gap`.
        pitch: In mm a pixel.
        tolerance: Largest residual. This is a share of energy, so errors of pressures are about its square root.
        iterations: At most.

    Raises:
        ValueError: for a force that is negative or not finite, or a gap that is not finite.
    """
    loads = np.atleast_1d(np.asarray(forces, dtype=np.float64))
    if not (np.isfinite(loads).all() and (loads >= 0).all()):
        raise ValueError(f"forces must be finite and not negative, not {loads}")
    if not np.isfinite(gap).all():
        raise ValueError("the gap has values that are not finite")
    shape = (len(loads), *gap.shape[-2:])
    # Lengths and pressures as multiples of the mean pressure, so that float32 holds any force.
    mean = np.where(loads > 0, loads, 1.0) / (pitch * pitch * shape[1] * shape[2])
    scale = mean[:, None, None].astype(gap.dtype)
    pressure = np.zeros_like(np.broadcast_to(gap, shape))
    approach, residual = np.zeros(len(loads)), np.zeros(len(loads))

    # Letters as in Polonsky & Keer: pressure p, sink u, gap g, direction of descent t; `before` is gap times descent of
    # the step before.
    active = np.flatnonzero(loads > 0)
    apart = np.broadcast_to(gap, shape)[active] / scale[active]
    p, t = np.ones_like(apart), np.zeros_like(apart)
    before = np.ones_like(apart[:, :1, :1])
    for step in range(1, iterations + 1):
        u = kernel.sink(p)
        pressed = p > 0
        g = apart + u
        # The approach is the mean over the contact; the residual is measured from the lowest gap, as g >= 0 must hold.
        near = _mean(g, pressed)
        undone = _sum(p * (g - np.min(g, axis=(-2, -1), keepdims=True)))
        total = _sum(p * u)
        undone = undone / np.where(total > 0, total, 1)
        g = g - near

        done = ~(undone[:, 0, 0] > tolerance) | (step == iterations)
        if done.any() or not len(active):
            out, rest = active[done], ~done
            pressure[out] = p[done] * scale[out]
            approach[out] = near[done, 0, 0] * mean[out]
            residual[out] = undone[done, 0, 0]
            active = active[rest]
            if not len(active):
                break
            apart, p, t, g, before, pressed = (field[rest] for field in (apart, p, t, g, before, pressed))

        # Where bodies overlap without pressure, there is contact from now on, and the direction starts afresh.
        touching = pressed | (g < 0)
        grown = np.any(touching & ~pressed, axis=(-2, -1), keepdims=True)
        inside = np.where(touching, g, 0)
        z = np.where(touching, kernel.press(inside), 0)
        z = np.where(touching, z - _mean(z, touching), 0)
        descent = _sum(inside * z)
        t = np.where(touching, z + np.where(grown, 0, descent / before) * t, 0)
        under = _sum(kernel.sink(t) * t)
        length = _sum(inside * t) / np.where(under > 0, under, 1)
        p = np.clip(p - length * t, 0, None)
        average = np.mean(p, axis=(-2, -1), keepdims=True)
        # Scaled to a mean of 1; even where nothing is left of it.
        p = np.where(average > 0, p / np.where(average > 0, average, 1), 1)
        before = np.where(descent == 0, np.inf, descent)

    converged = residual <= tolerance
    if not converged.all():
        worst = int(np.argmax(np.nan_to_num(residual, nan=np.inf)))
        warnings.warn(
            f"the contact under {loads[worst]:g} N has not converged within {iterations} iterations: residual "
            f"{residual[worst]:.2g}, asked for {tolerance:.2g}",
            NotConverged,
            stacklevel=2,
        )
    return Solution(pressure, approach, residual, converged)


def _sum(field: Array) -> Array:
    """Over the field, for each contact."""
    total: Array = np.sum(field, axis=(-2, -1), keepdims=True)
    return total


def _mean(field: Array, where: npt.NDArray[np.bool_]) -> Array:
    """Over a part of the field, for each contact."""
    count = np.sum(where, axis=(-2, -1), keepdims=True, dtype=field.dtype)
    mean: Array = _sum(np.where(where, field, 0)) / count
    return mean
