"""Work on many files at once: in processes of this machine, or on a cluster of Ray's."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

from pipeline.config import Backend
from pipeline.config.params import check_code
from pipeline.core.runtime import PORTABLE, DeviceName, cores
from pipeline.running.errors import UserError
from pipeline.running.progress import progress, track

J = TypeVar("J")
M = TypeVar("M")
R = TypeVar("R")

_chosen: Backend = "processes"


def use_backend(name: Backend) -> None:
    """Make `run_parallel` use this backend from now on (`runtime.parallel`); UserError where its package is missing."""
    global _chosen
    check_backend(name)
    _chosen = name


def check_backend(name: Backend) -> None:
    """Raise UserError where the backend's package is not installed."""
    if name == "ray" and find_spec("ray") is None:
        raise UserError("runtime.parallel: ray takes the package ray: pip install -e '.[ray]'")


def end_with_parent(parent: int, grace: float = 0.0) -> None:
    """End this process within a second of its parent's death, after `grace` seconds in which it may end by itself."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        time.sleep(grace)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def run_parallel(
    work: Callable[[J], R], jobs: Sequence[J], label: str, unit: str, *, device: bool = False
) -> Iterator[R]:
    """Apply `work` to every job on the chosen backend; yield results in the order of the jobs.

    An error or an interrupt ends what runs.

    Args:
        device: Whether a job takes a GPU of a cluster that has any.

    Raises:
        UserError: if a process dies, which a decoder can do to a broken file, or a cluster is not there.
    """
    if not jobs:
        return
    with progress(len(jobs), label, unit) as advance:
        for result in _on_ray(work, jobs, label, device) if _chosen == "ray" else _in_processes(work, jobs, label):
            yield result
            advance()


def run_with(
    model: M, source: Callable[[], M] | None, work: Callable[[M, J], R], jobs: Sequence[J], label: str, unit: str
) -> Iterator[R]:
    """Apply `work` to a model and every job; yield results in the order of the jobs.

    In this process jobs run one after another, since this machine has one device. On a cluster each worker has a model
    of its own, loaded once, and takes a GPU of its own where there are any.

    Args:
        model: Used in this process.
        source: Loads the same model in a worker; None: all is done here. It is the key of a worker's cache, so it is
            hashable, and another one in each run: a worker may outlive a stage.
        work: A function of a module, for workers to import.
    """
    if _chosen == "processes" or source is None:
        for job in track(jobs, label, unit):
            yield work(model, job)
    else:
        yield from run_parallel(lambda job: work(_loaded(source), job), jobs, label, unit, device=True)


def device_here(name: DeviceName) -> DeviceName:
    """The device of this process; on a cluster the CPU, since the workers compute on the others."""
    return name if _chosen == "processes" else "cpu"


@lru_cache(maxsize=1)
def _loaded(source: Callable[[], Any]) -> Any:
    """A worker's model, which it keeps from job to job."""
    return source()


def _in_processes(work: Callable[[J], R], jobs: Sequence[J], label: str) -> Iterator[R]:
    """In a process for each core, each with a pipe of its own, which closes where it dies.

    Linux forks, since a fresh interpreter costs more than many whole videos; elsewhere the platform's way is used, and
    the caller's script needs a main guard.
    """
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else None)
    workers, idle = list[Any](), SimpleQueue[Connection]()

    def ask(job: J) -> R:
        """In a thread: have an idle worker do a job."""
        pipe = idle.get()
        try:
            pipe.send(job)
            reply: tuple[R, Exception | None] = pipe.recv()
        except (EOFError, OSError):
            raise _died(label, job) from None
        finally:
            idle.put(pipe)  # A dead worker's, too, or who waits for one would wait for ever.
        if reply[1] is not None:
            raise reply[1]
        return reply[0]

    # Workers inherit the blocked SIGINT, so that on Ctrl-C only this process reacts, and ends them.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    # Its threads begin behind the forks, which would inherit what they lock.
    with ThreadPoolExecutor(cores()) as threads:
        try:
            for _ in range(min(cores(), len(jobs))):
                here, there = context.Pipe()
                workers.append(context.Process(target=_serve, args=(os.getpid(), work, there), daemon=True))
                workers[-1].start()
                there.close()
                idle.put(here)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            yield from threads.map(ask, jobs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            for worker in workers:
                worker.kill()
                worker.join()


def _serve(parent: int, work: Callable[[J], R], pipe: Connection) -> None:
    """What a worker does until it is ended: take a job, and hand over its result or error.

    Each core has a worker, so that threads of BLAS would wait for each other: with them, two cores took 1.6 times as
    long to invent 54 objects, and 1.5 times to make 27 scenes.
    """
    from threadpoolctl import threadpool_limits  # Here, since most stages and commands start no worker.

    threadpool_limits(1, user_api="blas")
    end_with_parent(parent)
    while True:
        job = pipe.recv()
        try:
            pipe.send((work(job), None))
        except Exception as error:
            error.add_note(traceback.format_exc())  # Which does not travel.
            pipe.send((None, error))


def _on_ray(work: Callable[[J], R], jobs: Sequence[J], label: str, device: bool) -> Iterator[R]:
    """On all workers of the cluster that `RAY_ADDRESS` names, else of one on this machine.

    Workers see the project under this machine's path. What has not begun ends with this process.
    """
    import ray

    try:
        # A cluster's workers were started by others; they compute with the same kernels.
        kernels = {"env_vars": {name: os.environ[name] for name in PORTABLE if name in os.environ}}
        ray.init(ignore_reinit_error=True, log_to_driver=False, logging_level="ERROR", runtime_env=kernels)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"runtime.parallel: ray has no cluster ({reason}); start it, or unset its address") from None
    # Ray hides GPUs from work that does not ask for them.
    gpus = 1 if device and ray.cluster_resources().get("GPU") else 0
    folder = os.getcwd()

    def there(job: J) -> R:
        """In a worker: go to the project's folder, since jobs name files relative to it."""
        os.chdir(folder)
        check_code(Path())
        return work(job)

    waiting = deque(map(ray.remote(num_gpus=gpus)(there).remote, jobs))
    for job in jobs:
        try:
            yield ray.get(waiting.popleft())
        except ray.exceptions.RayTaskError as error:
            raise error.cause from None
        except ray.exceptions.RayError:  # Ray's own message about a lost worker fills a page.
            raise _died(label, job) from None


def _died(label: str, job: object) -> UserError:
    return UserError(f"{label}: a process died at {job}; was it killed for want of memory? Run again")
