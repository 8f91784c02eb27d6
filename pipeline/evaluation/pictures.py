"""What a vision-language model is shown in place of a tactile video: frames of it, or photos of its object."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2

from pipeline.core.records import Question
from pipeline.running.errors import UserError
from pipeline.training.sampling import sample_evaluation
from pipeline.videos.frames.store import FrameStore

Show = Callable[[str], list[str]]
"""From a video's id to the pictures that stand for it, as URLs with all of their data."""
PHOTO_SUFFIXES = (".jpeg", ".jpg", ".png", ".webp")
LONGEST = 1024
"""Pixels of a photo's longer side that are sent at most."""


def frames(folder: Path, questions: Sequence[Question], most: int) -> Show:
    """Those frames of a video that every variant is given, as PNG: what was kept, bit by bit."""
    store = FrameStore(folder)

    def show(video: str) -> list[str]:
        if not (count := len(store.rows(video))):
            raise UserError(f"{folder}: no frame of {video}; run `dvc repro extract_frames`")
        return [_url(frame[..., ::-1], "png") for frame in store.pictures(video, _places(count, most))]

    return show


def photos(folder: Path, questions: Sequence[Question], most: int) -> Show:
    """Photos of the object that was touched in a video."""
    found: dict[str, list[Path]] = {}
    for video, name in sorted({pair for q in questions for pair in zip(q.videos, q.objects, strict=True)}):
        # Those named after it, and those in the folder of its name.
        files = [*folder.glob(f"{name}.*"), *(folder / name).glob("[!.]*")]
        found[video] = sorted(f for f in files if f.suffix.lower() in PHOTO_SUFFIXES)
        if not found[video]:
            kinds = ", ".join(PHOTO_SUFFIXES)
            raise UserError(f"{folder}: no photo of {name}; put {name}.jpg or a folder {name}/ there ({kinds})")

    def read(file: Path) -> str:
        if (photo := cv2.imread(str(file))) is None:  # Upright, as its camera was held.
            raise UserError(f"{file}: not a picture that can be read; replace it")
        scale = min(1.0, LONGEST / max(photo.shape[:2]))
        return _url(cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), "jpeg")

    return lambda video: [read(found[video][i]) for i in _places(len(found[video]), most)]


def _places(count: int, most: int) -> list[int]:
    return sorted({*sample_evaluation(count, most)})


def _url(picture: cv2.typing.MatLike, kind: str) -> str:
    """A picture of rows x columns x BGR; encoded anew, it has no metadata."""
    data = cv2.imencode(f".{kind}", picture)[1].tobytes()
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
