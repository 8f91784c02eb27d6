"""`octopi serve`: a model behind OpenAI's chat completions, for machines that know no more than HTTP.

One thread holds the model. A request holds one of a few places from its first byte to its answer; while all are
taken, a new one is answered with status 429 before its body is read.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import math
import os
import time
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterable
from contextlib import ExitStack, aclosing, asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.core.errors import UserError
from pipeline.use.media import PLACE, Gate, Limits, Refused
from pipeline.use.protocol import ChatRequest, Json, Reply, error_body, read_conversation, read_request
from pipeline.use.results import Exchange
from pipeline.use.server import Failed, Worker, listen, make_server

if TYPE_CHECKING:
    from pipeline.use.model import Octopi

UPLOAD_SECONDS, DRAIN_SECONDS, LOOK_SECONDS = 30.0, 5.0, 0.1
"""Time that a client may take to send a body, and to send the rest of a refused one; and the interval of checks whether
the client is still connected."""
MOST_TOKENS = 1024
"""The longest answer that a client may ask for."""
SHORTEST_TOKEN = 16
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


class Service:
    """What the routes share."""

    def __init__(self, model: Octopi, name: str, *, token: str, limits: Limits | None, places: int) -> None:
        self.model, self.name, self.token, self.places = model, name, token, places
        self.gate, self.worker = Gate(limits), Worker()
        self.taken: set[Reply] = set()
        """The places: a reply each to a request that is read, checked, waiting or answered."""
        self.requests: Counter[int] = Counter()
        self.videos = 0

    async def check_token(self, request: Request) -> None:
        """Raise 401 without the right token, or 403 where the server has none and is called by another machine's name.

        A site may point its own name at 127.0.0.1, so that a visitor's browser asks here for it (DNS rebinding).
        """
        if not self.token:
            if (request.url.hostname or "") not in LOCAL_NAMES:
                raise HTTPException(403, "this server has no token and answers to 127.0.0.1 and localhost only")
            return
        given = request.headers.get("authorization", "").removeprefix("Bearer ").strip()
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode()):
            raise HTTPException(
                401, "wrong or no token; send Authorization: Bearer TOKEN", {"WWW-Authenticate": "Bearer"}
            )

    def check_name(self, name: str) -> None:
        """Raise 404 for another model's name."""
        if name != self.name:
            raise HTTPException(404, f"model {name[:80]!r} is not served here; ask for {self.name!r}")

    async def chat(self, request: Request) -> Response:
        """Answer `/v1/chat/completions`."""
        if len(self.taken) >= self.places:
            mean = self.worker.seconds / self.worker.answers if self.worker.answers else 1.0
            wait = str(min(600, max(1, math.ceil(mean * len(self.taken)))))
            message = f"all {self.places} places are taken; come again in {wait} s"
            raise HTTPException(429, message, {"Retry-After": wait})
        reply = Reply(self.name)
        with ExitStack() as stack:
            self.taken.add(reply)
            stack.callback(self.taken.remove, reply)
            wanted, exchanges = await asyncio.to_thread(self._prepare, await self._read(request), stack)
            # From here on the worker gives the place back, when it needs the files no more.
            pieces = self.worker.answer(lambda: self._ask(wanted, exchanges, reply), stack.pop_all().close)
        self.videos += sum(len(exchange.videos) for exchange in exchanges)
        if wanted.stream:
            first = await _unless_left(request, anext(pieces, ""))
            return StreamingResponse(_events(reply, first, pieces), media_type="text/event-stream")
        return JSONResponse(reply.whole(await _unless_left(request, _join(pieces))))

    async def _read(self, request: Request) -> bytes:
        """The body, of limited size and time."""
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            # A page of another site may send other types without asking the browser's leave.
            raise HTTPException(415, "send Content-Type: application/json")
        data, most = bytearray(), self.gate.limits.body_bytes
        try:
            async with asyncio.timeout(UPLOAD_SECONDS):
                async for chunk in request.stream():
                    data += chunk
                    if len(data) > most:
                        message = f"the request is larger than {most} bytes; send fewer or shorter videos"
                        raise HTTPException(413, message)
        except TimeoutError:
            message = f"the request took longer than {UPLOAD_SECONDS:g} s to arrive"
            raise HTTPException(408, message, {"Connection": "close"}) from None
        return bytes(data)

    def _prepare(self, body: bytes, stack: ExitStack) -> tuple[ChatRequest, list[Exchange]]:
        """The request and its conversation, whose videos are files until the stack is closed."""
        wanted = read_request(body)
        self.check_name(wanted.model)
        said = read_conversation(wanted.messages)
        files = iter(stack.enter_context(self.gate.files([video for _, videos, _ in said for video in videos])))
        return wanted, [Exchange(q, tuple(next(files) for _ in videos), a) for q, videos, a in said]

    def _ask(self, wanted: ChatRequest, exchanges: list[Exchange], reply: Reply) -> Iterable[str]:
        """The answer in pieces, made in the model's thread; its notes go into the reply."""
        *history, last = exchanges
        most = wanted.max_completion_tokens or wanted.max_tokens
        most = min(most, MOST_TOKENS) if most else None
        pieces = self.model.stream(last.question, last.videos, history=history, max_new_tokens=most)
        notes = self.model.notes([video for exchange in exchanges for video in exchange.videos], last.question)
        reply.notes = [PLACE.sub(r"video \1", note) for note in notes]
        return pieces

    def metrics(self) -> str:
        """What happened since the start, in Prometheus' text format."""
        by_status = "".join(f'octopi_requests_total{{status="{s}"}} {n}\n' for s, n in sorted(self.requests.items()))
        return f"""# TYPE octopi_requests_total counter
{by_status}# TYPE octopi_videos_total counter
octopi_videos_total {self.videos}
# TYPE octopi_requests_waiting gauge
octopi_requests_waiting {len(self.taken)}
# TYPE octopi_requests_places gauge
octopi_requests_places {self.places}
# TYPE octopi_answer_seconds summary
octopi_answer_seconds_sum {self.worker.seconds:.6f}
octopi_answer_seconds_count {self.worker.answers}
"""


async def _unless_left(request: Request, work: Awaitable[str]) -> str:
    """The result of `work`, which is given up when the client hangs up."""
    task = asyncio.ensure_future(work)
    try:
        while not task.done():
            if await request.is_disconnected():
                raise ClientDisconnect
            await asyncio.wait([task], timeout=LOOK_SECONDS)
        return task.result()
    finally:
        task.cancel()


async def _join(pieces: AsyncIterator[str]) -> str:
    return "".join([piece async for piece in pieces])


async def _events(reply: Reply, first: str, pieces: AsyncGenerator[str]) -> AsyncIterator[str]:
    """Server-sent events as OpenAI sends them; an error that comes late is the last event."""

    def event(value: Json) -> str:
        return f"data: {json.dumps(value, ensure_ascii=False, separators=(',', ':'))}\n\n"

    async with aclosing(pieces):
        try:
            yield event(reply.chunk({"role": "assistant", "content": ""}))
            yield event(reply.chunk({"content": first}))
            async for piece in pieces:
                yield event(reply.chunk({"content": piece}))
            yield event(reply.chunk({}, "stop"))
            yield "data: [DONE]\n\n"
        except (UserError, Failed) as error:
            yield event(error_body(*_client_message(error)))


def _client_message(error: Exception) -> tuple[str, int]:
    """What a client is told of an error, and the status."""
    if isinstance(error, HTTPException):
        return str(error.detail), error.status_code
    status = error.status if isinstance(error, Refused) else 422 if isinstance(error, UserError) else 500
    # Videos lie in a folder of ours, whose name is nobody's business.
    return PLACE.sub(r"video \1", " ".join(str(error).split())), status


def make_app(model: Octopi, name: str, *, token: str = "", limits: Limits | None = None, places: int = 32) -> FastAPI:
    """The web application.

    Args:
        model: Asked by one thread only.
        name: What clients call it.
        token: What they must send; empty for none, and then only names of this machine are answered to.
        limits: Of one request.
        places: Requests at once, from the first byte to the answer; the next gets 429.
    """
    service = Service(model, name, token=token, limits=limits, places=places)
    entry = {"id": name, "object": "model", "created": int(time.time()), "owned_by": "octopi-pipeline"}

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        await asyncio.to_thread(service.worker.stop)
        service.gate.close()

    app = FastAPI(title="octopi serve", lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    guarded = APIRouter(dependencies=[Depends(service.check_token)])
    guarded.post("/v1/chat/completions")(service.chat)

    @guarded.get("/v1/models")
    async def models() -> Json:
        return {"object": "list", "data": [entry]}

    @guarded.get("/v1/models/{wanted:path}")
    async def one_model(wanted: str) -> Json:
        service.check_name(wanted)
        return entry

    @guarded.get("/metrics")
    async def metrics() -> Response:
        return PlainTextResponse(service.metrics(), media_type="text/plain; version=0.0.4")

    @app.get("/health")
    async def health() -> Json:
        return {"status": "ok", "model": name, "waiting": len(service.taken), "places": places}

    @app.exception_handler(HTTPException)
    @app.exception_handler(UserError)
    @app.exception_handler(Failed)
    async def refuse(request: Request, error: Exception) -> Response:
        message, status = _client_message(error)
        if status != 408:
            # The rest of the body is read: a client that is still sending would not see the answer.
            rest = 4 * service.gate.limits.body_bytes
            with suppress(Exception):
                async with asyncio.timeout(DRAIN_SECONDS):
                    async for chunk in request.stream():
                        rest -= len(chunk)
                        if rest < 0:
                            break
        return JSONResponse(error_body(message, status), status, getattr(error, "headers", None))

    @app.exception_handler(ClientDisconnect)
    async def left(_: Request, __: Exception) -> Response:
        return Response(status_code=499)  # As nginx numbers it; nobody reads it.

    @app.exception_handler(Exception)
    async def fail(_: Request, __: Exception) -> Response:
        service.requests[500] += 1  # What nothing foresaw is answered outside of `count`.
        return JSONResponse(error_body(str(Failed()), 500), 500)

    def count(inner: ASGIApp) -> ASGIApp:
        """Count answers by status. No `@app.middleware`, behind which a stream never learns that its client left."""

        async def counted(scope: Scope, receive: Receive, send: Send) -> None:
            async def sent(message: Message) -> None:
                if message["type"] == "http.response.start":
                    service.requests[message["status"]] += 1
                await send(message)

            await inner(scope, receive, sent)

        return counted

    app.include_router(guarded)
    app.add_middleware(count)
    return app
