"""The surface that is pressed: a body with layers of relief, as heights in mm on a square grid.

Heights point towards the sensor. Everything is given in mm and sampled at a pitch (mm a pixel), so that a scene is
the same at every resolution, down to what the grid can carry. The body's highest point is the origin, its long side
lies along y.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from pipeline.core.records import Record
from pipeline.scenes.grid import Grid, Heights, Length
from pipeline.scenes.relief import AnyLayer

IMAGE_MM = (18.6, 14.3)
"""Width and height of what the camera sees (data sheet of the GelSight Mini)."""
Radius = Annotated[float, Field(gt=0, le=1e4, allow_inf_nan=False)]
"""In mm."""


class Flat(Record):
    """A plane."""

    kind: Literal["flat"] = "flat"

    def sample(self, grid: Grid) -> Heights:
        """0 everywhere."""
        return np.zeros((grid.side, grid.side), np.float32)


class Round(Record):
    """The paraboloid -x^2 / 2 Rx - y^2 / 2 Ry that touches a body of these radii (Johnson, Contact Mechanics, 4.1)."""

    kind: Literal["round"] = "round"
    radii: tuple[Radius, Radius]
    """Across and along: equal for a ball, a long second one for a barrel."""

    def sample(self, grid: Grid) -> Heights:
        """Heights below the origin, in mm."""
        x, y = grid.axes()
        return -x * x / np.float32(2 * self.radii[0]) - y * y / np.float32(2 * self.radii[1])


class Bar(Record):
    """A long bar, flat on top, whose edges fall off as -(|x| - width / 2 + edge)^2 / 2 edge: tape, strap, ruler."""

    kind: Literal["bar"] = "bar"
    width: Length
    edge: Length
    """Radius of the edges."""

    @model_validator(mode="after")
    def _has_a_top(self) -> Bar:
        if 2 * self.edge > self.width:
            raise ValueError("edge is more than half the width, so that nothing of it is flat")
        return self

    def sample(self, grid: Grid) -> Heights:
        """Heights below the flat top, in mm."""
        x, y = grid.axes()
        beyond: Heights = np.maximum(np.abs(x) - np.float32(self.width / 2 - self.edge), 0)
        below: Heights = -beyond * beyond / np.float32(2 * self.edge) + 0 * y
        return below


class Wedge(Record):
    """A rounded edge, the hyperbola -s (sqrt(x^2 + s^2 R^2) - s R): radius R on top, slope s far from it."""

    kind: Literal["wedge"] = "wedge"
    slope: Annotated[float, Field(gt=0, le=2)]
    tip: Length
    """Radius of the edge, in mm."""

    def sample(self, grid: Grid) -> Heights:
        """Heights below the edge, in mm."""
        x, y = grid.axes()
        bend = np.float32(self.slope * self.tip)
        fall: Heights = np.float32(-self.slope) * (np.hypot(x, bend) - bend) + 0 * y
        return fall


Body = Annotated[Flat | Round | Bar | Wedge, Field(discriminator="kind")]


def heights(body: Body, relief: Sequence[AnyLayer], side: int, pitch: float, rng: np.random.Generator) -> Heights:
    """A random patch around a body's highest point, with layers of relief that add up.

    Side x side pixels of `pitch` mm; heights are in mm and point towards the sensor.
    """
    grid = Grid(side, pitch)
    total = body.sample(grid)
    for layer in relief:
        total = total + layer.sample(grid, rng)
    return total.astype(np.float32, copy=False)
