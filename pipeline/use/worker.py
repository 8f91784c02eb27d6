"""The thread that holds a model, and the questions on their way through it."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
from collections.abc import AsyncGenerator, Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pipeline.core.errors import UserError

logger = logging.getLogger(__name__)

TOGETHER = 32
"""Most questions that are begun at once; the model divides them by its own batch size."""


class Failed(Exception):
    """The model failed in a way that is nobody's input; the log has it."""

    def __init__(self) -> None:
        super().__init__("the model failed at this request; the server's log says why")


@dataclass(frozen=True)
class Job:
    """A question on its way; the arguments of `Worker.answer`, and where its pieces go."""

    ask: Callable[[], Iterable[Any]]
    done: Callable[[], object]
    put: Callable[[Any], None]
    left: threading.Event

    def end(self, error: Exception | None = None) -> None:
        """Give the place and the files back first, so that who has the answer finds the place free."""
        if error is not None and not isinstance(error, UserError):
            logger.error("the model failed", exc_info=error)
            error = Failed()
        with suppress(Exception):
            self.done()
        self.put(error)


class Worker:
    """The thread that holds the model: it answers what waits in one batch where the model can, else one by one.

    What comes meanwhile waits for the next batch.

    Attributes:
        answers: How many were given in full.
        seconds: That the model took for them all.
    """

    def __init__(self) -> None:
        self.answers, self.seconds = 0, 0.0
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        # A daemon, so that a second Ctrl-C does not wait for the answer.
        self._thread = threading.Thread(target=self._work, name="octopi-model", daemon=True)
        self._thread.start()

    def answer(
        self, ask: Callable[[], Iterable[Any]], done: Callable[[], object] = lambda: None
    ) -> AsyncGenerator[Any]:
        """Queue a question, and yield the pieces of its answer as they are made; who closes this gives it up.

        Args:
            ask: Called in the thread, where its pieces are made, too. Pieces with a method `together`, as `Stream` has
                it, are made in one batch with those of others.
            done: Called in the thread behind the last piece, also where the answer failed or was given up.

        Raises:
            UserError: as `ask` raises it.
            Failed: where it raises anything else.
        """
        loop, left = asyncio.get_running_loop(), threading.Event()
        pieces: asyncio.Queue[Any] = asyncio.Queue()

        def put(piece: Any) -> None:
            with suppress(RuntimeError):  # The loop is closed: nobody waits.
                loop.call_soon_threadsafe(pieces.put_nowait, piece)

        self._jobs.put(Job(ask, done, put, left))
        return _pieces(pieces, left)

    def stop(self) -> None:
        """Wait until all that is queued is answered."""
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        waiting: Job | None
        while (waiting := self._jobs.get()) is not None:
            jobs: list[Job | None] = [waiting]
            while len(jobs) < TOGETHER and jobs[-1] is not None and not self._jobs.empty():
                jobs.append(self._jobs.get())
            started = time.monotonic()
            self._answer([job for job in jobs if job is not None])
            self.seconds += time.monotonic() - started
            if jobs[-1] is None:
                return

    def _answer(self, jobs: Sequence[Job]) -> None:
        """Answer these: what cannot be in a batch by itself, then the others in one."""
        batch: list[tuple[Job, Any]] = []
        for job in jobs:
            try:
                pieces = () if job.left.is_set() else job.ask()
                if hasattr(pieces, "together"):
                    batch.append((job, pieces))
                    continue
                for piece in pieces:
                    job.put(piece)
                    if job.left.is_set():
                        break
            except Exception as error:
                job.end(error)
            else:
                self.answers += not job.left.is_set()
                job.end()
        if not batch:
            return
        left: set[int] = set()
        open_ = dict(enumerate(job for job, _ in batch))
        try:
            for place, piece in batch[0][1].together([pieces for _, pieces in batch], left):
                if piece is not None and place in open_:
                    open_[place].put(piece)
                elif piece is None and place in open_:
                    self.answers += 1
                    open_.pop(place).end()
                for gone in [p for p, job in open_.items() if job.left.is_set()]:
                    left.add(gone)
                    open_.pop(gone).end()
                if not open_:
                    return
        except Exception as error:
            for job in open_.values():
                job.end(error)


async def _pieces(pieces: asyncio.Queue[Any], left: threading.Event) -> AsyncGenerator[Any]:
    try:
        while (piece := await pieces.get()) is not None:
            if isinstance(piece, Exception):
                raise piece
            yield piece
    finally:
        left.set()
