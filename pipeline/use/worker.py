"""The thread that holds a model, and the questions on their way through it."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import suppress
from typing import Any

from pipeline.core.errors import UserError

logger = logging.getLogger(__name__)


class Failed(Exception):
    """The model failed in a way that is nobody's input; the log has it."""

    def __init__(self) -> None:
        super().__init__("the model failed at this request; the server's log says why")


class Worker:
    """The thread that holds the model: it answers one question after another, in the order in which they came.

    Attributes:
        answers: How many were given in full.
        seconds: That the model took for them all.
    """

    def __init__(self) -> None:
        self.answers, self.seconds = 0, 0.0
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        # A daemon, so that a second Ctrl-C does not wait for the answer.
        self._thread = threading.Thread(target=self._work, name="octopi-model", daemon=True)
        self._thread.start()

    def answer(
        self, ask: Callable[[], Iterable[Any]], done: Callable[[], object] = lambda: None
    ) -> AsyncGenerator[Any]:
        """Queue a question, and yield the pieces of its answer as they are made; who closes this gives it up.

        Args:
            ask: Called in the thread, where its pieces are made, too.
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

        def job() -> None:
            end: Exception | None = None
            try:
                self._ask(ask, put, left)
            except UserError as error:
                end = error
            except Exception:
                logger.exception("the model failed")
                end = Failed()
            # First the place and the files, so that who has the answer finds the place free.
            with suppress(Exception):
                done()
            put(end)

        self._jobs.put(job)
        return _pieces(pieces, left)

    def stop(self) -> None:
        """Wait until all that is queued is answered."""
        self._jobs.put(None)
        self._thread.join()

    def _ask(self, ask: Callable[[], Iterable[Any]], put: Callable[[Any], None], left: threading.Event) -> None:
        if left.is_set():
            return
        started = time.monotonic()
        for piece in ask():
            put(piece)
            if left.is_set():
                return
        self.answers += 1
        self.seconds += time.monotonic() - started

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()


async def _pieces(pieces: asyncio.Queue[Any], left: threading.Event) -> AsyncGenerator[Any]:
    try:
        while (piece := await pieces.get()) is not None:
            if isinstance(piece, Exception):
                raise piece
            yield piece
    finally:
        left.set()
