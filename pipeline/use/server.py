"""Where `octopi serve` listens, whom it lets in, and how it ends."""

from __future__ import annotations

import asyncio
import ipaddress
import os
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from pipeline.core.errors import UserError

if TYPE_CHECKING:
    from pipeline.use.model import Octopi

SHORTEST_TOKEN = 16
HEADER_SECONDS = 10.0
"""How long a client may take for a request's head."""


class HeaderTimeout(H11Protocol):
    """Closes the connection of a client that does not send a request's head in time; uvicorn waits without end."""

    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clock."""
        super().connection_made(transport)
        self._timer = self.loop.call_later(HEADER_SECONDS, transport.close)

    def data_received(self, data: bytes) -> None:
        """Stop it when a request is there; start it at the next one's first byte."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._timer = self._timer or self.loop.call_later(HEADER_SECONDS, self.transport.close)
        elif self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)


def make_server(app: FastAPI) -> uvicorn.Server:
    """The server of the application; `run(sockets=[...])` returns when a signal came and all answers are sent."""
    config = uvicorn.Config(
        app, http=HeaderTimeout, ws="none", lifespan="on", access_log=False, log_level="warning", server_header=False
    )
    return uvicorn.Server(config)


def listen(host: str, port: int, token: str) -> socket.socket:
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


def serve(load: Callable[[], Octopi], name: str, host: str, port: int, token_file: Path | None, places: int) -> None:
    """Serve a model until a signal comes; answers in flight are finished then.

    Raises:
        UserError: where the model, the token or the address cannot be used.
    """
    from pipeline.use.serve import make_app

    token = read_token(token_file)
    # First the address, which is known at once; loading takes its time.
    with listen(host, port, token) as listening:
        app = make_app(load(), name, token=token, places=places)
        address, number = listening.getsockname()[:2]
        place = f"[{address}]" if ":" in address else address
        print(f"{name} answers at http://{place}:{number}/v1; Ctrl-C ends it", flush=True)
        with suppress(KeyboardInterrupt):
            make_server(app).run(sockets=[listening])


def read_token(file: Path | None) -> str:
    """The token that the file holds, or else the environment; UserError for an empty file or a short token."""
    if file is None:
        token = os.environ.get("OCTOPI_TOKEN", "").strip()
    else:
        try:
            token = file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"--token-file {file}: cannot be read ({error}); name a text file") from None
        if not token:
            raise UserError(f"--token-file {file}: empty; write the token into it")
    if token and (len(token) < SHORTEST_TOKEN or not token.isascii() or not token.isprintable()):
        raise UserError(f"the token needs {SHORTEST_TOKEN} or more ASCII characters; `openssl rand -hex 32` makes one")
    return token
