"""The thread that holds a model, the questions on their way through it, and what it counts."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from pipeline.core.errors import UserError

logger = logging.getLogger(__name__)


class Failed(Exception):
    """The model failed in a way that is nobody's input; the log has it."""

    def __init__(self) -> None:
        super().__init__("the model failed at this request; the server's log says why")


@dataclass
class Metrics:
    """What happened since the start, in Prometheus' text format."""

    requests: Counter[int] = field(default_factory=Counter)
    """By status."""
    answers: int = 0
    seconds: float = 0.0
    """That the model took for them all."""
    videos: int = 0

    @property
    def mean(self) -> float:
        """Seconds an answer; 1 before the first."""
        return self.seconds / self.answers if self.answers else 1.0

    def text(self, taken: int, places: int) -> str:
        """All of it; `taken` of `places` are in use."""
        lines = [
            "# TYPE octopi_requests_total counter",
            *(f'octopi_requests_total{{status="{s}"}} {n}' for s, n in sorted(self.requests.items())),
            "# TYPE octopi_videos_total counter",
            f"octopi_videos_total {self.videos}",
            "# TYPE octopi_requests_waiting gauge",
            f"octopi_requests_waiting {taken}",
            "# TYPE octopi_requests_places gauge",
            f"octopi_requests_places {places}",
            "# TYPE octopi_answer_seconds summary",
            f"octopi_answer_seconds_sum {self.seconds:.6f}",
            f"octopi_answer_seconds_count {self.answers}",
        ]
        return "\n".join(lines) + "\n"


class Job:
    """A question on its way through the worker; its pieces arrive in the loop that made it."""

    def __init__(self, ask: Callable[[], Iterator[str]], done: Callable[[], None]) -> None:
        self.ask, self.done = ask, done
        self.left = threading.Event()
        """Set when nobody waits for the answer any more."""
        self._loop = asyncio.get_running_loop()
        self._pieces: asyncio.Queue[str | Exception | None] = asyncio.Queue()

    def put(self, piece: str | Exception | None) -> None:
        """From the worker: a piece, what went wrong, or None behind the last one."""
        with suppress(RuntimeError):  # The loop is closed: nobody waits.
            self._loop.call_soon_threadsafe(self._pieces.put_nowait, piece)

    async def pieces(self) -> AsyncIterator[str]:
        """The answer, as it is made."""
        while (piece := await self._pieces.get()) is not None:
            if isinstance(piece, Exception):
                raise piece
            yield piece


class Worker:
    """The thread that holds the model."""

    def __init__(self, metrics: Metrics) -> None:
        self.metrics = metrics
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="octopi-model", daemon=True)
        self._thread.start()

    def add(self, job: Job) -> None:
        """Queue a job; who calls this keeps count."""
        self._jobs.put(job)

    def stop(self) -> None:
        """Wait until all that is queued is answered."""
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            started = time.monotonic()
            end: Exception | None = None
            try:
                for piece in () if job.left.is_set() else job.ask():
                    job.put(piece)
                    if job.left.is_set():
                        break
                else:
                    self.metrics.answers += 1
                    self.metrics.seconds += time.monotonic() - started
            except UserError as error:
                end = error
            except Exception:
                logger.exception("the model failed")
                end = Failed()
            # First the place and the files, so that who has the answer finds the place free.
            with suppress(Exception):
                job.done()
            job.put(end)
