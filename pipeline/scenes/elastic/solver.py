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
    steps = np.zeros(len(loads), dtype=np.int64)

    active = np.flatnonzero(loads > 0)
    work = _Contacts(np.ones_like(pressure[active]), np.broadcast_to(gap, shape)[active] / scale[active])
    for step in range(1, iterations + 1):
        if not len(active):
            break
        work.measure(kernel)
        undone = work.residual[:, 0, 0]
        done = ~(undone > tolerance) | (step == iterations)
        if done.any():
            out = active[done]
            pressure[out] = work.p[done] * scale[out]
            approach[out] = work.approach[done, 0, 0] * mean[out]
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
        self.p, self.gap = p, gap
        self.t = np.zeros_like(p)
        """Direction of descent."""
        self.g_old = np.ones_like(p[:, :1, :1])
        """Gap times direction before; infinite after the contact has grown, so that the direction starts afresh."""

    def measure(self, kernel: Kernel) -> None:
        """Gaps, approach and residual of the pressures as they are."""
        u = kernel.sink(self.p)
        pressed = self.p > 0
        g = self.gap + u
        # The approach is the mean over the contact; the residual is measured from the lowest gap, as g >= 0 must hold.
        self.approach = self._mean(g, pressed)
        worst = np.min(g, axis=(-2, -1), keepdims=True)
        undone = np.sum(self.p * (g - worst), axis=(-2, -1), keepdims=True)
        total = np.sum(self.p * u, axis=(-2, -1), keepdims=True)
        self.residual = undone / np.where(total > 0, total, 1)
        self.g = g - self.approach
        # Where bodies overlap without pressure, there is contact from now on.
        self.touching = pressed | (self.g < 0)
        self.grown = np.any(self.touching & ~pressed, axis=(-2, -1), keepdims=True)

    def keep(self, which: npt.NDArray[np.int64]) -> None:
        """Go on with these only."""
        for name in ("p", "gap", "t", "g_old", "touching", "grown", "g"):
            setattr(self, name, getattr(self, name)[which])

    def descend(self, kernel: Kernel) -> None:
        """One step along the conjugate direction, cut off at 0."""
        inside = np.where(self.touching, self.g, 0)
        z = np.where(self.touching, kernel.press(inside), 0)
        z = np.where(self.touching, z - self._mean(z, self.touching), 0)
        squares = np.sum(inside * z, axis=(-2, -1), keepdims=True)
        share = np.where(self.grown, 0, squares / self.g_old)
        self.t = np.where(self.touching, z + share * self.t, 0)
        r = kernel.sink(self.t)
        under = np.sum(r * self.t, axis=(-2, -1), keepdims=True)
        length = np.sum(inside * self.t, axis=(-2, -1), keepdims=True) / np.where(under > 0, under, 1)
        p = np.clip(self.p - length * self.t, 0, None)
        mean = np.mean(p, axis=(-2, -1), keepdims=True)
        # Scaled to a mean of 1; even where nothing is left of it.
        self.p = np.where(mean > 0, p / np.where(mean > 0, mean, 1), 1)
        self.g_old = np.where(squares == 0, np.inf, squares)

    def _mean(self, field: Array, where: npt.NDArray[np.bool_]) -> Array:
        """Over the contact."""
        count = np.sum(where, axis=(-2, -1), keepdims=True, dtype=field.dtype)
        mean: Array = np.sum(np.where(where, field, 0), axis=(-2, -1), keepdims=True) / count
        return mean
