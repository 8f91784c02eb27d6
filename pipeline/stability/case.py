"""What a hard case is, the number formats, and the bounds that more than one part uses.

No bound is fitted to an error that was measured. Each is one of three kinds, and says which:

- roundings: an operation count times the format's unit roundoff (Higham 2002, Accuracy and Stability of Numerical
  Algorithms, chapters 2 to 4), where a sum of n terms in any order is off by at most n u times the sum of their sizes;
- condition: the same times how much a computation magnifies relative changes, measured in float64 (`condition`);
- use: an error that changes nothing for whoever reads the result, such as half a step of 8 bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import torch

Floats = npt.NDArray[np.float64]
Compute = Callable[["Dtype"], npt.ArrayLike]
"""A result, computed in a number format."""


class Dtype(StrEnum):
    """A number format, widest first; the last is that of pictures."""

    FLOAT64 = "float64"
    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"
    FLOAT16 = "float16"
    """Where a CUDA device is, on that: the CPU computes in it slowly and the pipeline never does."""
    UINT8 = "uint8"

    @property
    def roundoff(self) -> float:
        """The unit roundoff u: half the distance from 1 to the next number (IEEE 754; bfloat16 has 8 binary digits)."""
        return {"float64": 2.0**-53, "float32": 2.0**-24, "bfloat16": 2.0**-8, "float16": 2.0**-11}[self.value]

    @property
    def smallest(self) -> float:
        """The smallest positive number; what lies below is off by half of it at most."""
        return {"float64": 2.0**-1074, "float32": 2.0**-149, "bfloat16": 2.0**-133, "float16": 2.0**-24}[self.value]

    @property
    def short(self) -> bool:
        """Whether it has 16 bits: torch then multiplies and adds in float32 and rounds the sum once."""
        return self in (Dtype.BFLOAT16, Dtype.FLOAT16)

    @property
    def torch(self) -> torch.dtype:
        """The torch dtype of that name."""
        import torch

        found: torch.dtype = getattr(torch, self.value)
        return found

    @property
    def numpy(self) -> np.dtype[np.floating]:
        """The NumPy dtype of that name; there is none of bfloat16."""
        return np.dtype(self.value)

    @property
    def device(self) -> str:
        """Where cases in this format are computed."""
        return "cuda" if self is Dtype.FLOAT16 else "cpu"


DOUBLE = (Dtype.FLOAT64,)
SOLVED = (Dtype.FLOAT64, Dtype.FLOAT32)
"""Formats of the contact solver, and of heads and losses, which are float32 whatever the model's format is."""
NETWORKS = (Dtype.FLOAT64, Dtype.FLOAT32, Dtype.BFLOAT16, Dtype.FLOAT16)
BYTES = (Dtype.UINT8,)


@dataclass(frozen=True)
class Bound:
    """How far a result may be off."""

    of: Callable[[Dtype], float]
    """Relative to the largest exact number, or absolute where all of these are 0."""
    why: str
    """Where it comes from."""


@dataclass(frozen=True)
class Case:
    """One hard case of a part.

    Without `exact` the float64 result is what the other formats are held against, and float64 itself is judged by
    whether it is finite. Without `bound` there is nothing to hold against, and finiteness is all that is judged.
    """

    part: str
    name: str
    dtypes: tuple[Dtype, ...]
    compute: Compute
    bound: Bound | None = None
    exact: Callable[[], npt.ArrayLike] | None = None
    """The result from another computation, in float64 or better."""


def summing(terms: int, dtype: Dtype) -> float:
    """Relative error of a sum of rounded products, in any order: n u (Higham 2002, section 3.1).

    Sums of 16-bit products are taken in float32 and rounded once; weights and inputs were rounded before: 3 u + n u32.
    """
    return 3 * dtype.roundoff + terms * Dtype.FLOAT32.roundoff if dtype.short else (terms + 2) * dtype.roundoff


def exactly(why: str) -> Bound:
    """Nothing may differ."""
    return Bound(lambda _: 0.0, why)


def within(tolerance: float, why: str) -> Bound:
    """A tolerance of use, the same in every format."""
    return Bound(lambda _: tolerance, why)
