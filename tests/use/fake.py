"""A model of the contract's shape that needs no weights, a server in a thread, and requests in OpenAI's form."""

import hashlib
import itertools
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pipeline.config import FramesConfig
from pipeline.running.errors import UserError
from pipeline.use.encoding import Verdict
from pipeline.use.frames import read_touch
from pipeline.use.model import with_marks
from pipeline.use.results import Description, Touch, Video
from pipeline.use.server import listen, make_server
from tests.conftest import HUNG, ROOT
from tests.project import ENVIRONMENT
from tests.use.videos import uri

CHAT = "/v1/chat/completions"
KEPT = 5
LEVELS = {"hardness": ("soft", "hard"), "roughness": ("smooth", "slightly rough", "rough")}


def digest(data: bytes | Path) -> str:
    return hashlib.sha256(data.read_bytes() if isinstance(data, Path) else data).hexdigest()[:8]


class FakeOctopi:
    """Answers `question | history | digest of each video`, word by word; `{tactile}` must fit as in the real one.

    `threads` are those that its work was done in; with a `gate`, it waits for that behind each word.
    """

    name = "finetuned-with-all-0"
    config = SimpleNamespace(heads=True)
    doubts = ("it is a fake",)

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self.threads: set[int] = set()
        self.tokens: list[int | None] = []
        self.asked = self.made = 0
        self.gate: threading.Event | None = None

    def look(self, video: Path) -> Touch:
        self.threads.add(threading.get_ident())
        settings = FramesConfig(pixels=96, fraction=0.15, per_video=KEPT, selection="contact")
        return read_touch(video, settings, quiet=0.0)

    def describe(self, video: Video, *, sentence: bool = True) -> Description:
        share = {p: {level: 1 / 2 ** (i + 1) for i, level in enumerate(names)} for p, names in LEVELS.items()}
        levels = {p: names[0] for p, names in LEVELS.items()}
        return Description(levels=levels, probabilities=share, sentence="It is soft.", frames=(1, 2), notes=())

    def verdict(self, question: str, videos: Sequence[Any]) -> Verdict | None:
        return Verdict("soft", "soft (50%)") if videos else None

    def apart(self, answer: str, heads: Verdict | None) -> tuple[str, ...]:
        return ("the sentence and the heads disagree",) if heads and "soft" not in answer else ()

    def doubts_about(self, question: str, videos: int) -> tuple[str, ...]:
        return (*self.doubts, *(("it compares one video",) if "softer" in question and videos == 1 else ()))

    def notes(self, videos: Sequence[Any], question: str = "") -> tuple[str, ...]:
        """As the real one's: behind the name of a file."""
        return tuple(f"{video}: little touches the sensor" for video in videos)

    def stream(
        self, question: str, videos: Sequence[Path] = (), *, history: Sequence[Any] = (), max_new_tokens: Any = None
    ) -> Iterator[str]:
        self.asked += 1
        self.threads.add(threading.get_ident())
        self.tokens.append(max_new_tokens)
        question = with_marks(question, len(videos))
        if "blank" in question:
            raise UserError(f"{videos[0]}: 12 frames show no touch; record it again")
        if question == "break":
            raise RuntimeError("a secret of /home/somebody")
        before = [f"{h.question}>{h.answer}:{','.join(map(digest, h.videos))}" for h in history]
        words = " | ".join([question, *before, *map(digest, videos)]).split(" ")
        for word in itertools.repeat("on") if question == "endless" else words:
            time.sleep(self.seconds)
            self.made += 1
            yield f"{word} "
            if self.gate is not None:
                self.gate.wait(HUNG)
            if word == "late":
                raise UserError("the touch ended; send another")
            if word == "crash":
                raise RuntimeError("a secret of /home/somebody")


@contextmanager
def running(app: Any) -> Iterator[int]:
    """A server of an application in a thread; its port."""
    with listen("127.0.0.1", 0) as listening:
        there = make_server(app)
        thread = threading.Thread(target=there.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            there.should_exit = True
            thread.join(HUNG)
            assert not thread.is_alive()


class Running:
    """A command that serves until it is ended, as a user starts it: its process, address and what else it says."""

    def __init__(self, *words: object, folder: Path = ROOT) -> None:
        command = [Path(sys.executable).with_name("octopi"), *words, "--device", "cpu", "--port", "0"]
        self.process = subprocess.Popen(
            [*map(str, command)], cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True,
            # What a shell starts in the background ignores it, and so would what is started here.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        assert self.process.stdout is not None
        self.address, _, self.rest = self.process.stdout.readline().partition(" ")

    def end(self) -> None:
        self.process.kill()
        self.process.wait(HUNG)


def part(data: bytes, kind: str = "video_url") -> dict[str, Any]:
    return {"type": kind, kind: {"url": uri(data)}}


def text(words: str) -> dict[str, Any]:
    return {"type": "text", "text": words}


def user(*content: Any) -> dict[str, Any]:
    return {"role": "user", "content": content[0] if isinstance(content[0], str) else list(content)}


def body(*messages: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"model": "octopi", "messages": list(messages), **more}


def events(content: str) -> list[Any]:
    """Server-sent events by the WHATWG's grammar: `data:` lines, a blank line behind each event."""
    assert content.endswith("\n\n")
    found = [line.removeprefix("data: ") for line in content.split("\n\n")[:-1]]
    assert all("\n" not in event for event in found)
    return [event if event == "[DONE]" else json.loads(event) for event in found]


def said(response: Any) -> str:
    """The answer in a whole response, or in the text of a streamed one."""
    if not isinstance(response, str):
        return str(response["choices"][0]["message"]["content"])
    return "".join(e["choices"][0]["delta"].get("content", "") for e in events(response) if e != "[DONE]")
