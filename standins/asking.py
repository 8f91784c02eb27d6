"""Questions about described objects, from one word beside its answer up to a turn of the chat.

In a short format the question stands next to its answer and many are asked about the same descriptions; a longer one
moves them apart. `curriculum.py` says in which order they are learnt.
"""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from pipeline.tasks.base import LETTERS, ORDINALS
from standins.describing import Style, described
from standins.documents import NOTHING, Builder, Document, Hint
from standins.vocabulary import EOS
from standins.world import Labels, World

ENDS = ("?", ".", " ASSISTANT:", " Conclusion:", " ASSISTANT: Conclusion:", "? ASSISTANT:", " than the second?")
DECISIONS = (
    r"^(Yes|No|Both)\b",
    r"^([abc])(?=\) is the [\w ]+\.$)",
    r"object is ([ab])(?=\))",
    r"[abc]\) is (.+?)(?=, b\)| and c\)|\.$)",
)
"""What decides in a verdict; the first pattern that occurs is the verdict's own."""
REST = 0.3
"""Share of a deciding word's loss weight for the other words of a conclusion."""


class Distance(IntEnum):
    """How far the asked word stands from its answer."""

    NONE = 0
    FILLED = 1
    CLOSE = 2
    CHAT = 3


@dataclass(frozen=True)
class Asked:
    """A question that some labels answer: its word, wording and verdict, and the number of what it asks for."""

    word: str
    question: str
    verdict: str
    number: int


def listing(world: World, style: Style, distance: Distance, rng: random.Random) -> Document:
    """Two or three descriptions, then every question that they answer."""
    compare = rng.random() < 0.5
    objects = rng.sample(world.pool.objects, 2 if compare else 3)
    names = [f"{o} object:" for o in ORDINALS] if compare else [f"{letter})" for letter in LETTERS]
    builder = Builder("PC" if compare else "PSS")
    for number, (name, object_id) in enumerate(zip(names, objects, strict=True)):
        hint = Hint(thing=number, labels=world.catalogue.labels(object_id))
        builder.given(f"{' ' if number else ''}{name} {described(world, object_id, style, rng)}", hint)
    ask_all(builder, world, objects, distance, rng)
    return builder.build()


def ask_all(
    builder: Builder,
    world: World,
    objects: Sequence[str],
    distance: Distance,
    rng: random.Random,
    *,
    at_most: int = 6,
    tested: bool = True,
) -> None:
    """Append the questions about two objects (comparatives) or three (superlatives) in random order."""
    labels = [world.catalogue.labels(o) for o in objects]
    asked = comparisons(world, labels) if len(objects) == 2 else superlatives(world, labels)
    for ask in rng.sample(asked, min(at_most, len(asked))):
        hint = Hint(asked=ask.number)
        at = distance if distance < Distance.CLOSE else rng.choice((distance, Distance(distance - 1)))
        if at < Distance.CLOSE:
            builder.given(f" {ask.word}{rng.choice(ENDS) if at else ''}", hint)
            first = ask.verdict.split(")")[0].split()[0].rstrip(",")
            builder.decided(f" {first}", tested=tested)
            continue
        opening = f" USER: {ask.question}" if at == Distance.CHAT else f" {ask.word}{rng.choice(('?', '.'))}"
        builder.given(f"{opening} ASSISTANT:{rng.choice(('', ' Conclusion:'))}", hint)
        conclude(builder, ask.verdict, tested=tested)


def comparisons(world: World, labels: Sequence[Labels]) -> list[Asked]:
    """Every comparison of two objects, worded as the pipeline does."""
    asked = []
    for index, (p, first, second) in enumerate(zip(world.catalogue.properties, *labels, strict=True)):
        for falling, word in enumerate((p.more, p.less)):
            if first == second:
                verdict = f"Both objects have the same {p.name}."
            elif (first < second) == bool(falling):
                verdict = f"Yes, the first object is {word}."
            else:
                verdict = f"No, the second object is {word}."
            asked.append(Asked(word, f"Is the first object {word} than the second?", verdict, 2 * index + falling))
    return asked


def superlatives(world: World, labels: Sequence[Labels]) -> list[Asked]:
    """Every superlative that one of three objects alone deserves."""
    asked = []
    for index, (p, levels) in enumerate(zip(world.catalogue.properties, zip(*labels, strict=True), strict=True)):
        for falling, (word, extreme) in enumerate(((p.most, max(levels)), (p.least, min(levels)))):
            if levels.count(extreme) == 1:
                verdict = f"{LETTERS[levels.index(extreme)]}) is the {word}."
                asked.append(Asked(word, f"Select the {word}.", verdict, 2 * index + falling))
    return asked


def conclude(
    builder: Builder, verdict: str, *, weight: float = 1.0, tested: bool = True, hints: Sequence[Hint] = ()
) -> None:
    """Append a verdict and the end token; the words that decide get `weight`, the others a part of it.

    `hints` are for what stands before each deciding word.
    """
    found = (list(re.finditer(pattern, verdict)) for pattern in DECISIONS)
    spans = [match.span(1) for match in next(filter(None, found))]
    text, position = f" {verdict}", 0
    for number, (start, stop) in enumerate(spans):
        # The space before a word is part of its token.
        builder.said(text[position:start], REST * weight, hints[number] if hints else NOTHING)
        name = Hint(recalled=hints[number].recalled) if hints else NOTHING
        builder.decided(text[start : stop + 1], weight, tested=tested, hint=name)
        position = stop + 1
    builder.said(text[position:] + EOS, REST * weight)
