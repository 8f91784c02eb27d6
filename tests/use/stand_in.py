"""A stand-in for the trained model in the demo, which answers at once with what it was asked."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import FramesConfig
from pipeline.core.errors import UserError
from pipeline.use.model import with_marks
from pipeline.use.results import Description, Exchange, Touch, Video
from pipeline.videos.files import VideoFile
from pipeline.videos.frames.scan import Scan, scan
from tests.conftest import HUNG

KEPT = 5
LEVELS = {"hardness": ("soft", "hard"), "roughness": ("smooth", "slightly rough", "rough")}


class FakeOctopi:
    """`threads` are those that its work was done in; `heard` is every question with its files and history."""

    name = "finetuned-with-all-0"

    def __init__(self) -> None:
        self.threads: set[int] = set()
        self.heard: list[tuple[str, list[str], list[Exchange]]] = []
        self.paused = threading.Event()
        self.made = 0

    def look(self, video: Video) -> Touch:
        self.threads.add(threading.get_ident())
        assert isinstance(video, str | os.PathLike)
        path = Path(video)
        found = scan(
            VideoFile(path, str(path), "x", "x_0"), FramesConfig(pixels=96, fraction=0.15, selection="contact")
        )
        if not isinstance(found, Scan):
            raise UserError(f"{path}: {found.measured}")
        frames = np.stack([kept.image for kept in found.kept])
        difference = 128 + (frames.astype(int) - found.reference) // 2
        return Touch(
            frames=frames,
            numbers=tuple(kept.index for kept in found.kept),
            reference=found.reference,
            difference=np.clip(difference, 0, 255).astype(np.uint8),
            contact=0.25,
            strength=found.probe.contact,
            notes=(),
        )

    def describe(self, video: Video, *, sentence: bool = True) -> Description:
        share = {p: {level: 1 / 2 ** (i + 1) for i, level in enumerate(names)} for p, names in LEVELS.items()}
        levels = {p: names[0] for p, names in LEVELS.items()}
        return Description(levels=levels, probabilities=share, sentence="It is soft.", frames=(1, 2), notes=())

    def notes(self, videos: Sequence[Video]) -> tuple[str, ...]:
        return tuple(f"{video}: little touches the sensor" for video in videos)

    def stream(
        self, question: str, videos: Sequence[Video] = (), *, history: Sequence[Exchange] = (), **_: Any
    ) -> Iterator[str]:
        self.threads.add(threading.get_ident())
        question = with_marks(question, len(videos))
        self.heard.append((question, [Path(str(v)).name for v in videos], list(history)))
        for piece in (*question.replace("{tactile}", "it").split(), f"<b>{len(history)}</b>"):
            self.made += 1
            yield f"{piece} "
            if "wait" in question:
                self.paused.wait(HUNG)
        if "break" in question:
            raise ValueError("within")
