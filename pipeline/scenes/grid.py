"""The grid that bodies and their relief are sampled on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field

Heights = npt.NDArray[np.float32]
Length = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
"""In mm."""


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
