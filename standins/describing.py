"""How the generated text describes objects, from bare classes to the pipeline's full description."""

from __future__ import annotations

import random
from collections.abc import Iterable
from enum import IntEnum

from pipeline.videos.catalogue import Catalogue, Property
from standins.world import Labels, World

FILLERS = (" It presents", " The surface feels", " Overall,", " There are", " It is")


class Style(IntEnum):
    """How an object is described."""

    SHORT = 0
    FILLED = 1
    STRUCTURED = 2
    FULL = 3
    FREE = 4
    """The object's own sentence alone: its wordings stand for the classes."""


def short(catalogue: Catalogue, labels: Labels) -> str:
    """The classes alone, e.g. "hard, smooth, no bumps"."""
    return ", ".join(p.levels[level] for p, level in zip(catalogue.properties, labels, strict=True))


def shuffled(catalogue: Catalogue, labels: Labels, rng: random.Random) -> str:
    """The classes alone, in any order."""
    words = [p.levels[level] for p, level in zip(catalogue.properties, labels, strict=True)]
    return ", ".join(rng.sample(words, len(words)))


def described(world: World, object_id: str, style: Style, rng: random.Random) -> str:
    """An object in one of the styles, ending in a full stop."""
    catalogue = world.catalogue
    labels = catalogue.labels(object_id)
    match style:
        case Style.SHORT:
            return f"{short(catalogue, labels)}."
        case Style.FILLED:
            return "".join([*rng.choices(FILLERS, k=rng.randint(0, 2)), f" {short(catalogue, labels)}."]).strip()
        case Style.STRUCTURED:
            return catalogue.structured(labels)
        case Style.FREE:
            return catalogue.unstructured(object_id)
    return catalogue.describe(object_id)


def property_words(properties: Iterable[Property]) -> list[str]:
    """The words of several words that become one token: classes, comparatives, superlatives."""
    said = [w for p in properties for w in (*p.levels, p.more, p.less, p.most, p.least)]
    return [w for w in said if " " in w]
