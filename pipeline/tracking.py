"""MLflow: being rewritten; this keeps the trainings' interface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from transformers import TrainerCallback

    from pipeline.stage import Stage


@contextmanager
def live(run: Stage) -> Iterator[Sequence[TrainerCallback]]:
    """Callbacks that log a training while it runs."""
    yield ()
