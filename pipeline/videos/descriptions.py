"""What a free description says about a property, judged by the words that properties.yaml lists for its classes."""

from __future__ import annotations

from pipeline.videos.phrases import mentioned
from pipeline.videos.wording import Property


def levels_named(text: str, prop: Property) -> frozenset[int]:
    """The classes that a text names by their names, phrases or cues; empty where it is silent about the property."""
    wordings = prop.wordings
    return frozenset(wordings[phrase] for phrase in mentioned(text, wordings))


def contradiction(text: str, prop: Property, label: int) -> frozenset[int]:
    """The classes that a text names in place of `label`; empty where it names that one too, or none."""
    named = levels_named(text, prop)
    return frozenset() if label in named else named
