"""Number formats, and the check that every hard case goes through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt
import pytest
import torch

from pipeline.core.records import Record

Floats = npt.NDArray[np.float64]


class Format(StrEnum):
    """A number format; `uint8` is that of pictures."""

    FLOAT64 = "float64"
    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"
    FLOAT16 = "float16"
    UINT8 = "uint8"

    @property
    def torch(self) -> torch.dtype:
        found: torch.dtype = getattr(torch, self.value)
        return found

    @property
    def roundoff(self) -> float:
        """The unit roundoff u: half the distance from 1 to the next number."""
        return torch.finfo(self.torch).eps / 2

    @property
    def short(self) -> bool:
        """Whether it has 16 bits: torch then multiplies and adds in float32 and rounds the sum once."""
        return self in (Format.BFLOAT16, Format.FLOAT16)

    @property
    def device(self) -> str:
        """Where it is tried: float16 on CUDA alone, as the CPU is slow in it and the pipeline never uses it there."""
        return "cuda" if self is Format.FLOAT16 else "cpu"


FLOAT64, FLOAT32, BFLOAT16, FLOAT16, UINT8 = Format
SOLVED = (FLOAT64, FLOAT32)
"""Formats of the contact solver, and of heads and losses, which are float32 whatever the model's format is."""
NETWORKS = (FLOAT64, FLOAT32, BFLOAT16, FLOAT16)


def formats(*some: Format) -> pytest.MarkDecorator:
    """Run a test in each of these formats, as its argument `fmt`; float16 is skipped without a CUDA device."""
    lacking = pytest.mark.skipif(not torch.cuda.is_available(), reason="float16 is tried on CUDA")
    return pytest.mark.parametrize("fmt", [pytest.param(f, marks=lacking if f is FLOAT16 else (), id=f) for f in some])


class Row(Record):
    """One hard case in one number format, as it stands in the table."""

    part: str
    case: str
    format: str
    finite: bool
    error: str
    """Largest distance to the exact result over the largest exact number, or over 1 where all are 0; two digits."""
    bound: str
    """What the error may be; empty where there is nothing to compare with, so that finiteness alone is judged."""
    verdict: str


@dataclass
class Check:
    """Judges the cases of one part, keeps a row of each, and fails the test of one that is red."""

    part: str
    rows: list[Row]
    float64: dict[str, Floats] = field(default_factory=dict)
    """Results that the other formats are held against, by case."""

    def __call__(
        self,
        case: str,
        fmt: Format,
        compute: Callable[[Format], npt.ArrayLike],
        bound: float | Callable[[Format], float] | None = None,
        exact: npt.ArrayLike | None = None,
    ) -> None:
        """Hold the result in a format against `exact`, of its shape or a single number, within `bound` (see `Row`).

        Without `exact` it is held against float64, whose own row is then judged by finiteness.
        """
        found, wanted = _floats(compute, fmt), None
        if exact is not None:
            wanted = np.asarray(exact, np.float64)
            wanted = wanted if wanted.ndim else np.full(found.shape, wanted)
        elif fmt is FLOAT64:
            self.float64[case] = found
        elif bound is not None:
            if case not in self.float64:
                self.float64[case] = _floats(compute, FLOAT64)
            wanted = self.float64[case]
        limit = error = None
        finite = bool(np.isfinite(found).all())
        if wanted is not None:
            assert found.shape == wanted.shape, case
            limit = bound(fmt) if callable(bound) else bound
            if finite:
                error = float(np.abs(found - wanted).max(initial=0)) / (float(np.abs(wanted).max(initial=0)) or 1)
        right = finite and (error is None or limit is None or error <= limit)
        digits = ["" if x is None else f"{x:.1e}" if x else "0" for x in (error, limit)]
        verdict = {"finite": finite, "error": digits[0], "bound": digits[1], "verdict": "pass" if right else "fail"}
        self.rows.append(Row(part=self.part, case=case, format=fmt.value, **verdict))
        assert right, f"{case} in {fmt}: error {error}, at most {limit}" if finite else f"{case} in {fmt}: not finite"


def _floats(compute: Callable[[Format], npt.ArrayLike], fmt: Format) -> Floats:
    # A case goes over the edge on purpose: what comes out says so, no warning is needed beside it.
    with np.errstate(all="ignore"):
        found = compute(fmt)
    plain = found.detach().double().cpu().numpy() if isinstance(found, torch.Tensor) else found
    return np.atleast_1d(np.asarray(plain, np.float64))
