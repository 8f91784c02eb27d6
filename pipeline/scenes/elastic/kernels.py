"""How far a surface sinks under a pressure: half-space, and a layer bonded to a rigid base.

Both are influence tables: the sink of every pixel's centre under a unit pressure on one pixel. A pressure is convolved
with its table in a domain of twice the size, so that nothing wraps around (Liu, Wang & Liu 2000, Wear 243, DC-FFT).
Lengths in mm, pressures and moduli in MPa.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.fft  # NumPy's is several times slower at float32.
from scipy.interpolate import CubicSpline
from scipy.special import j0

Array = npt.NDArray[np.floating[Any]]
"""float32 or float64."""
Table = npt.NDArray[np.float64]
DECAY = 22.0
"""Beyond this wave number (times thickness) a layer answers as a half-space does, to 1e-16."""
SERIES = 0.1
"""Below this wave number the layer's response is taken from its power series, as sinh(2k) - 2k cancels."""


@dataclass(frozen=True)
class Gel:
    """The sensor's elastomer, bonded to its window."""

    modulus: float = 0.25
    """Reduced modulus E / (1 - nu^2), in MPa."""
    poisson: float = 0.48
    """Silicone hardly changes its volume; .5 is none at all."""
    thickness: float = 2.5
    """In mm."""

    @property
    def shear_modulus(self) -> float:
        """G = E / 2 (1 + nu), in MPa."""
        return self.modulus * (1 - self.poisson) / 2


def layer_response(wave: npt.ArrayLike, poisson: float) -> npt.NDArray[np.float64]:
    """How much softer than a half-space a bonded layer is to a wave of pressure: S, from 0 to about 1.

    The surface sinks by 2 S(q t) / (E* q) under a pressure of wave number q >= 0, where with Poisson's ratio nu
    S(k) = [(3 - 4 nu) sinh 2k - 2k] / [(3 - 4 nu) cosh 2k + 2k^2 + 5 - 12 nu + 8 nu^2]
    (Bentall & Johnson 1968, Int. J. Mech. Sci. 10; Johnson, Contact Mechanics, 5.8). S -> 1 for waves that are short
    against the layer, and -> k (1 - 2 nu) / (2 (1 - nu)^2), springs, for long ones.
    """
    k = np.asarray(wave, dtype=np.float64)
    a = 3 - 4 * poisson
    rest = 5 - 12 * poisson + 8 * poisson**2
    # Multiplied by exp(-2k), so that nothing overflows.
    e2, e4 = np.exp(-2 * k), np.exp(-4 * k)
    over = a * (1 - e4) / 2 - 2 * k * e2
    small = np.minimum(k, SERIES)
    # (3 - 4 nu)(sinh 2k - 2k) + 4k (1 - 2 nu), term by term.
    cubic = a * (8 * small**3 / 6 + 32 * small**5 / 120 + 128 * small**7 / 5040 + 512 * small**9 / 362880)
    over = np.where(k < SERIES, (cubic + 4 * small * (1 - 2 * poisson)) * e2, over)
    under = a * (1 + e4) / 2 + (2 * k * k + rest) * e2
    return over / under


def half_space_table(shape: tuple[int, int], pitch: float, modulus: float) -> Table:
    """The influence table of a half-space of this reduced modulus, at offsets of 0 to rows - 1 and 0 to columns - 1.

    Love 1929, Phil. Trans. A 228; Johnson, Contact Mechanics, 3.25: with f(x, y) = x asinh(y/|x|) + y asinh(x/|y|)
    and pixels of side 1, the sink is [f(x+1/2, y+1/2) - f(x+1/2, y-1/2) - f(x-1/2, y+1/2) + f(x-1/2, y-1/2)] / pi.
    """
    y = np.arange(shape[0] + 1)[:, None] - 0.5
    x = np.arange(shape[1] + 1)[None, :] - 0.5
    corner = x * np.arcsinh(y / np.abs(x)) + y * np.arcsinh(x / np.abs(y))
    return np.asarray(np.diff(np.diff(corner, axis=0), axis=1) / np.pi * pitch / modulus)


def layer_table(shape: tuple[int, int], pitch: float, gel: Gel) -> Table:
    """The influence table of a bonded layer, at the same offsets: the half-space's and a correction.

    The correction is the inverse Hankel transform of 2 (S - 1) / (E* q). It is smooth on the scale of the thickness, so
    that it is computed along a radius by Gauss's rule and interpolated; a pixel's pressure is spread over the pixel by
    exp(-q^2 h^2 / 24).

    Raises:
        ValueError: if the gel is thinner than two pixels, where the correction is not smooth.
    """
    if gel.thickness < 2 * pitch:
        raise ValueError(f"a gel of {gel.thickness:g} mm needs pixels of at most half that, not {pitch:g} mm")
    farthest = np.hypot(shape[0], shape[1]) * pitch / gel.thickness
    nodes, weights = np.polynomial.legendre.leggauss(int(64 + farthest * DECAY))
    k, weights = (nodes + 1) * DECAY / 2, weights * DECAY / 2
    change = (layer_response(k, gel.poisson) - 1) * np.exp(-((k * pitch / gel.thickness) ** 2) / 24)
    radii = np.linspace(0, farthest, int(32 + 24 * farthest))
    along = j0(radii[:, None] * k[None, :]) @ (weights * change)
    place = np.hypot(np.arange(shape[0])[:, None], np.arange(shape[1])[None, :]) * pitch / gel.thickness
    correction = CubicSpline(radii, along)(place) * pitch**2 / (np.pi * gel.modulus * gel.thickness)
    return np.asarray(half_space_table(shape, pitch, gel.modulus) + correction)


@dataclass(frozen=True)
class Kernel:
    """An influence table, ready for convolution; compliances of bodies in series add up."""

    spectrum: Array
    """Transform of the table in the doubled domain."""
    waves: Array
    """Transform of the table for a periodic field."""
    shape: tuple[int, int]
    """Rows and columns of the fields."""

    def sink(self, pressure: Array) -> Array:
        """How far the surface sinks, in mm, under a pressure in MPa; ... x rows x columns."""
        rows, columns = self.shape
        double = _quick((2 * rows, 2 * columns))
        sunk: Array = scipy.fft.irfft2(scipy.fft.rfft2(pressure, double) * self.spectrum, double)[..., :rows, :columns]
        return sunk

    def press(self, sink: Array) -> Array:
        """The approximate pressure that makes the surface sink by `sink` mm; exact for periodic fields."""
        rows, columns = self.shape
        own = _quick(self.shape)
        # A layer that keeps its volume does not sink under even pressure at all.
        waves = np.clip(self.waves, float(self.waves.max()) * 1e-4, None)
        pressed: Array = scipy.fft.irfft2(scipy.fft.rfft2(sink, own) / waves, own)[..., :rows, :columns]
        return pressed

    def plus(self, other: Kernel, share: float) -> Kernel:
        """With `share` times the other's compliance added."""
        return Kernel(self.spectrum + other.spectrum * share, self.waves + other.waves * share, self.shape)


def make_kernel(table: Table, dtype: npt.DTypeLike = np.float64) -> Kernel:
    """Prepare a table of offsets for fields of its size, in this number format."""
    rows, columns = table.shape
    transforms: list[Array] = []
    for domain in (_quick((2 * rows, 2 * columns)), _quick((rows, columns))):
        # The table, continued evenly to the left and upwards, and 0 where it ends: its transform is real.
        row, column = (np.minimum(np.arange(n), n - np.arange(n)) for n in domain)
        known = (row < rows)[:, None] & (column < columns)[None, :]
        whole = table[np.minimum(row, rows - 1)[:, None], np.minimum(column, columns - 1)[None, :]]
        transforms.append(np.fft.rfft2(np.where(known, whole, 0.0)).real.astype(dtype))
    spectrum, waves = transforms
    return Kernel(spectrum, waves, (rows, columns))


def _quick(shape: tuple[int, int]) -> tuple[int, int]:
    """The next size that is quick to transform."""
    rows, columns = (scipy.fft.next_fast_len(n, real=True) for n in shape)
    return rows, columns
