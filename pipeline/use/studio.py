"""`octopi studio`: a page for a sensor on the desk, to record presses, rate them, adapt the model and ask it.

It is the demo's page and server with a camera and a folder behind them. What must not be lost is in the folder
(`RatedFolder`); here is what a page looks at.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import numpy as np
from fastapi import APIRouter, Body, FastAPI

from pipeline.config import FramesConfig
from pipeline.running.errors import UserError, counted
from pipeline.use.adapt import adapt, rated_videos
from pipeline.use.demo import Session, make_app, uri
from pipeline.use.frames import read_touch
from pipeline.use.live import Seen, presses, watch
from pipeline.use.rated_folder import RatedFolder
from pipeline.use.server import listen, make_server
from pipeline.videos.audit.files import SAME_RATE, SATURATED, STEP
from pipeline.videos.catalogue import PROPERTIES, load_catalogue
from pipeline.videos.decoding import Image
from pipeline.videos.frames.reference import LONGEST, contact_strength, is_steady, mean
from pipeline.videos.frames.subtraction import subtract
from pipeline.videos.importing.presses import RELEASED, SHORTEST, Shot, cut

if TYPE_CHECKING:
    from pipeline.use.model import Octopi

WIDTH, SHOWN = 480, FramesConfig(pixels=160, per_video=6, selection="contact")
"""Width of the live picture, and what raters are shown of a video."""
WEAK, BRIEF = 1.5, 8
"""A press is weak up to so many times the strength that it begins at, and short under so many pictures."""
DIRT, UNEVEN = 1.0, 0.1
"""A part of the picture is dirty where it moves the mean change from the median one by so many 8-bit steps, and by this
share of the median: a change of the light is uneven, too."""
RECENT, LOST = 150, 3
"""Pictures that rate and drops are measured on, and how many of them may be missing without a word."""
AGAIN = 2.0
"""Seconds until a camera that is gone is looked for again."""
Text = Annotated[str, Body(embed=True, max_length=4096)]


class Sensor:
    """A camera that one thread watches: its last pictures, its untouched gel, and what is odd about them."""

    def __init__(self, camera: str, times: float, tell: Callable[[str, list[Shot]], object]) -> None:
        """Begin to watch; `tell` is given each touch: what is odd about it, and its pictures where it is a press."""
        self.camera, self.times, self.tell = camera, times, tell
        self.promised, self.gone, self.came = 0.0, f"{camera}: is being opened", time.monotonic()
        self.stamps, self.curve = deque[int](maxlen=RECENT), deque[float](maxlen=RECENT)
        self.quiet, self.gel = deque[Seen](maxlen=2 * LONGEST), list[Image]()
        self.last: Seen | None = None
        self.strongest: Seen | None = None
        self.near = self.held = 0
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self._watch, name="octopi-camera", daemon=True)
        self.thread.start()

    def close(self) -> None:
        """Let go of the camera; a press that has begun is taken."""
        self.stop.set()
        self.thread.join(AGAIN)

    def _watch(self) -> None:
        while not self.stop.is_set():
            try:
                for press in presses(self._shots(), self.times, self._see):
                    self.tell(self._doubts(), press)
                    self.held, self.strongest = 0, None  # As behind what is no press.
                self.gone = f"{self.camera}: has ended"
            except Exception as error:  # Also what OpenCV raises where a stream changes its size: it is opened again.
                self.gone = str(error)
            if Path(self.camera).is_file():
                return
            self.stop.wait(AGAIN)

    def _shots(self) -> Iterator[Shot]:
        """The camera's pictures; a file's come when they came to the camera that recorded it."""
        begin = time.monotonic() if Path(self.camera).is_file() else None
        self.stamps.clear()  # A camera that comes back dropped no pictures meanwhile, and may have another format.
        self.quiet.clear()
        self.last = self.strongest = None
        for shot in watch(self.camera, lambda rate: setattr(self, "promised", rate)):
            if self.stop.wait(max(0.0, begin + shot.stamped / 1e9 - time.monotonic()) if begin else 0):
                return
            self.gone, self.came = "", time.monotonic()
            self.stamps.append(shot.stamped)
            yield shot

    def _see(self, seen: Seen) -> None:
        """Take in one picture, and say what is no press."""
        # The first pictures, on which the quiet level is measured, are compared with nothing.
        over = len(self.quiet) >= LONGEST and seen.strength > RELEASED * seen.threshold
        if seen.state == "untouched":
            if self.near >= SHORTEST and not over:
                self.tell("too weak, nothing is recorded: press harder", [])
                self.near = -2 * LONGEST  # The reference holds this touch until then, and shows its negative.
            self.near, self.held, self.strongest = self.near + 1 if over or self.near < 0 else 0, 0, None
            self.quiet.append(seen)
            thumbs = [one.thumb for one in self.quiet][-LONGEST:]
            known = self.gel and self.gel[0].shape == thumbs[0].shape  # Else it is the first one, or in another format.
            if not known and len(thumbs) == LONGEST and is_steady(thumbs):
                self.gel = [mean(thumbs)]
        else:
            self.near, self.held = 0, self.held + over
            self.strongest = max(self.strongest or seen, seen, key=lambda one: one.strength)
        ended = {
            "short": "too short, nothing is recorded: press again",
            "light": "a change of the light, or half a minute without a release: nothing is recorded",
        }
        if seen.state in ended:
            self.tell(ended[seen.state], [])
            self.held, self.strongest = 0, None  # The next touch may follow at once.
        self.curve.append(seen.strength / seen.threshold)
        self.last = seen

    def _doubts(self) -> str:
        """What is odd about the press that has just ended."""
        if self.strongest is None or self.last is None:
            return ""
        picture, level = self.strongest.shot.picture, self.strongest.threshold
        clipped = float(np.mean((picture == 0) | (picture == 255)))
        found = {
            "weak: press harder": self.strongest.strength < WEAK * level,
            f"short, {counted(self.held, 'picture')}: hold it longer": self.held < BRIEF,
            f"clipped, {clipped:.0%} of values are 0 or 255: change light or exposure": clipped > SATURATED,
            "cut off before the release": self.last.state == "pressed",
        }
        return "; ".join(words for words, odd in found.items() if odd)

    def notes(self) -> list[str]:
        """What is odd about rate, light and gel just now."""
        stamps, quiet, found = [*self.stamps], [*self.quiet][-LONGEST:], dict[str, bool]()
        if len(stamps) > LONGEST:
            span, count = stamps[-1] - stamps[0], len(stamps) - 1
            rate, missing = 1e9 * count / max(1, span), round(span / max(1, np.median(np.diff(stamps)))) - count
            other = max(rate / (self.promised or rate), self.promised / rate) > SAME_RATE
            found[f"it says {self.promised:g} pictures a second, and gives {rate:.1f}"] = other
            found[f"it dropped {missing} of the last {count + missing} pictures"] = missing > LOST
        if len(quiet) == LONGEST and not is_steady([seen.thumb for seen in quiet]):
            found["the light still changes; wait"] = True
        elif len(quiet) == LONGEST and self.gel and self.gel[0].shape == quiet[0].thumb.shape:
            now, gel = mean([seen.thumb for seen in quiet]), self.gel[0]
            change = now[:, :, 0] - gel[:, :, 0].astype(float)
            light = float(np.median(change))  # As most of the picture has it.
            # Dirt is darker everywhere, or brighter, which contact strength takes for a change of the light.
            dirt = abs(float(change.mean()) - light) > max(DIRT, UNEVEN * abs(light))
            drift = dirt or contact_strength(now, gel) > quiet[-1].threshold
            found[f"the light has changed by {light:+.0f} of 255 since the start"] = abs(light) > STEP
            found["the untouched gel is not as at the start: is something on it, has it moved?"] = drift
        return [words for words, odd in found.items() if odd]

    def shown(self) -> dict[str, Any]:
        """What the page shows: pictures as data URIs, strengths as multiples of what a press begins at."""
        late, stamps = time.monotonic() - self.came, [*self.stamps]
        told = {
            "camera": self.camera,
            "gone": self.gone or (f"{self.camera}: no picture for {late:.0f} s" if late > AGAIN else ""),
            "rate": 1e9 * (len(stamps) - 1) / max(1, stamps[-1] - stamps[0]) if stamps else 0.0,
            "notes": self.notes(),
            "curve": [*self.curve],
        }
        last, quiet = self.last, [*self.quiet][:LONGEST]
        if last and quiet and last.shot.picture.shape == quiet[0].shot.picture.shape:  # Else it is being opened anew.
            pictures = [seen.shot.picture[:, :, ::-1] for seen in (last, *quiet)]
            scale = WIDTH / pictures[0].shape[1]
            picture, *before = (cv2.resize(shown, None, fx=scale, fy=scale) for shown in pictures)
            told |= {"picture": uri(picture, "jpeg"), "pressed": last.state == "pressed"}
            told["difference"] = uri(subtract(picture[None], mean(before))[0], "jpeg")
        return told


class Studio(Session):
    """The demo's session with a camera and a folder: one thread watches, one writes videos, one holds the model."""

    def __init__(
        self, load: Callable[[str | None], Octopi], folder: Path, camera: str, times: float, *, newest: bool = True
    ) -> None:
        """Open or make the folder; `load` gives the model of a folder, or for None the one that is adapted.

        Until it is adapted again, the `newest` copy that the folder has is asked, or the one that is adapted.
        """
        self.data = RatedFolder(folder, Path(__file__).parents[1] / "physiclear" / PROPERTIES)
        self.load, self.times, self.copies = load, times, folder / "models"
        model = load(max((str(copy) for copy in self.copies.glob("[0-9]*") if newest), default=None))
        super().__init__(model, model.catalogue, {})
        self.session, self.target, self.told, self.busy = time.strftime("%Y-%m-%d %H:%M"), "", "", ""
        self.events, self.undos = list[dict[str, str]](), list[Callable[[], object]]()
        self.lock, self.writer = threading.RLock(), ThreadPoolExecutor(1)
        self.sensor = Sensor(camera, times, self._tell)

    def close(self) -> None:
        """Write what was pressed, and end."""
        self.sensor.close()
        self.writer.shutdown()
        super().close()

    # ---- record ----

    def _tell(self, odd: str, press: list[Shot]) -> None:
        # Writing takes longer than a picture lasts.
        self.writer.submit(self._write, odd, press, self.target)

    def _write(self, odd: str, press: list[Shot], target: str) -> None:
        """Write a press as a video of the object that was named when it ended, and tell the page."""
        said, file = f"a touch was {odd}" if odd else "", ""
        if press and not target:
            said = "a press, which is not recorded: name the object first"
        elif press:
            try:
                with self.lock:
                    (path,) = cut(lambda: iter(press), self.sensor.camera, self.data.videos, target, whole=True)
                    file = path.name
                    self.data.known[file] = {"file": file, "object_id": target, "session": self.session}
                    self.data.list_videos()
                    self.undos.append(lambda: self.data.move(file, ""))
                said = ": ".join(filter(None, (file, odd)))
            except Exception as error:  # Nobody waits for this thread, so whatever it is must be said here.
                said = f"a press could not be written: {error}"
        self.events.append({"text": said, "file": file})

    def connect(self, camera: Text) -> None:
        """Watch another camera, or the same one with its gel as it is now, or a file from its beginning."""
        with self.lock:  # One camera at a time, whoever asks for it.
            self.sensor.close()
            self.sensor = Sensor(camera, self.times, self._tell)

    def aim(self, name: Text) -> None:
        """Name the object of the next presses; with an empty name they are not recorded."""
        self.target = self.data.id_of(name) if name else ""

    def move(self, file: Text, name: Text) -> None:
        """Give a video to another object; with an empty name delete it."""
        with self.lock:
            now, whose = self.data.move(file, self.data.id_of(name) if name else "")
            self.undos.append(lambda: self.data.move(now, whose, file))

    def rename(self, object_id: Text, name: Text) -> None:
        """Call an object otherwise."""
        with self.lock:
            new = self.data.id_of(name)
            old, files = self.data.rename(object_id, new, name)

            def back() -> None:
                self.data.rename(new, object_id, old, files)
                self.target = object_id if self.target == new else self.target

            self.undos.append(back)
            self.target = new if self.target == object_id else self.target

    def undo(self) -> None:
        """Take back the last press, deletion or new name."""
        with self.lock:
            if self.undos:
                self.undos[-1]()
                self.undos.pop()  # Only when it is done: what fails may be tried again.

    def live(self) -> dict[str, Any]:
        """The sensor as it is now, and what happened."""
        told = {"events": self.events[-12:], "said": len(self.events), "target": self.target, "busy": self.busy}
        return self.sensor.shown() | told

    # ---- rate ----

    def state(self, rater: str = "") -> dict[str, Any]:
        """What is in the folder, and one rater's ratings; those of all only for who has rated every object.

        An object without videos is not shown: there is nothing to rate. Its ratings stay in the folder.
        """
        videos = self.data.recorded()
        shown = {video["object_id"] for video in videos} - {"unknown"}
        rows = [row for row in self.data.ratings() if row["object_id"] in shown]
        own = [row for row in rows if row["rater"] == rater]
        blind = sum(all(row.values()) for row in own) < len(shown)
        return {
            "folder": str(self.data.videos.parent),
            "videos": videos,
            "properties": [p.model_dump(include={"name", "levels", "phrases"}) for p in self.data.properties],
            "ratings": own if blind else rows,
            "agreement": None if blind else self.data.agreement(rows),
            "undo": len(self.undos),
            "model": self.model.folder.name,
            "told": self.told,
        }

    def rate(self, rater: Text, object_id: Text, property: Text, level: Annotated[int, Body()]) -> None:
        """Write down one class."""
        with self.lock:
            self.data.rate(" ".join(rater.split()), object_id, property, level)

    def frames(self, file: str) -> dict[str, Any]:
        """Pictures of a video in contact, and their differences to the untouched gel."""
        touch = read_touch(self._video(file), SHOWN, quiet=0.0)
        shown = {"frames": touch.frames, "difference": touch.difference}
        return {name: [uri(picture, "jpeg") for picture in pictures] for name, pictures in shown.items()}

    def _video(self, file: str) -> Path:
        if file not in {video["file"] for video in self.data.recorded()}:
            raise UserError(f"{file}: no such video; load the page anew")
        return self.data.videos / file

    # ---- adapt and ask ----

    async def adapt(self) -> str:
        """Adapt the model to all rated videos, as a new copy beside the older ones, and ask that from now on.

        Heads are read from two rated objects on; with fewer it is adapted by all videos alone.
        """
        return str(await self.work(self._adapt))

    def _adapt(self) -> str:
        try:
            rated, model = len(self.data.rated()), self.load(None)
            catalogue = load_catalogue(self.data.catalogue) if rated > 1 else None
            every = {self.data.videos / video["file"]: video["object_id"] for video in self.data.recorded()}
            found = rated_videos([self.data.videos], catalogue) if catalogue else every
            for number, video in enumerate(found, 1):
                self.busy = f"reads video {number} of {len(found)}"
                model.look(video)
            self.busy = "fits the model to them"
            to = self.copies / time.strftime("%Y%m%d-%H%M%S")
            told = adapt(model, [*found], to, catalogue=catalogue, objects=[*found.values()])
            alone = f"Rated objects: {rated}. Ratings count from two on, so videos alone were used.\n"
            self.told = told if catalogue else alone + told
            self.model = self.load(str(to))
            return self.told
        finally:
            self.busy = ""

    async def press(self, file: str) -> Any:
        """Show a recorded press as the demo shows a video."""
        video = self._video(file)
        return await self.work(lambda: self.show(file, video))

    async def describe(self, touch: Text) -> Any:
        """The model's sentence on a touch that was shown."""
        (video,) = self._find([touch])
        return await self.work(lambda: self.model.describe(video).sentence)

    async def compare(self, a: Text, b: Text) -> Any:
        """Two shown touches by each property: the heads' expected classes, and the model's answer."""
        videos = self._find([a, b])
        return await self.work(lambda: [self.model.rank(videos, p).model_dump() for p in self.model.properties])


def make_studio(studio: Studio, token: str) -> FastAPI:
    """The demo's application with the studio's calls."""
    routes = APIRouter()
    changes = (studio.connect, studio.aim, studio.move, studio.rename, studio.undo, studio.rate)
    for act in (*changes, studio.adapt, studio.describe, studio.compare):
        routes.post(f"/api/{act.__name__}")(act)
    routes.get("/api/live")(studio.live)
    routes.get("/api/state")(studio.state)
    routes.get("/api/frames/{file:path}")(studio.frames)
    routes.put("/api/presses/{file:path}")(studio.press)
    return make_app(studio, routes, token)


def serve_studio(make: Callable[[], Studio], port: int) -> None:
    """Show the studio until it is interrupted; the address that is printed has the token that lets the page in.

    Raises:
        UserError: where the port, the folder or the model cannot be used.
    """
    with listen("127.0.0.1", port) as listening:
        token = secrets.token_urlsafe()
        app = make_studio(make(), token)
        address = f"http://127.0.0.1:{listening.getsockname()[1]}/studio.html#{token}"
        print(f"{address} shows the studio; Ctrl-C ends it", flush=True)
        with suppress(KeyboardInterrupt):
            make_server(app).run(sockets=[listening])
