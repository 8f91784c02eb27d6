"""`octopi serve`: a model behind OpenAI's chat completions, for machines that know no more than HTTP.

One thread holds the model. A request holds one of a few places from its first byte to its answer; while all are
taken, a new one is answered with status 429 before its body is read.
"""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable
from contextlib import ExitStack, aclosing, asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import Depends, FastAPI, Request
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from pipeline.running.errors import UserError
from pipeline.use.ask import classes_of
from pipeline.use.media import PLACE, Gate
from pipeline.use.protocol import Json, Reply, read_conversation, read_request
from pipeline.use.results import Exchange
from pipeline.use.server import Failed, Worker, check_token, listen, make_server

if TYPE_CHECKING:
    from pipeline.use.model import Octopi

MOST_BYTES, MOST_TOKENS, SHORTEST_TOKEN = 32 * 2**20, 1024, 16
"""The largest request, the longest answer that a client may ask for, and the fewest characters of a server's token."""
LOCAL_NAMES = ("127.0.0.1", "localhost", "::1", "[::1]")
"""Names that a server without a token answers to."""


def serve(load: Callable[[], Octopi], name: str, host: str, port: int, token_file: Path | None, places: int) -> None:
    """Serve a model until a signal comes; answers in flight are finished then.

    Raises:
        UserError: where the model, the token or the address cannot be used.
    """
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
    """The token that the file holds, or else the environment; UserError for one that is short or cannot be read."""
    try:
        token = (file.read_text(encoding="utf-8") if file else os.environ.get("OCTOPI_TOKEN", "")).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--token-file {file}: cannot be read ({error}); name a text file") from None
    if (token or file) and (len(token) < SHORTEST_TOKEN or not token.isascii() or not token.isprintable()):
        place = f"--token-file {file}" if file else "OCTOPI_TOKEN"
        raise UserError(f"{place}: needs {SHORTEST_TOKEN} or more ASCII characters; `openssl rand -hex 32` makes some")
    return token


async def _events(model: Octopi, reply: Reply, first: str, pieces: AsyncGenerator[str]) -> AsyncIterator[str]:
    """Server-sent events as OpenAI sends them; an error that comes late is the last event."""

    def event(value: Json) -> str:
        return f"data: {json.dumps(value, ensure_ascii=False, separators=(',', ':'))}\n\n"

    async with aclosing(pieces):
        try:
            yield event(reply.chunk({"role": "assistant", "content": ""}))
            yield event(reply.chunk({"content": first}))
            async for piece in pieces:
                first += piece
                yield event(reply.chunk({"content": piece}))
            reply.notes += model.apart(first, reply.verdict)
            yield event(reply.chunk({}, "stop")) + "data: [DONE]\n\n"
        except (UserError, Failed) as error:
            yield event(_error(error)[0])


def _error(error: Exception) -> tuple[Json, int]:
    """An error in OpenAI's form, of one line, and its status."""
    message, status = str(Failed()), 500
    if isinstance(error, HTTPException):
        message, status = str(error.detail), error.status_code
    elif isinstance(error, UserError):
        # Videos lie in a folder of ours, whose name is nobody's business.
        message, status = PLACE.sub(r"video \1", " ".join(str(error).split())), 422
    kind = "server_error" if status == 500 else "invalid_request_error"
    return {"error": {"message": message, "type": kind, "param": None, "code": None}}, status


def make_app(model: Octopi, name: str, *, token: str = "", places: int = 32) -> FastAPI:
    """The web application.

    Args:
        model: Asked by one thread only.
        name: What clients call it.
        token: What they must send; empty for none, and then only names of this machine are answered to.
        places: Requests at once, from the first byte to the answer; the next gets 429.
    """
    gate, worker, taken = Gate(), Worker(), 0
    entry = {"id": name, "object": "model", "created": int(time.time()), "owned_by": "octopi-pipeline"}

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        await asyncio.to_thread(worker.stop)
        gate.close()

    async def refuse(_: Request, error: Exception) -> Response:
        if isinstance(error, ClientDisconnect):
            return Response(status_code=499)  # As nginx numbers it; nobody reads it.
        content, status = _error(error)
        return JSONResponse(content, status, getattr(error, "headers", None))

    async def check_caller(request: Request) -> None:
        check_token(request, token)
        # A site may point its own name here, so that a visitor's browser asks for it (DNS rebinding).
        if not token and request.url.hostname not in LOCAL_NAMES:
            raise HTTPException(403, "this server has no token and answers to 127.0.0.1 and localhost only")

    def check_name(wanted: str) -> None:
        if wanted != name:
            raise HTTPException(404, f"model {wanted[:80]!r} is not served here; ask for {name!r}")

    async def take_place() -> AsyncIterator[ExitStack]:
        """One of the places, and what is to be closed behind the answer."""
        nonlocal taken
        if taken >= places:
            raise HTTPException(429, f"all {places} places are taken; come again soon")
        taken += 1
        try:
            with ExitStack() as stack:
                yield stack
        finally:
            taken -= 1

    app = FastAPI(lifespan=lifespan, openapi_url=None)
    for kind in (HTTPException, UserError, Failed, ClientDisconnect, Exception):
        app.add_exception_handler(kind, refuse)
    guarded, place = [Depends(check_caller)], Depends(take_place)

    @app.post("/v1/chat/completions", dependencies=guarded)
    async def chat(request: Request, stack: ExitStack = place) -> Response:
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            # A page of another site may send other types without asking the browser's leave.
            raise HTTPException(415, "send Content-Type: application/json")
        data = bytearray()
        async for chunk in request.stream():
            data += chunk
            if len(data) > MOST_BYTES:
                raise HTTPException(413, f"a request has at most {MOST_BYTES} bytes; send fewer or shorter videos")
        wanted = await asyncio.to_thread(read_request, bytes(data))
        check_name(wanted.model)
        said, reply = read_conversation(wanted.messages), Reply(name)
        # The conversation's videos are files until the stack is closed.
        checked = gate.files([video for _, videos, _ in said for video in videos])
        paths = await asyncio.to_thread(stack.enter_context, checked)
        files = iter(paths)
        *history, last = [Exchange(q, tuple(next(files) for _ in videos), a) for q, videos, a in said]
        most = wanted.max_completion_tokens or wanted.max_tokens

        def ask() -> Iterable[str]:
            """The answer in pieces, made in the model's thread; its notes go into the reply."""
            tokens = min(most, MOST_TOKENS) if most else None
            pieces = model.stream(last.question, last.videos, history=history, max_new_tokens=tokens)
            reply.notes = [PLACE.sub(r"video \1", note) for note in model.notes(paths, last.question)]
            reply.verdict = model.verdict(last.question, last.videos)
            reply.touches = classes_of(model, last.videos)
            return pieces

        pieces = worker.answer(ask)
        if wanted.stream:
            # What fails before the first piece has a status of its own.
            first = await anext(pieces, "")
            return StreamingResponse(_events(model, reply, first, pieces), media_type="text/event-stream")
        text = ""
        async with aclosing(pieces):
            async for piece in pieces:
                text += piece
                if await request.is_disconnected():
                    raise ClientDisconnect
        reply.notes += model.apart(text, reply.verdict)
        return JSONResponse(reply.whole(text))

    @app.get("/v1/models", dependencies=guarded)
    async def models() -> Json:
        return {"object": "list", "data": [entry]}

    @app.get("/v1/models/{wanted:path}", dependencies=guarded)
    async def one_model(wanted: str) -> Json:
        check_name(wanted)
        return entry

    @app.get("/health")
    async def health() -> Json:
        return {"status": "ok", "model": name, "waiting": taken, "places": places}

    return app
