"""Runs the hard cases and judges them.

Results depend on the machine in one way: roundings do, since matrix products and transforms add up in the order that
the processor's widest instructions suggest. One thread and two digits of every error keep the bytes equal from run to
run on one machine; on another processor the digits may differ, the bounds do not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import torch

from pipeline.errors import UserError
from pipeline.stability import (
    decoding,
    encoder,
    frames,
    heads,
    language,
    language_ways,
    loss,
    pictures,
    scenes,
    statistics,
)
from pipeline.stability.case import Case, Dtype, Floats
from pipeline.stability.record import Judgement, StabilityRow


def all_cases(clip: Path, llama: Path) -> list[Case]:
    """The cases of every part, in the chain's order.

    Args:
        clip: Folder of the CLIP that encoders stand on; the committed stand-in.
        llama: Folder of the language model; likewise.
    """
    return [
        *scenes.cases(),
        *pictures.cases(),
        *frames.cases(),
        *encoder.cases(clip),
        *heads.cases(),
        *decoding.cases(),
        *language.cases(llama),
        *language_ways.cases(llama),
        *loss.cases(llama),
        *statistics.cases(),
    ]


def judge_all(cases: Sequence[Case]) -> list[StabilityRow]:
    """One row a case and number format, in order; formats that the machine cannot run are left out."""
    with _one_thread():
        return [row for case in cases for row in judge(case)]


def judge(case: Case) -> list[StabilityRow]:
    """The rows of one case."""
    return [_judge(case, dtype) for dtype in case.dtypes if available(dtype)]


def available(dtype: Dtype) -> bool:
    """Whether cases in this format can be run here."""
    return dtype.device == "cpu" or torch.cuda.is_available()


def stop_on_red(rows: Sequence[StabilityRow], path: Path) -> None:
    """Raise UserError with the first red row, and how many there are."""
    red = [row for row in rows if row.verdict is Judgement.FAILED]
    if red:
        first = red[0]
        measured = f"error {first.error:g}, at most {first.bound:g}" if first.finite else "not finite"
        more = f" (and {len(red) - 1} more)" if len(red) > 1 else ""
        raise UserError(
            f"{first.part}: {first.case} in {first.dtype}: {measured}{more}; all rows stand in {path}, the cases and "
            f"what their bounds rest on in pipeline/stability/"
        )


def summary(rows: Sequence[StabilityRow]) -> dict[str, float]:
    """How many rows there are, and how many of them are red, as flat metrics."""
    return {"rows": len(rows), "red": sum(row.verdict is Judgement.FAILED for row in rows)}


def _judge(case: Case, dtype: Dtype) -> StabilityRow:
    found = _floats(case, dtype)
    bound = None if case.bound is None or (case.exact is None and dtype is Dtype.FLOAT64) else case.bound.of(dtype)
    finite, error = bool(np.isfinite(found).all()), None
    if finite and bound is not None:
        exact = _exact(case)
        size = float(np.abs(exact).max(initial=0.0))
        error = float(np.abs(found - exact).max(initial=0.0)) / (size or 1.0)
    right = finite and (error is None or bound is None or error <= bound)
    return StabilityRow(
        part=case.part,
        case=case.name,
        dtype=dtype.value,
        finite=finite,
        error=_two_digits(error),
        bound=_two_digits(bound),
        verdict=Judgement.PASSED if right else Judgement.FAILED,
    )


def _floats(case: Case, dtype: Dtype) -> Floats:
    # A case goes over the edge on purpose: what comes out says so, no warning is needed beside it.
    with np.errstate(all="ignore"):
        return np.atleast_1d(np.asarray(case.compute(dtype), dtype=np.float64))


@cache
def _exact(case: Case) -> Floats:
    """What the case is held against; computed once for all its formats."""
    if case.exact is None:
        return _floats(case, Dtype.FLOAT64)
    return np.atleast_1d(np.asarray(case.exact(), dtype=np.float64))


def _two_digits(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.1e}")


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
