"""The formats of the training text, from a dozen words a decision up to the pipeline's whole conversations.

In a short format the question stands next to its answer and many are asked about the same descriptions; a longer one
moves them apart. `curriculum.py` says in which order they are learnt.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterable, Sequence
from enum import IntEnum

from pipeline.prompts import TACTILE, render
from pipeline.records import Opd, Task, Turn
from pipeline.tasks import TASKS
from pipeline.tasks.base import LETTERS, ORDINALS, Draft
from standins.describing import Style, described, short, told_facts
from standins.documents import Builder, Document
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

MAIN = 2.0
"""Loss weight of what decides in a conversation's conclusion; a follow-up's is 1."""
REST = 0.3
"""Share of that weight for the other words of a conclusion."""


class Distance(IntEnum):
    """How far the asked word stands from its answer."""

    NONE = 0
    FILLED = 1
    CLOSE = 2
    CHAT = 3


def listing(world: World, style: Style, distance: Distance, rng: random.Random) -> Document:
    """Two or three descriptions, then every question that they answer."""
    compare = rng.random() < 0.5
    objects = _draw(world, 2 if compare else 3, rng)
    names = [f"{o} object:" for o in ORDINALS] if compare else [f"{letter})" for letter in LETTERS]
    builder = Builder(Task.PC if compare else Task.PSS)
    builder.given(" ".join(f"{n} {described(world, o, style, rng)}" for n, o in zip(names, objects, strict=True)))
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
    for word, ask, verdict in rng.sample(asked, min(at_most, len(asked))):
        at = distance if distance < Distance.CLOSE else rng.choice((distance, Distance(distance - 1)))
        if at < Distance.CLOSE:
            builder.given(f" {word}{rng.choice(ENDS) if at else ''}")
            first = verdict.split(")")[0].split()[0].rstrip(",")
            builder.decided(f" {first}", tested=tested)
            continue
        opening = f" USER: {ask}" if at == Distance.CHAT else f" {word}{rng.choice(('?', '.'))}"
        builder.given(f"{opening} ASSISTANT:{rng.choice(('', ' Conclusion:'))}")
        conclude(builder, verdict, tested=tested)


def comparisons(world: World, labels: Sequence[Labels]) -> list[tuple[str, str, str]]:
    """Asked word, question and verdict of every comparison of two objects, worded as the pipeline does."""
    asked = []
    for p, first, second in zip(world.catalogue.properties, *labels, strict=True):
        for word, rising in ((p.more, True), (p.less, False)):
            if first == second:
                verdict = f"Both objects have the same {p.name}."
            elif (first > second) == rising:
                verdict = f"Yes, the first object is {word}."
            else:
                verdict = f"No, the second object is {word}."
            asked.append((word, f"Is the first object {word} than the second?", verdict))
    return asked


def superlatives(world: World, labels: Sequence[Labels]) -> list[tuple[str, str, str]]:
    """Asked word, request and verdict of every superlative that one of three objects alone deserves."""
    asked = []
    for p, levels in zip(world.catalogue.properties, zip(*labels, strict=True), strict=True):
        for word, extreme in ((p.most, max(levels)), (p.least, min(levels))):
            if levels.count(extreme) == 1:
                verdict = f"{LETTERS[levels.index(extreme)]}) is the {word}."
                asked.append((word, f"Select the {word}.", verdict))
    return asked


def conclude(builder: Builder, verdict: str, *, weight: float = 1.0, tested: bool = True) -> None:
    """Append a verdict and the end token; the words that decide get `weight`, the others a part of it."""
    found = (list(re.finditer(pattern, verdict)) for pattern in DECISIONS)
    spans = [match.span(1) for match in next(filter(None, found))]
    text, position = f" {verdict}", 0
    for start, stop in spans:
        # The space before a word is part of its token.
        builder.said(text[position:start], REST * weight)
        builder.decided(text[start : stop + 1], weight, tested=tested)
        position = stop + 1
    builder.said(text[position:] + EOS, REST * weight)


def converse(
    world: World,
    task: Task,
    mode: Opd,
    rng: random.Random,
    *,
    style: Style = Style.FULL,
    slots: bool = False,
    facts: bool = False,
    follow_ups: bool = False,
    weight: float = 0.05,
) -> Document:
    """One of the pipeline's own conversations about made-up objects.

    Args:
        style: STRUCTURED leaves the free descriptions out; SHORT leaves the classes alone.
        slots: Say the classes where the video would be, instead of nothing.
        facts: Begin with what each object is like (for matching).
        follow_ups: Go on with short questions about the same objects.
        weight: Loss weight of descriptions.
    """
    draft = draw_draft(world, task, rng)
    turns = next(d.turns for d in draft.dialogues if d.opd == mode)
    shown = [short(world.catalogue, world.catalogue.labels(o)) if slots else "" for o in draft.objects]
    shown = iter(shown)  # type: ignore[assignment]
    told = f"{told_facts(world, draft.objects, rng)} " if facts else ""
    filled = [Turn(user=_fill(t.user, shown), assistant=_restyle(t.assistant, world, draft, style)) for t in turns]
    filled[0] = filled[0].model_copy(update={"user": told + filled[0].user})
    rendered = render(filled, system_prompt="", frames=0, eos=EOS, complete=True)
    builder, position = Builder(task), 0
    for number, (start, stop) in enumerate(rendered.answers, 1):
        builder.given(rendered.text[position:start])
        _answer(builder, rendered.text[start : stop - len(EOS)], task, number == len(turns), weight)
        position = stop
    if follow_ups and task in (Task.PC, Task.PSS):
        # Not tested: many easy ones would hide whether the first question, asked before the descriptions, is.
        ask_all(builder, world, draft.objects, Distance.CHAT, rng, at_most=rng.randint(1, 4), tested=False)
    return builder.build()


def draw_draft(world: World, task: Task, rng: random.Random) -> Draft:
    """A question of the pipeline's own making, of a random stratum."""
    definition = TASKS[task]
    while True:
        draft = definition.draft(world.pool, rng.randrange(definition.strata(world.catalogue)), rng)
        if draft is not None:
            return draft


def _answer(builder: Builder, text: str, task: Task, last: bool, weight: float) -> None:
    """Split an answer into its descriptions and its conclusion."""
    body, marker, verdict = text.rpartition(" Conclusion:")
    if marker:
        builder.said(body + marker, weight)
        conclude(builder, verdict.strip(), weight=MAIN)
    elif task == Task.OPD:
        free, overall, closing = text.rpartition(" Overall,")
        builder.said(free, weight)
        builder.decided(overall + closing + EOS, weight)
    elif not last:
        builder.said(text + EOS, weight)
    else:
        conclude(builder, text.strip(), weight=MAIN)


def matching(world: World, style: Style, rng: random.Random) -> Document:
    """Facts, descriptions, and for each letter its classes restated before its name."""
    objects = draw_draft(world, Task.POM, rng).objects
    catalogue = world.catalogue
    builder = Builder(Task.POM).given(told_facts(world, objects, rng))
    for letter, object_id in zip(LETTERS, objects, strict=True):
        builder.given(f" {letter}) {described(world, object_id, style, rng)}")
    for letter, object_id in rng.sample(list(zip(LETTERS, objects, strict=True)), 3):
        builder.said(f" {letter}) {short(catalogue, catalogue.labels(object_id))} is", 1.0)
        builder.decided(f" {catalogue.objects[object_id].name}").given(".")
    return builder.build()


def repetition(words: Sequence[str], rng: random.Random) -> Document:
    """Random words, then the same again: the skill that copying a name rests on."""
    chosen = " ".join(rng.choices(words, k=rng.randint(4, 12)))
    first, rest = chosen.split(" ", 1)
    builder = Builder("repetition").given(chosen)
    for _ in range(rng.randint(1, 2)):
        builder.given(f"{rng.choice('.,:')} {first}").decided(f" {rest}")
    return builder.build()


def _draw(world: World, count: int, rng: random.Random) -> list[str]:
    return rng.sample(world.pool.objects, count)


def _fill(user: str, shown: Iterable[str]) -> str:
    while TACTILE in user:
        user = user.replace(TACTILE, next(shown), 1)  # type: ignore[call-overload]
    return user


def _restyle(answer: str, world: World, draft: Draft, style: Style) -> str:
    """The answer with other descriptions in place of the full ones."""
    catalogue = world.catalogue
    for object_id in draft.objects:
        if style == Style.STRUCTURED:
            answer = answer.replace(f"{catalogue.unstructured(object_id)} ", "")
        elif style == Style.SHORT:
            answer = answer.replace(catalogue.describe(object_id), f"{short(catalogue, catalogue.labels(object_id))}.")
    return answer
