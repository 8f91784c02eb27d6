"""`octopi serve`: a model behind OpenAI's chat completions, for machines that know no more than HTTP.

One thread holds the model. A request holds one of a few places from its first byte to its answer; while all are
taken, a new one is answered with status 429 before its body is read.
"""

from __future__ import annotations

import asyncio
import hmac
import math
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import HTTPException
from fastapi.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException as AnyHTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Message, Receive, Scope, Send

from pipeline.core.errors import UserError
from pipeline.use.media import PLACE, Gate, Limits, Refused
from pipeline.use.protocol import Reply, error_body, model_entry, read_conversation, read_request
from pipeline.use.results import Exchange
from pipeline.use.worker import Failed, Job, Metrics, Worker

if TYPE_CHECKING:
    from pipeline.use.model import Octopi

UPLOAD_SECONDS, DRAIN_SECONDS = 30.0, 5.0
"""How long a client may take for a body, and for the rest of one that is not wanted."""
HOME = ("127.0.0.1", "localhost", "::1", "[::1]")


class Service:
    """What the routes share."""

    def __init__(self, model: Octopi, name: str, *, token: str, limits: Limits, places: int, most_tokens: int) -> None:
        self.model, self.name, self.token, self.limits = model, name, token, limits
        self.places, self.most_tokens = places, most_tokens
        self.created = int(time.time())
        self.gate = Gate(limits)
        self.metrics = Metrics()
        self.worker = Worker(self.metrics)
        self._free = threading.Semaphore(places)

    @property
    def taken(self) -> int:
        """Requests that are read, checked, waiting or answered."""
        return self.places - self._free._value

    def check_token(self, request: Request) -> None:
        """Raise 401 without the right token; without any, raise 403 where a browser was lured here by another name."""
        if not self.token:
            if (request.url.hostname or "") not in HOME:
                raise HTTPException(403, "this server has no token and answers to 127.0.0.1 and localhost only")
            return
        given = request.headers.get("authorization", "").removeprefix("Bearer ").strip()
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode()):
            raise HTTPException(
                401, "wrong or no token; send Authorization: Bearer TOKEN", {"WWW-Authenticate": "Bearer"}
            )

    async def chat(self, request: Request) -> Response:
        """Answer `/v1/chat/completions`."""
        if not self._free.acquire(blocking=False):
            wait = str(min(600, max(1, math.ceil(self.metrics.mean * self.taken))))
            raise HTTPException(
                429, f"all {self.places} places are taken; come again in {wait} s", {"Retry-After": wait}
            )
        with ExitStack() as stack:
            stack.callback(self._free.release)
            body = await _read(request, self.limits.body_bytes)
            wanted, asked, files, notes = await asyncio.to_thread(self._prepare, body, stack)
            del body
            # From here on the worker gives the place back, when it needs the files no more.
            job = Job(asked, stack.pop_all().close)
            self.worker.add(job)
        self.metrics.videos += files
        reply = Reply(self.name, notes)
        pieces = job.pieces()
        try:
            if wanted.stream:
                first = await _unless_left(request, anext(pieces, ""))
                return StreamingResponse(_events(reply, first, pieces, job), media_type="text/event-stream")
            return JSONResponse(reply.whole(await _unless_left(request, _join(pieces))))
        except BaseException:
            job.left.set()
            raise

    def _prepare(self, body: bytes, stack: ExitStack) -> tuple[Any, Callable[[], Iterator[str]], int, list[str]]:
        """The request, how to answer it, its number of videos, and a list that takes the notes when it is answered."""
        wanted = read_request(body)
        if wanted.model != self.name:
            raise HTTPException(404, f"model {wanted.model[:80]!r} is not served here; ask for {self.name!r}")
        said = read_conversation(wanted.messages, self.limits.videos)
        every = [video for _, videos, _ in said for video in videos]
        files = iter(stack.enter_context(self.gate.files(every)))
        *history, last = [Exchange(q, tuple(next(files) for _ in videos), a) for q, videos, a in said]
        most = wanted.max_completion_tokens or wanted.max_tokens
        most = min(most, self.most_tokens) if most else None
        notes: list[str] = []

        def ask() -> Iterator[str]:
            pieces = self.model.stream(last.question, last.videos, history=history, max_new_tokens=most)
            notes.extend(
                PLACE.sub(r"video \1", note)
                for note in self.model.notes([v for e in (*history, last) for v in e.videos], last.question)
            )
            return pieces

        return wanted, ask, len(every), notes


async def _read(request: Request, most: int) -> bytes:
    """The body, at most so many bytes and not for ever."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        # A page of another site may send other types without asking the browser's leave.
        raise HTTPException(415, "send Content-Type: application/json")
    promised = request.headers.get("content-length", "0")
    too_much = HTTPException(413, f"the request is larger than {most} bytes; send fewer or shorter videos")
    if not promised.isdecimal() or int(promised) > most:
        raise too_much
    data = bytearray()
    try:
        async with asyncio.timeout(UPLOAD_SECONDS):
            async for chunk in _chunks(request):
                data += chunk
                if len(data) > most:
                    raise too_much
    except TimeoutError:
        request.state.read = True
        raise HTTPException(
            408, f"the request took longer than {UPLOAD_SECONDS:g} s to arrive", {"Connection": "close"}
        ) from None
    return bytes(data)


async def _chunks(request: Request) -> AsyncIterator[bytes]:
    """The body as it comes, from where it was last read; an error where the client hangs up."""
    while not getattr(request.state, "read", False):
        message = await request.receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        request.state.read = not message.get("more_body", False)
        yield message.get("body", b"")


async def _drain(request: Request, most: int) -> None:
    """Read what is not wanted: a client that is still sending would not see the answer."""
    with suppress(Exception):
        async with asyncio.timeout(DRAIN_SECONDS):
            async for chunk in _chunks(request):
                most -= len(chunk)
                if most < 0:
                    return


async def _unless_left(request: Request, work: Any) -> str:
    """The result of `work`, which is given up when the client hangs up."""

    async def left() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    tasks = [asyncio.ensure_future(work), asyncio.create_task(left())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if not tasks[0].done():
            raise ClientDisconnect
        return str(tasks[0].result())
    finally:
        for task in tasks:
            task.cancel()


async def _join(pieces: AsyncIterator[str]) -> str:
    return "".join([piece async for piece in pieces])


async def _events(reply: Reply, first: str, pieces: AsyncIterator[str], job: Job) -> AsyncIterator[str]:
    """Server-sent events as OpenAI sends them; an error that comes late is the last event."""
    try:
        yield _event(reply.chunk({"role": "assistant", "content": ""}))
        yield _event(reply.chunk({"content": first}))
        async for piece in pieces:
            yield _event(reply.chunk({"content": piece}))
        yield _event(reply.chunk({}, "stop"))
        yield "data: [DONE]\n\n"
    except (UserError, Failed) as error:
        yield _event(error_body(*_said(error)))
    finally:
        job.left.set()


def _event(value: object) -> str:
    return f"data: {JSONResponse(value).body.decode()}\n\n"  # type: ignore[union-attr]


def _said(error: Exception) -> tuple[str, int]:
    if isinstance(error, AnyHTTPException):
        return str(error.detail), error.status_code
    if isinstance(error, ClientDisconnect):
        return "the client has left", 499
    status = error.status if isinstance(error, Refused) else 422 if isinstance(error, UserError) else 500
    # Videos lie in a folder of ours, whose name is nobody's business.
    return PLACE.sub(r"video \1", " ".join(str(error).split())), status


def make_app(
    model: Octopi,
    name: str,
    *,
    token: str = "",
    limits: Limits | None = None,
    places: int = 32,
    most_tokens: int = 1024,
) -> FastAPI:
    """The web application.

    Args:
        model: Asked by one thread only.
        name: What clients call it.
        token: What they must send; empty for none, and then only names of this machine are answered to.
        limits: Of one request.
        places: Requests at once, from the first byte to the answer; the next gets 429.
        most_tokens: The longest answer; a client may ask for a shorter one.
    """
    service = Service(model, name, token=token, limits=limits or Limits(), places=places, most_tokens=most_tokens)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        await asyncio.to_thread(service.worker.stop)
        service.gate.close()

    app = FastAPI(title="octopi serve", lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    app.state.service, counts = service, service.metrics.requests

    @app.post("/v1/chat/completions")
    async def chat(request: Request) -> Response:
        service.check_token(request)
        return await service.chat(request)

    @app.get("/v1/models")
    async def models(request: Request) -> dict[str, Any]:
        service.check_token(request)
        return {"object": "list", "data": [model_entry(name, service.created)]}

    @app.get("/v1/models/{wanted:path}")
    async def one_model(request: Request, wanted: str) -> dict[str, Any]:
        service.check_token(request)
        if wanted != name:
            raise HTTPException(404, f"model {wanted[:80]!r} is not served here; ask for {name!r}")
        return model_entry(name, service.created)

    @app.get("/health")
    async def health() -> dict[str, Any]:
        return {"status": "ok", "model": name, "waiting": service.taken, "places": places}

    @app.get("/metrics")
    async def metrics(request: Request) -> Response:
        service.check_token(request)
        return PlainTextResponse(service.metrics.text(service.taken, places), media_type="text/plain; version=0.0.4")

    async def refuse(request: Request, error: Exception) -> Response:
        message, status = _said(error)
        await _drain(request, 4 * service.limits.body_bytes)
        return JSONResponse(error_body(message, status), status, getattr(error, "headers", None))

    async def fail(_: Request, __: Exception) -> Response:
        counts[500] += 1  # It answers outside of `_Count`.
        return JSONResponse(error_body(str(Failed()), 500), 500)

    for kind in (AnyHTTPException, UserError, Failed, ClientDisconnect):
        app.add_exception_handler(kind, refuse)
    app.add_exception_handler(Exception, fail)
    app.add_middleware(_Count, counts=counts)
    return app


class _Count:
    """Counts answers by status."""

    def __init__(self, app: Any, counts: Counter[int]) -> None:
        self.app, self.counts = app, counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def counting(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.counts[message["status"]] += 1
            await send(message)

        await self.app(scope, receive, counting)
