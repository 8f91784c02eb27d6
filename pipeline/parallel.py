"""Work on many files at once, in processes."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from pipeline.errors import UserError
from pipeline.runtime import cores, progress

J = TypeVar("J")
R = TypeVar("R")


def end_with_parent(parent: int) -> None:
    """End this process within a second of its parent's death.

    A worker waits for jobs for ever, and a pipe that it inherited stays open: `dvc repro | cat` would never end.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def run_parallel(work: Callable[[J], R], jobs: Sequence[J], label: str, unit: str) -> Iterator[R]:
    """Apply `work` to every job in as many processes as there are cores; yield results in the order of the jobs.

    Linux forks, since a fresh interpreter costs more than many whole videos; elsewhere the platform's way is used, and
    the caller's script needs a main guard. An error or an interrupt stops what has not begun.

    Raises:
        UserError: if a process dies, which a decoder can do to a broken file.
    """
    if not jobs:
        return
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else None)
    with ProcessPoolExecutor(
        min(cores(), len(jobs)), mp_context=context, initializer=end_with_parent, initargs=(os.getpid(),)
    ) as pool:
        # A few jobs at a time: handing over each alone costs as much as a tenth of decoding it.
        results: Any = pool.map(work, jobs, chunksize=max(1, min(4, len(jobs) // (8 * cores()))))
        done = 0
        try:
            with progress(len(jobs), label, unit) as advance:
                for result in results:
                    yield result
                    done += 1
                    advance()
        except BrokenProcessPool:
            raise UserError(
                f"{label}: a process died at or soon after {jobs[done]}; was it killed for want of memory? Run again: "
                "what is finished is kept"
            ) from None
        except KeyboardInterrupt:
            # The others wait for what is being worked on; a person who presses Ctrl-C does not.
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
