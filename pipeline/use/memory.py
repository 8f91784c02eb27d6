"""A memory of touches: an object that was touched once is recognised, without training.

A folder holds one file, touches.jsonl, with a line for each touch. Octopi-1.5, the next paper, calls it retrieval.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from filelock import FileLock
from pydantic import ValidationError

from pipeline.core.io import write_jsonl
from pipeline.core.records import Record
from pipeline.running.errors import UserError, first_problem

TOUCHES = "touches.jsonl"


class Remembered(Record):
    """One touch of a named object."""

    name: str
    classes: tuple[str, ...]
    """What the property heads said, in the catalogue's order."""
    encoder: str
    """Whose embedding it is; another encoder's says nothing beside it."""
    embedding: tuple[float, ...]
    """The mean over its frames, before the property heads."""


class Similar(Record):
    """A remembered object, beside a video."""

    name: str
    similarity: float
    """Cosine of the two embeddings, -1 to 1; of several touches of the object, the largest."""
    classes: tuple[str, ...]
    """Of that touch."""


def remember(folder: Path, touch: Remembered) -> int:
    """Add a touch to a memory, which is made where there is none.

    Returns:
        How many touches it has now.

    Raises:
        UserError: for an empty name, a broken file, or a memory of another encoder.
    """
    if not touch.name.strip():
        raise UserError("the name is empty; call the object something")
    file = folder / TOUCHES
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / f".{TOUCHES}.lock"):  # Two at once would lose one.
        touches = recall(folder, touch.encoder) if file.exists() and file.stat().st_size else []
        write_jsonl(file, [*touches, touch])
    return len(touches) + 1


def recall(folder: Path, encoder: str) -> list[Remembered]:
    """All touches of a memory.

    Raises:
        UserError: where there is no memory, its file is broken, or another encoder wrote it.
    """
    file, touches = folder / TOUCHES, list[Remembered]()
    for number, line in enumerate(file.read_bytes().splitlines() if file.is_file() else (), 1):
        try:
            touches.append(Remembered.model_validate_json(line))
        except ValidationError as error:
            raise UserError(f"{file}, line {number}: is no touch ({first_problem(error)}); remove the line") from None
    if not touches:
        raise UserError(f"{folder}: no memory of touches; `octopi remember NAME VIDEO --memory {folder}` begins one")
    if any(touch.encoder != encoder for touch in touches):
        raise UserError(f"{file}: another encoder's; remember its touches anew, in another folder")
    return touches


def most_similar(embedding: np.ndarray, touches: list[Remembered]) -> tuple[Similar, ...]:
    """Remembered objects, the most similar first.

    Args:
        embedding: dim values, as `Remembered.embedding`.
    """
    known = np.array([touch.embedding for touch in touches])
    lengths = np.linalg.norm(known, axis=1) * np.linalg.norm(embedding)
    cosines = known @ embedding / np.where(lengths > 0, lengths, 1)
    found: dict[str, Similar] = {}
    for place in np.argsort(-cosines, kind="stable"):
        touch = touches[place]
        found.setdefault(touch.name, Similar(name=touch.name, similarity=float(cosines[place]), classes=touch.classes))
    return tuple(found.values())
