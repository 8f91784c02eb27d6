"""What an answer says of each object before it concludes, and whether that is right."""

from __future__ import annotations

import re

from pipeline.records import Prediction, Question
from pipeline.tasks.base import LETTERS, ORDINALS, find_level
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.descriptions import levels_named
from pipeline.videos.wording import OPENING, Property

Classes = tuple[tuple[int | None, ...], ...]
"""Object by object, the class of each property that the question asks about; None where none was named, or several."""

_MARK = re.compile(rf"\b({'|'.join(ORDINALS)}) object\s*:|\b([{LETTERS}])\)", flags=re.IGNORECASE)


def read_descriptions(question: Question, prediction: Prediction, catalogue: Catalogue) -> Classes | None:
    """The classes that an answer names, of what the question asks about.

    Args:
        question: With two objects or more; a description alone has nothing to conclude.

    Returns:
        None where the objects are not described one after the other, each once.
    """
    described = re.split(r"conclusion\s*:", prediction.outputs[0], flags=re.IGNORECASE)[0]
    marks = list(_MARK.finditer(described))
    said = [(m[1] or m[2]).lower() for m in marks]
    if said not in (list(LETTERS[: len(question.objects)]), [o.lower() for o in ORDINALS[: len(question.objects)]]):
        return None
    ends = [m.start() for m in marks[1:]] + [len(described)]
    asked = [p for p in catalogue.properties if p.name in question.gold.properties]
    return tuple(tuple(_level(described[m.end() : end], p) for p in asked) for m, end in zip(marks, ends, strict=True))


def described_right(question: Question, prediction: Prediction, catalogue: Catalogue) -> bool | None:
    """Whether all that a question asks about is described as labelled; None where that is not said, or unreadable."""
    read = read_descriptions(question, prediction, catalogue)
    if read is None or any(level is None for levels in read for level in levels):
        return None
    places = [i for i, p in enumerate(catalogue.properties) if p.name in question.gold.properties]
    return read == tuple(tuple(labels[i] for i in places) for labels in question.gold.labels)


def _level(text: str, prop: Property) -> int | None:
    """Read from the first "Overall" on, since `needed` has such a sentence a property; without one, by all wordings."""
    closing = re.search(rf"\b{OPENING}\b", text, flags=re.IGNORECASE)
    if closing:
        return find_level(text[closing.end() :], prop)
    named = levels_named(text, prop)
    return next(iter(named)) if len(named) == 1 else None
