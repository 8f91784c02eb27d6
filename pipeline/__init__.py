"""Teach a language model the sense of touch: the system of Octopi (RSS 2024) as a DVC pipeline."""

import gc
import importlib
import os
import sys
from typing import Any

# Read by OpenMP when torch loads. Its default lets waiting threads spin: on a busy machine, answering 57 questions on
# two threads then took 203 s in place of 9 s. A little spinning pays where threads wait for microseconds, as between
# the layers of one token: 104 answers took 86 s without it, and 65 s with this much.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

# A start imports a million objects that all stay. Looking for garbage among them every 700 took a fifth of the start of
# a training stage (8.7 s against 7.1 s, median of four in turn).
gc.set_threshold(100_000, 50, 1000)


def _in_a_line(kind: Any, error: Any, trace: Any) -> None:
    """Ctrl-C in a stage, which imports for seconds before it begins, is a line; all else is shown as ever."""
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)
        return
    if os.environ.get("RANK", "0") == "0":
        name = "@".join(filter(None, (os.path.basename(sys.argv[0])[:-3], "-".join(sys.argv[1:]))))
        print(f"{name}: stopped; finished stages stay, and `octopi repro` goes on from there", file=sys.stderr)
    raise SystemExit(130)


if os.path.basename(os.path.dirname(os.path.abspath(sys.argv[0]))) == "stages":
    sys.excepthook = _in_a_line


def __getattr__(name: str) -> Any:
    """`from pipeline import Octopi` loads torch only where it is asked for."""
    if name == "Octopi":
        # Named, not imported: the stages import this file, and do not depend on how a model is used.
        return importlib.import_module("pipeline.use.model").Octopi
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
