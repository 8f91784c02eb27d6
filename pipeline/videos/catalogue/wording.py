"""How a data set's properties are spoken of: the shape of properties.yaml, what must hold for it to be gradable, and
which classes a free text names."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from itertools import product
from string import Formatter
from typing import Annotated, Self

from pydantic import Field, model_validator

from pipeline.core.records import Record

OPENING = "Overall"
"""How the structured description begins: the grader reads an answer from its last such word on."""
TAKEN = ("object_id", "name", "material", "part_of", "part", "combined", "choice", "loss")
"""Columns of objects.csv and measures of the report; no property may bear one of these names."""
PREFIXES = ("label_", "split_", "ripeness_")

Phrase = Annotated[str, Field(pattern=r"\w")]


MARKUP = (
    ("[\u2018\u2019\u201a\u201b]", "'"),
    ("[\u2010-\u2015\u2212]", "-"),
    ("\u2192", "->"),
    (r"(?s)\A.*</think>|<think>.*|~~.*?~~", " "),  # Thoughts, which are not the answer, and what is struck out.
    (r"(?i)</?[a-z][^<>]*>", ""),
    (r"\\[a-zA-Z]+\s*(?=\{)|\\(?=\W)|[{}$*`\"\u201c-\u201f\xab\xbb\u200b-\u200d\ufeff]", ""),
    (r"(?m)^[\s>#+•-]*(?:\d+[.)]\s)?\s*", ""),  # Headings, lists, quoted lines.
    (r"(?<!\w)[_']+|[_']+(?!\w)", ""),
)
"""Patterns of markup and thoughts, which are not part of the answer, and their replacements."""


def unmarked(text: str) -> str:
    """As a person reads it: without Markdown, LaTeX, HTML, quotes or thoughts, and with keyboard signs."""
    text = unicodedata.normalize("NFKC", text)
    for pattern, instead in MARKUP:
        text = re.sub(pattern, instead, text)
    return text.strip()


def plain(text: str) -> str:
    """In small letters and unmarked, with one space wherever spaces, line breaks or hyphens stood."""
    return " ".join(re.split(r"[\s-]+", unmarked(text).lower()))


def mentioned(text: str, phrases: Iterable[str]) -> list[str]:
    """The phrases (as `plain` writes them) that a text holds, longest first.

    Each stretch of text counts once, for the longest phrase: "no roughness" is not also "roughness", and "moderately
    hard" not also "hard", whatever stands between its words.
    """
    rest, found = plain(text), []
    for phrase in sorted(set(map(plain, phrases)), key=lambda p: (-len(p), p)):
        rest, times = re.subn(rf"(?<!\w){re.escape(phrase)}(?!\w)", "|", rest)
        found += [phrase] if times else []
    return found


class Property(Record):
    """One physical property with its ordered classes and the words for them."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    levels: tuple[Phrase, ...] = Field(min_length=2)
    more: Phrase
    less: Phrase
    most: Phrase
    least: Phrase
    alone: str
    phrases: tuple[tuple[Phrase, ...], ...]
    cues: tuple[tuple[Phrase, ...], ...] = ()
    """By class, words by which a text of another author names it; empty, or one tuple (also an empty one) a class."""

    @property
    def spoken(self) -> str:
        """The name as a sentence has it."""
        return self.name.replace("_", " ")

    @property
    def wordings(self) -> dict[str, int]:
        """Every wording of a class, plain, with that class: its name, its phrases and its cues."""
        return {plain(word): level for level, word in self._words()}

    def _words(self) -> list[tuple[int, str]]:
        cues = self.cues or ((),) * len(self.levels)
        of_levels = enumerate(zip(self.levels, self.phrases, cues, strict=True))
        return [(level, word) for level, (name, phrases, more) in of_levels for word in (name, *phrases, *more)]

    @model_validator(mode="after")
    def _name_is_free_and_words_fit(self) -> Self:
        if self.name in TAKEN or self.name.startswith(PREFIXES):
            raise ValueError(
                f"{self.name}: no name for a property, nor is {', '.join(TAKEN)} or what begins with "
                f"{' or '.join(PREFIXES)}; rename it"
            )
        if len(self.phrases) != len(self.levels) or not all(self.phrases):
            raise ValueError(f"{self.name}: phrases need one non-empty list a level")
        if self.cues and len(self.cues) != len(self.levels):
            raise ValueError(f"{self.name}: cues need one list a level (an empty one where there are none)")
        if _placeholders(self.alone) != {"level"}:
            raise ValueError(f"{self.name}: alone must hold {{level}} and no other placeholder")
        for level, word in self._words():
            if self.wordings[plain(word)] != level:
                raise ValueError(f"{self.name}: {word!r} stands for two levels; keep it at one")
        return self


class Scenario(Record):
    """A situation and the classes that suit it (PSR)."""

    name: str
    question: str
    source: str = ""
    """Whose reading of the situation the classes are; `questions.scenarios` chooses among them. Empty: always asked."""
    object: str | None = None
    target: dict[str, tuple[int, ...]] = Field(min_length=1)
    other: dict[str, tuple[int, ...]] = Field(min_length=1)


class Language(Record):
    """Everything in properties.yaml."""

    dataset: str = ""
    """The published data set that the catalogue is of; empty for any other."""
    properties: tuple[Property, ...] = Field(min_length=1)
    unstructured: str
    structured: str
    scenarios: tuple[Scenario, ...] = ()

    @model_validator(mode="after")
    def _templates_scenarios_and_classes_fit(self) -> Self:
        classes = {p.name: range(len(p.levels)) for p in self.properties}
        if len(classes) < len(self.properties):
            raise ValueError(f"properties {', '.join(p.name for p in self.properties)}: a name stands twice")
        for template in (self.unstructured, self.structured):
            there = _placeholders(template)
            if missing := classes.keys() - there:
                raise ValueError(f"template {template!r} does not name {', '.join(sorted(missing))}")
            if unknown := there - classes.keys():
                raise ValueError(f"template {template!r} names {', '.join(sorted(unknown))}, which is no property")
        if not self.structured.startswith((f"{OPENING} ", f"{OPENING},")):
            raise ValueError(f"structured must begin with {OPENING!r}: answers are read from that word on")
        for scenario in self.scenarios:
            for name, levels in (*scenario.target.items(), *scenario.other.items()):
                if name not in classes:
                    raise ValueError(f"scenario {scenario.name}: unknown property {name}")
                if not levels or not set(levels) <= set(classes[name]):
                    most = len(classes[name]) - 1
                    raise ValueError(
                        f"scenario {scenario.name}: {name} is {list(levels)}; allowed: classes from 0 to {most}"
                    )
        # An answer names all properties in one sentence, so no class may be read where another property is meant.
        around = "|".join(text for text, *_ in Formatter().parse(self.structured))
        for p in self.properties:
            others = [(q.name, word) for q in self.properties if q is not p for word in q.levels]
            for level, (where, word) in product(p.levels, (*others, ("structured", around))):
                if mentioned(word, [level]):
                    raise ValueError(
                        f"{p.name}: class {level!r} can also be read in {where} ({word!r}), so no answer could be "
                        "graded; choose other words"
                    )
        return self


def levels_named(text: str, prop: Property) -> frozenset[int]:
    """The classes that a text names by their names, phrases or cues; empty where it is silent about the property."""
    wordings = prop.wordings
    return frozenset(wordings[phrase] for phrase in mentioned(text, wordings))


def _placeholders(template: str) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(template) if name is not None}
