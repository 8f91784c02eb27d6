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

from pipeline.scenes.elastic.arrays import Array, array_namespace, back, like
from pipeline.scenes.elastic.kernels import Kernel

Values = npt.NDArray[np.float64]
ITERATIONS = 500


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
    iterations: npt.NDArray[np.int64]
    converged: npt.NDArray[np.bool_]


def solve(
    gap: Array,
    forces: npt.ArrayLike,
    kernel: Kernel,
    pitch: float,
    *,
    tolerance: float = 1e-5,
    iterations: int = ITERATIONS,
) -> Solution:
    """Press bodies with forces; warns (`NotConverged`) where the residual stays above the tolerance.

    Args:
        gap: Distance of the undeformed surfaces at first touch in mm, contacts x rows x columns or one for all.
        forces: In N, one a contact; 0 is no contact.
        kernel: Of object and gel together, for fields like `gap`.
        pitch: In mm a pixel.
        tolerance: Of the residual, an energy: errors of pressures are about its root.
        iterations: At most.

    Raises:
        ValueError: for a force that is negative or not finite, or a gap that is not finite.
    """
    xp = array_namespace(gap)
    loads = np.atleast_1d(np.asarray(forces, dtype=np.float64))
    if not (np.isfinite(loads).all() and (loads >= 0).all()):
        raise ValueError(f"forces must be finite and not negative, not {loads}")
    if not bool(xp.all(xp.isfinite(gap))):
        raise ValueError("the gap has values that are not finite")
    shape = (len(loads), *gap.shape[-2:])
    # Lengths and pressures as multiples of the mean pressure, so that float32 holds any force.
    mean = np.where(loads > 0, loads, 1.0) / (pitch * pitch * shape[1] * shape[2])
    scale = like(mean[:, None, None], gap)
    pressure = xp.zeros_like(xp.broadcast_to(gap, shape))
    approach, residual = np.zeros(len(loads)), np.zeros(len(loads))
    steps = np.zeros(len(loads), dtype=np.int64)

    active = np.flatnonzero(loads > 0)
    work = _Contacts(xp.ones_like(pressure[active]), xp.broadcast_to(gap, shape)[active] / scale[active])
    for step in range(1, iterations + 1):
        if not len(active):
            break
        work.measure(kernel)
        undone = back(work.residual)[:, 0, 0]
        done = ~(undone > tolerance) | (step == iterations)
        if done.any():
            out = active[done]
            pressure[out] = work.p[done] * scale[out]
            approach[out] = back(work.approach)[done, 0, 0] * mean[out]
            residual[out], steps[out] = undone[done], step
            active = active[~done]
            work.keep(np.flatnonzero(~done))
        if len(active):
            work.descend(kernel)
    converged = residual <= tolerance
    if not converged.all():
        worst = int(np.argmax(np.nan_to_num(residual, nan=np.inf)))
        warnings.warn(
            f"the contact under {loads[worst]:g} N has not converged after {steps[worst]} iterations: residual "
            f"{residual[worst]:.2g}, asked for {tolerance:.2g}",
            NotConverged,
            stacklevel=2,
        )
    return Solution(pressure, approach, residual, steps, converged)


class _Contacts:
    """Contacts on their way to equilibrium; letters as in Polonsky & Keer."""

    def __init__(self, p: Array, gap: Array) -> None:
        self.xp = array_namespace(p)
        self.p, self.gap = p, gap
        self.t = self.xp.zeros_like(p)
        """Direction of descent."""
        self.g_old = self.xp.ones_like(p[:, :1, :1])
        """Gap times direction before; infinite after the contact has grown, so that the direction starts afresh."""

    def measure(self, kernel: Kernel) -> None:
        """Gaps, approach and residual of the pressures as they are."""
        xp = self.xp
        u = kernel.sink(self.p)
        pressed = self.p > 0
        g = self.gap + u
        # The approach is the mean over the contact; the residual is measured from the lowest gap, as g >= 0 must hold.
        self.approach = self._mean(g, pressed)
        worst = xp.min(g, axis=(-2, -1), keepdims=True)
        undone = xp.sum(self.p * (g - worst), axis=(-2, -1), keepdims=True)
        total = xp.sum(self.p * u, axis=(-2, -1), keepdims=True)
        self.residual = undone / xp.where(total > 0, total, xp.ones_like(total))
        self.g = g - self.approach
        # Where bodies overlap without pressure, there is contact from now on.
        self.touching = pressed | (self.g < 0)
        self.grown = xp.any(self.touching & ~pressed, axis=(-2, -1), keepdims=True)

    def keep(self, which: npt.NDArray[np.int64]) -> None:
        """Go on with these only."""
        for name in ("p", "gap", "t", "g_old", "touching", "grown", "g"):
            setattr(self, name, getattr(self, name)[which])

    def descend(self, kernel: Kernel) -> None:
        """One step along the conjugate direction, cut off at 0."""
        xp = self.xp
        zero = xp.zeros_like(self.p)
        inside = xp.where(self.touching, self.g, zero)
        z = xp.where(self.touching, kernel.press(inside), zero)
        z = xp.where(self.touching, z - self._mean(z, self.touching), zero)
        squares = xp.sum(inside * z, axis=(-2, -1), keepdims=True)
        share = xp.where(self.grown, xp.zeros_like(squares), squares / self.g_old)
        self.t = xp.where(self.touching, z + share * self.t, zero)
        r = kernel.sink(self.t)
        under = xp.sum(r * self.t, axis=(-2, -1), keepdims=True)
        length = xp.sum(inside * self.t, axis=(-2, -1), keepdims=True) / xp.where(under > 0, under, xp.ones_like(under))
        self.p = _to_mean_one(xp.clip(self.p - length * self.t, 0, None))
        self.g_old = xp.where(squares == 0, xp.full_like(squares, float("inf")), squares)

    def _mean(self, field: Array, where: Array) -> Array:
        """Over the contact."""
        xp = self.xp
        inside = xp.where(where, field, xp.zeros_like(field))
        count = xp.sum(xp.astype(where, field.dtype), axis=(-2, -1), keepdims=True)
        return xp.sum(inside, axis=(-2, -1), keepdims=True) / count


def _to_mean_one(p: Array) -> Array:
    """Scaled to a mean of 1; even where there is none."""
    xp = array_namespace(p)
    mean = xp.mean(p, axis=(-2, -1), keepdims=True)
    some = mean > 0
    return xp.where(some, p / xp.where(some, mean, xp.ones_like(mean)), xp.ones_like(p))
