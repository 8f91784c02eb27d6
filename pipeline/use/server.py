"""What `octopi serve` and `octopi demo` stand on: the thread that holds the model, and where uvicorn listens."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import queue
import socket
import threading
from collections.abc import AsyncGenerator, Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

import uvicorn
from fastapi import FastAPI, Request
from starlette.exceptions import HTTPException

from pipeline.running.errors import UserError

logger = logging.getLogger(__name__)

PAUSE = 0.05
"""Seconds without a new question after which a batch is begun. Clients that were answered together ask again within
moments of each other: without a pause the first of them would be answered alone, and the others wait for that."""


class Failed(Exception):
    """The model failed in a way that is nobody's input; the log has it."""

    def __init__(self) -> None:
        super().__init__("the model failed at this request; the server's log says why")


class Job:
    """A question on its way to the model's thread, and the pieces of its answer on their way back."""

    def __init__(self, ask: Callable[[], Iterable[Any]]) -> None:
        self.ask, self.left = ask, False
        self._loop, self._pieces = asyncio.get_running_loop(), asyncio.Queue[Any]()

    def put(self, piece: Any) -> None:
        """Send a piece, or None behind the last; an error is raised there, and what is nobody's input is logged."""
        if isinstance(piece, Exception) and not isinstance(piece, UserError):
            logger.error("the model failed", exc_info=piece)
            piece = Failed()
        with suppress(RuntimeError):  # The loop is closed: nobody waits.
            self._loop.call_soon_threadsafe(self._pieces.put_nowait, piece)

    async def pieces(self) -> AsyncGenerator[Any]:
        """What was put; `left` is set where nobody takes it any more."""
        try:
            while (piece := await self._pieces.get()) is not None:
                if isinstance(piece, Exception):
                    raise piece
                yield piece
        finally:
            self.left = True


class Worker:
    """The thread that holds the model: what waits is answered in one batch, and what comes meanwhile in the next.

    The model divides a batch by its own batch size.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        # A daemon, so that a second Ctrl-C does not wait for the answer.
        self._thread = threading.Thread(target=self._work, name="octopi-model", daemon=True)
        self._thread.start()

    def answer(self, ask: Callable[[], Iterable[Any]]) -> AsyncGenerator[Any]:
        """Queue a question, and yield the pieces of its answer as they are made; who closes this gives it up.

        Args:
            ask: Called in the thread, where its pieces are made, too. Pieces with a method `together`, as `Stream` has
                it, are made in one batch with those of others.

        Raises:
            UserError: as `ask` raises it.
            Failed: where it raises anything else.
        """
        job = Job(ask)
        self._jobs.put(job)
        return job.pieces()

    def stop(self) -> None:
        """Wait until all that is queued is answered."""
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            jobs = [job]
            with suppress(queue.Empty):
                while (job := self._jobs.get(timeout=PAUSE)) is not None:
                    jobs.append(job)
                self._jobs.put(None)  # It ends the loop when these are answered.
            self._answer(jobs)

    def _answer(self, jobs: Sequence[Job]) -> None:
        """Answer what cannot be in a batch by itself, then the others in one."""
        batch: list[tuple[Job, Any]] = []
        for job in jobs:
            try:
                pieces = () if job.left else job.ask()
                if hasattr(pieces, "together"):
                    batch.append((job, pieces))
                    continue
                for piece in pieces:
                    job.put(piece)
                    if job.left:
                        break
                job.put(None)
            except Exception as error:
                job.put(error)
        left: set[int] = set()
        try:
            for place, piece in batch[0][1].together([pieces for _, pieces in batch], left) if batch else ():
                batch[place][0].put(piece)
                left.update(i for i, (job, _) in enumerate(batch) if job.left)
                if len(left) == len(batch):
                    return
        except Exception as error:
            for job, _ in batch:
                job.put(error)


def check_token(request: Request, token: str) -> None:
    """Refuse with status 401 who does not send the token, where there is one."""
    given = request.headers.get("authorization", "")
    if token and not hmac.compare_digest(given.encode("utf-8", "replace"), f"Bearer {token}".encode()):
        message = "wrong or no token; send Authorization: Bearer TOKEN"
        raise HTTPException(401, message, {"WWW-Authenticate": "Bearer"})


def make_server(app: FastAPI) -> uvicorn.Server:
    """The server of the application; `run(sockets=[...])` returns when a signal came and all answers are sent."""
    return uvicorn.Server(
        uvicorn.Config(app, ws="none", lifespan="on", access_log=False, log_level="warning", server_header=False)
    )


def listen(host: str, port: int, token: str = "") -> socket.socket:
    """A socket for the server; UserError where others could reach it without a token, or it cannot have the address."""
    try:
        own = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        own = False  # A name.
    if not own and not token:
        raise UserError(f"--host {host}: others can reach it; set OCTOPI_TOKEN or --token-file, or leave --host out")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=256)
    except (OSError, OverflowError) as error:
        words = getattr(error, "strerror", None) or error
        raise UserError(f"--host {host} --port {port}: cannot be had ({words}); choose another") from None
