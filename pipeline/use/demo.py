"""The demo: one page in the browser that shows what the model sees of a touch, and talks with it.

Everything comes from this machine: the page asks for nothing elsewhere, and its security policy forbids it.
"""

from __future__ import annotations

import base64
import re
import shutil
import tempfile
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import aclosing, asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import cv2
import numpy as np
from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.responses import JSONResponse, Response, StreamingResponse
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel, Field
from starlette.middleware.trustedhost import TrustedHostMiddleware

from pipeline.config import ScenesConfig
from pipeline.core.records import GAIN, MIDDLE
from pipeline.running.errors import UserError
from pipeline.scenes.light import make_sensor
from pipeline.scenes.recipe import SceneRecipe, load_recipes
from pipeline.scenes.render import make_scene, render
from pipeline.tasks.opd import TEMPLATES
from pipeline.use.results import Exchange, Touch
from pipeline.use.server import Failed, Worker, check_token, listen, make_server
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.film import write_film
from pipeline.videos.frames.subtraction import Pictures

if TYPE_CHECKING:
    from pipeline.use.model import Octopi

PAGE = Path(__file__).with_name("page")
HOSTS = ["127.0.0.1", "localhost"]
"""Names that the page answers to, so that no other site's name can be pointed at it."""
MOST_BYTES, MOST_TOUCHES = 200_000_000, 30
"""Maximum size of one video, and how many of the last touches are remembered."""
SCENE, SCENE_FRAMES = ScenesConfig(), 60
ASIDE = "\x1e"
"""Ends the model's own answer, which the page sends back with the next question, in what is streamed."""
GLOW = 6.0
"""Difference to the untouched sensor, in 8-bit steps, that is painted at full strength where it touches."""


class Turn(BaseModel):
    """What was asked, about which touches, and what the model said."""

    question: str
    touches: list[str] = []
    answer: str


class Asked(BaseModel):
    """A question of the page; its touches are ids that the page was given."""

    question: str = Field(max_length=4000)
    touches: list[str] = Field(default=[], max_length=3)
    history: list[Turn] = []


class Session:
    """The model, the touches that were shown to it, and one thread that all its work is done in."""

    def __init__(self, model: Octopi, catalogue: Catalogue, recipes: Mapping[str, SceneRecipe]) -> None:
        self.model, self.scenes = model, recipes
        self.names = {object_id: catalogue.objects[object_id].name for object_id in recipes}
        self.folder = Path(tempfile.mkdtemp(prefix="octopi-demo-"))
        self.videos: dict[str, Path] = {}
        self.worker = Worker()

    def close(self) -> None:
        """Forget everything that was shown."""
        self.worker.stop()
        shutil.rmtree(self.folder, ignore_errors=True)

    async def work(self, task: Callable[[], Any]) -> Any:
        """Wait for the model's thread to do something."""
        return await anext(self.worker.answer(lambda: [task()]))

    def scene(self, object_id: str) -> Path:
        """A synthetic press of an object, rendered once."""
        file = self.folder / f"{object_id}_0.mp4"
        if not file.exists():
            scene = make_scene(self.scenes[object_id], SCENE, SCENE_FRAMES, SCENE.seed)
            sensor = make_sensor(SCENE.width, SCENE.height, SCENE.seed)
            part = file.with_name("part.mp4")
            write_film(part, render(scene, SCENE, sensor, SCENE.seed), SCENE.fps)
            part.replace(file)
        return file

    def show(self, name: str, video: Path) -> dict[str, Any]:
        """Encode and classify a video, and give all that the page draws of it.

        Raises:
            UserError: for a video that the model cannot use.
        """
        touch, said = self.model.look(video), self.model.describe(video, sentence=False)
        key = uuid4().hex
        self.videos[key] = video
        while len(self.videos) > MOST_TOUCHES:
            old = self.videos.pop(next(iter(self.videos)))
            if old.parent.parent == self.folder:  # What was dropped has a folder of its own; scenes may come again.
                shutil.rmtree(old.parent, ignore_errors=True)
        return {
            "id": key,
            "name": name,
            "numbers": touch.numbers,
            "frames": [uri(frame) for frame in touch.frames],
            "difference": [uri(picture) for picture in touch.difference],
            "touched": [uri(picture) for picture in where(touch)],
            "reference": uri(touch.reference),
            "contact": touch.contact,
            "notes": said.notes,
            "levels": said.levels,
            "probabilities": said.probabilities,
            "calibrated": said.calibrated,
        }

    async def stream(self, asked: Asked) -> AsyncIterator[str]:
        """The answer in pieces, and behind `ASIDE` what heads and notes say; it stops where nobody listens any more.

        Raises:
            UserError: if the question does not fit, before the first piece.
        """
        turns = [Exchange(t.question, self._find(t.touches), t.answer) for t in asked.history]
        videos = self._find(asked.touches)
        (heads,) = await self.work(lambda: [self.model.verdict(asked.question, videos)])
        pieces = self.worker.answer(lambda: self.model.stream(asked.question, videos, history=turns))
        first = await anext(pieces, "")
        shown = sum(len(turn.videos) for turn in turns) + len(videos)
        notes = [note for note in self.model.doubts_about(asked.question, shown) if note not in self.model.doubts]

        async def rest() -> AsyncIterator[str]:
            said = first
            async with aclosing(pieces):
                try:
                    yield first
                    async for piece in pieces:
                        said += piece
                        yield piece
                    ruled = [f"Property heads: {heads.shown}", *self.model.apart(said, heads)] if heads else []
                    if ruled or notes:
                        yield ASIDE + ". ".join([*ruled, *notes])
                except (UserError, Failed) as error:
                    yield f"\n[{error}]"

        return rest()

    def _find(self, keys: Sequence[str]) -> tuple[Path, ...]:
        if unknown := [key for key in keys if key not in self.videos]:
            raise UserError(f"{len(unknown)} touches are forgotten; begin a new conversation, and drop them again")
        return tuple(self.videos[key] for key in keys)


def where(touch: Touch) -> Pictures:
    """The frames with a red glow where they differ from the untouched sensor; as `touch.frames`."""
    found = []
    for frame, difference in zip(touch.frames, touch.difference, strict=True):
        change = np.abs(difference.astype(np.float32) - MIDDLE).max(axis=2) / GAIN
        share = np.clip(cv2.GaussianBlur(change, (0, 0), frame.shape[0] / 60) / GLOW, 0, 1)[:, :, None]
        found.append(frame * (1 - share) + np.array([230, 30, 60]) * share)
    painted: Pictures = np.rint(found).astype(np.uint8)
    return painted


def uri(picture: Pictures, kind: str = "png") -> str:
    """A picture (height x width x RGB) as a PNG or JPEG in a data URI."""
    _, data = cv2.imencode(f".{kind}", picture[:, :, ::-1])
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"


def make_app(session: Session, more: APIRouter | None = None, token: str = "") -> FastAPI:
    """The page and what it asks for, and `more`; with a token only for who sends it.

    Errors of the user come back as one line, with status 422.
    """

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        yield
        session.close()

    async def guard(request: Request) -> None:
        check_token(request, token)

    # Its documentation page would load scripts from elsewhere.
    app = FastAPI(lifespan=life, openapi_url=None, dependencies=[Depends(guard)])
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=HOSTS)

    @app.exception_handler(UserError)
    async def refuse(_: Request, error: UserError) -> Response:
        # A file is known to the user by its name, not by where it was put.
        line = re.sub(rf"{re.escape(str(session.folder))}/([0-9a-f]{{32}}/)?", "", str(error))
        return JSONResponse({"error": " ".join(line.split())}, 422)

    @app.get("/api/about")
    def about() -> dict[str, Any]:
        named = sorted(session.names.items(), key=lambda item: item[1])
        return {"model": session.model.name, "example": TEMPLATES[0], "scenes": named}

    @app.put("/api/touches/{name}")
    async def drop(name: str, request: Request) -> Any:
        """The body is the file itself."""
        file = session.folder / uuid4().hex / (Path(name).name.lstrip(".") or "video")
        file.parent.mkdir()
        try:
            with file.open("wb") as stream:
                async for chunk in request.stream():
                    if stream.tell() + len(chunk) > MOST_BYTES:
                        raise UserError(f"{name}: more than {MOST_BYTES // 1_000_000} MB; drop a shorter video")
                    stream.write(chunk)
            return await session.work(lambda: session.show(file.name, file))
        except BaseException:
            shutil.rmtree(file.parent)
            raise

    @app.put("/api/scenes/{object_id}")
    async def scene(object_id: str) -> Any:
        if object_id not in session.scenes:
            raise UserError(f"{object_id}: no such scene")
        return await session.work(
            lambda: session.show(f"{session.names[object_id]} (synthetic)", session.scene(object_id))
        )

    @app.post("/api/ask")
    async def ask(asked: Asked) -> StreamingResponse:
        return StreamingResponse(await session.stream(asked), media_type="text/plain; charset=utf-8")

    app.include_router(more or APIRouter())
    app.mount("/", StaticFiles(directory=PAGE, html=True))
    return app


def serve_demo(load: Callable[[], Octopi], catalogue: Path, port: int) -> None:
    """Show the demo at http://127.0.0.1:`port` until it is interrupted; `catalogue` names the scenes.

    Raises:
        UserError: where the port, the catalogue or the model cannot be used.
    """
    with listen("127.0.0.1", port) as listening:
        known = load_catalogue(catalogue)
        app = make_app(Session(load(), known, load_recipes(catalogue, known, seed=0)))
        print(f"http://127.0.0.1:{listening.getsockname()[1]} shows the demo; Ctrl-C ends it", flush=True)
        with suppress(KeyboardInterrupt):
            make_server(app).run(sockets=[listening])
