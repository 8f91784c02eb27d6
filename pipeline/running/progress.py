"""How far a long run is: a bar at a terminal, lines in a log file."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
QUICK = 5.0
"""Least seconds between two lines of progress in a log file, so that quick work writes none."""


class LogLines:
    """Writes progress to a log file: a line each tenth of `total` units, with the seconds that are left.

    Args:
        after: Units that were done before, in a run that is resumed.
    """

    def __init__(self, label: str, total: int, unit: str, after: int = 0) -> None:
        self.label, self.total, self.unit, self.after = label, total, unit, after
        self._started = self._said = time.monotonic()
        self._tenth = 10 * after // max(1, total)

    def reached(self, done: int, note: str = "") -> None:
        """So many units are done now."""
        now, tenth = time.monotonic(), 10 * done // max(1, self.total)
        if tenth > self._tenth and now - self._said >= QUICK:
            self._tenth, self._said = tenth, now
            left = (now - self._started) * (self.total - done) / max(1, done - self.after)
            said = ", ".join(filter(None, (f"{self.unit} {done} of {self.total}", note, f"{left:.0f} s left")))
            print(f"{self.label}: {said}", file=sys.stderr, flush=True)


@contextmanager
def progress(total: int, label: str, unit: str) -> Iterator[Callable[[], object]]:
    """Give a function to be called once a finished unit: a bar with what is left at a terminal, else `LogLines`.

    What has no label shows nothing.
    """
    if not label:
        yield lambda: None
    elif sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(total=total, desc=label, unit=unit) as bar:
            yield bar.update
    else:
        lines, done = LogLines(label, total, unit), iter(range(1, total + 1))
        yield lambda: lines.reached(next(done, total))


def track(items: Collection[T], label: str, unit: str) -> Iterator[T]:
    """Go through items and show how far it is."""
    with progress(len(items), label, unit) as advance:
        for item in items:
            yield item
            advance()


def quiet_libraries() -> None:
    """Silence what a person can do nothing about: libraries' bars for loaded files, and their own deprecations."""
    os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    if "transformers" in sys.modules:
        # The variables are read when it is imported, which may have been before.
        from transformers.utils import logging

        logging.set_verbosity_error()
        logging.disable_progress_bar()
    libraries = r"(torch|transformers|peft|accelerate|open_clip|timm)\b"
    warnings.filterwarnings("ignore", category=FutureWarning, module=libraries)
