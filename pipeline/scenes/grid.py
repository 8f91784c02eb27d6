"""The grid that relief is sampled on, what every layer of relief has, and the formulas that layers share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
import scipy.fft
from pydantic import Field

from pipeline.core.records import Record

Heights = npt.NDArray[np.float32]
Length = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
"""In mm."""
Relief = Annotated[float, Field(ge=-5, le=5, allow_inf_nan=False)]
"""Height in mm; below 0 for pits, grooves and engraving."""
Share = Annotated[float, Field(ge=0, le=1)]
Degrees = Annotated[float, Field(ge=-360, le=360)]


@dataclass(frozen=True)
class Grid:
    """A square of side x side pixels around the object's own origin."""

    side: int
    pitch: float
    """In mm a pixel."""

    @property
    def span(self) -> float:
        """Length of the side in mm."""
        return self.side * self.pitch

    def line(self) -> Heights:
        """Where the pixels of a row or column lie, in mm."""
        return ((np.arange(self.side) - (self.side - 1) / 2) * self.pitch).astype(np.float32)

    def axes(self, degrees: float = 0.0) -> tuple[Heights, Heights]:
        """Coordinates in mm along axes turned by `degrees` from the object's."""
        x = self.line()[None, :]
        y, cosine, sine = x.T, np.float32(math.cos(math.radians(degrees))), np.float32(math.sin(math.radians(degrees)))
        return x * cosine + y * sine, y * cosine - x * sine


class Layer(Record, ABC):
    """One layer of relief."""

    @abstractmethod
    def sample(self, grid: Grid, rng: np.random.Generator) -> Heights:
        """A random patch of the layer in mm, side x side."""


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
