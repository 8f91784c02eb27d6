"""A model of the contract's shape that needs no weights: it says what it was asked and what it was given."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:8]


class FakeOctopi:
    """Answers `question | history | digest of each video`, word by word; `{tactile}` must fit as in the real one."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self.card = {"variant": "fake"}
        self.threads: set[int] = set()
        self.tokens: list[int | None] = []
        self.asked = 0
        self.gate: threading.Event | None = None

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
        if question.count("{tactile}") != len(videos):
            raise UserError(f"{question.count('{tactile}')} {{tactile}} and {len(videos)} videos; give one each")
        if question == "blank {tactile}":
            raise UserError(f"{videos[0]}: 12 frames show no touch; record it again")
        if question == "break":
            raise RuntimeError("a secret of /home/somebody")
        for word in self.words(question, [Path(v).read_bytes() for v in videos], history).split(" "):
            if self.gate is not None:
                self.gate.wait(20)
            time.sleep(self.seconds)
            yield f"{word} "
            if word == "late":
                raise UserError("the touch ended; send another")

    def words(self, question: str, videos: Sequence[bytes], history: Sequence[Any] = ()) -> str:
        before = [
            f"{h.question}>{h.answer}:{','.join(digest(Path(v).read_bytes()) for v in h.videos)}" for h in history
        ]
        return " | ".join([question, *before, *map(digest, videos)])
