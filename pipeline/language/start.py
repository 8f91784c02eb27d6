"""Which objects a language model has met that another training begins with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pipeline.config import LANGUAGE_DIR
from pipeline.core.io import read_json
from pipeline.core.records import Part
from pipeline.running.errors import UserError

OBJECTS_FILE = "objects.json"
"""Beside an aligned model: what `objects_met` found."""


def objects_met(start: str, parts: Mapping[str, Part]) -> list[str]:
    """Ids of the objects that a training meets, with those that the model in `language.start` met before.

    That model's are in its config.json, or else all of its catalogue's. One that is a test object is a UserError, since
    scores would be of what the model knows.
    """
    met = {name for name, part in parts.items() if part in (Part.TRAIN, Part.VALIDATION)}
    if start:
        if not (Path(start) / LANGUAGE_DIR).is_dir():
            raise UserError(f"language.start: {start} holds no trained model; name a folder of models/")
        said = read_json(Path(start) / "config.json").get("objects")
        known = set(said or read_json(Path(start) / "catalogue.json")["objects"])
        if tested := sorted(name for name in known if parts.get(name) is Part.TEST):
            raise UserError(
                f"language.start: {start} knows {tested[0]}, which is a test object; name a model that does not (of "
                "folds, the same fold's), or choose another split"
            )
        met |= known
    return sorted(met)
