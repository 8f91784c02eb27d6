"""A model of the contract's shape that needs no weights, and a server in a thread."""

from __future__ import annotations

import hashlib
import itertools
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.core.errors import UserError
from pipeline.use.model import with_marks
from pipeline.use.server import listen, make_server
from tests.conftest import HUNG


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:8]


class FakeOctopi:
    """Answers `question | history | digest of each video`, word by word; `{tactile}` must fit as in the real one."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self.name = "fake"
        self.threads: set[int] = set()
        self.tokens: list[int | None] = []
        self.asked = 0
        self.gate: threading.Event | None = None

    def notes(self, videos: Sequence[Any], question: str = "") -> tuple[str, ...]:
        """As the real one's: behind the name of a file."""
        return tuple(f"{video}: little touches the sensor" for video in videos)

    def stream(
        self,
        question: str,
        videos: Sequence[Any] = (),
        *,
        history: Sequence[Any] = (),
        max_new_tokens: int | None = None,
    ) -> Iterator[str]:
        self.asked += 1
        self.threads.add(threading.get_ident())
        self.tokens.append(max_new_tokens)
        question = with_marks(question, len(videos))
        if "blank" in question:
            raise UserError(f"{videos[0]}: 12 frames show no touch; record it again")
        if question == "break":
            raise RuntimeError("a secret of /home/somebody")
        words = self.words(question, [Path(v).read_bytes() for v in videos], history).split(" ")
        for word in itertools.repeat("on") if question == "endless" else words:
            if self.gate is not None:
                self.gate.wait(HUNG)
            time.sleep(self.seconds)
            yield f"{word} "
            if word == "late":
                raise UserError("the touch ended; send another")
            if word == "crash":
                raise RuntimeError("a secret of /home/somebody")

    def words(self, question: str, videos: Sequence[bytes], history: Sequence[Any] = ()) -> str:
        shown = [",".join(digest(Path(v).read_bytes()) for v in h.videos) for h in history]
        before = [f"{h.question}>{h.answer}:{seen}" for h, seen in zip(history, shown, strict=True)]
        return " | ".join([question, *before, *map(digest, videos)])


@contextmanager
def running(app: Any) -> Iterator[int]:
    """A server of an application in a thread; its port."""
    with listen("127.0.0.1", 0, "") as listening:
        there = make_server(app)
        thread = threading.Thread(target=there.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            there.should_exit = True
            thread.join(HUNG)
            assert not thread.is_alive()
