"""What every DVC stage does around its one library call: parameters, lock, clear errors, a line at each end, cost."""

from __future__ import annotations

import errno
import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.config import Params
from pipeline.errors import UserError
from pipeline.io import write_json
from pipeline.params import load_params
from pipeline.records import Measurement
from pipeline.runtime import limit_threads, quiet_libraries

DATA = Path("data")
RUNS = Path("runs")


@dataclass
class Stage:
    """A running stage. `metrics` are written beside its cost when it ends well."""

    name: str
    params: Params
    started: float = field(default_factory=time.time)
    """Seconds since 1970."""
    metrics: dict[str, float] = field(default_factory=dict)

    def finish_training(self, history: Sequence[Measurement]) -> None:
        """Put the last value of each curve among the metrics.

        In a distributed training only the main process goes on from here: the others have nothing to write.
        """
        if not _main_process():
            sys.exit(0)
        self.metrics |= {m.name: m.value for m in history}
        self.metrics["steps"] = max((m.step for m in history), default=0)


@contextmanager
def stage(name: str, key: str | None = None) -> Iterator[Stage]:
    """Run the body as the DVC stage `name` (with `@key` in a matrix).

    A UserError, a full disk or want of memory ends the process with one line and status 1. Metrics, time and memory go
    to runs/, which is nobody's input, so that results stay identical from run to run; tracking shows them.
    """
    started = time.time()
    full = f"{name}@{key}" if key else name
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    quiet_libraries()
    try:
        with _alone(full):
            running = Stage(full, load_params(), started)
            limit_threads(running.params.runtime.threads)
            if _main_process():
                print(f"{full}: starts ({running.params.report_name})", flush=True)
            yield running
            if _main_process():
                _write_run(running, started)
                said = ", ".join(f"{k} {v:g}" for k, v in list(running.metrics.items())[:4])
                print(f"{full}: done in {time.time() - started:.1f} s{': ' if said else ''}{said}", flush=True)
    except UserError as error:
        sys.exit(f"{full}: {error}")
    except MemoryError:
        sys.exit(f"{full}: out of memory; lower the batch sizes in params.yaml")
    except OSError as error:
        if error.errno == errno.ENOSPC:
            sys.exit(f"{full}: no space left on the disk ({error.filename or 'data/'}); free some and run again")
        raise


@contextmanager
def _alone(name: str) -> Iterator[None]:
    """One process a stage: a killed `dvc` leaves its stage running, and the next must not write beside it."""
    if not _main_process():
        yield
        return
    (RUNS / "locks").mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(RUNS / "locks" / f"{name}.lock", timeout=0):
            yield
    except Timeout:
        raise UserError("is still running in another process; wait for it or stop it") from None


def _main_process() -> bool:
    return os.environ.get("RANK", "0") == "0"


def _write_run(running: Stage, started: float) -> None:
    import psutil

    process = psutil.Process()
    peak = 0.0
    if sys.platform != "win32":
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
    write_json(
        RUNS / f"{running.name}.json",
        {
            "started": datetime.fromtimestamp(started, UTC).isoformat(timespec="milliseconds"),
            "ended": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "startup_seconds": round(started - process.create_time(), 3),
            "seconds": round(time.time() - started, 3),
            "peak_memory_mb": round(peak, 1),
            "metrics": running.metrics,
        },
    )
