"""Texts from which matching of objects to names is learnt: copying first, then by what the objects are like."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum

from pipeline.tasks.base import LETTERS
from standins.asking import conclude
from standins.conversing import draw_draft, tell
from standins.describing import Style, described, short
from standins.documents import UNKNOWN, Builder, Document, Hint
from standins.world import World


class Reach(IntEnum):
    """How far an object's name stands from its description."""

    FACT = 0
    """There is no description: a fact is said once more."""
    BESIDE = 1
    RESTATED = 2
    """After all descriptions, the classes said again before each name."""
    CONCLUDED = 3
    """After all descriptions, as the pipeline concludes."""


def matching(world: World, style: Style, reach: Reach, rng: random.Random) -> Document:
    """Facts about three named objects, descriptions, and which is which."""
    objects = draw_draft(world, "POM", rng).objects
    catalogue = world.catalogue
    hints = [Hint(labels=catalogue.labels(o)) for o in objects]
    names = [catalogue.objects[o].name for o in objects]
    owned = [Hint(named=hint.labels) for hint in hints]
    builder = Builder("POM")
    for number, object_id in enumerate(rng.sample(objects, len(objects))):
        tell(builder, world, object_id, " " if number else "")
    for number, (letter, object_id) in enumerate(zip(LETTERS, objects, strict=True)):
        if reach > Reach.FACT:
            text = f" {letter}) {described(world, object_id, style, rng)}"
            builder.given(text, replace(hints[number], thing=number))
        if reach == Reach.BESIDE:
            builder.given(" It is", hints[number]).decided(f" {names[number]}", hint=owned[number]).given(".")
    if reach == Reach.CONCLUDED:
        builder.given(" Conclusion:")
        said = [f"{letter}) is {name}" for letter, name in zip(LETTERS, names, strict=True)]
        numbered = [Hint(thing=number, recalled=hint.labels) for number, hint in enumerate(hints)]
        conclude(builder, f"{said[0]}, {said[1]} and {said[2]}.", hints=numbered)
    elif reach != Reach.BESIDE:
        for number in rng.sample(range(3), 3):
            if reach == Reach.RESTATED:
                builder.given(f" {LETTERS[number]})", Hint(thing=number))
            restated = f" {short(catalogue, catalogue.labels(objects[number]))}"
            builder.said(restated, 1.0 if reach == Reach.RESTATED else 0.0).given(" is", hints[number])
            builder.decided(f" {names[number]}", hint=owned[number]).given(".")
    return builder.build()


def matching_one(world: World, rng: random.Random) -> Document:
    """Facts that name one property's classes only, said once more in another order."""
    index, prop = rng.choice(list(enumerate(world.catalogue.properties)))
    count = rng.randint(2, len(prop.levels))
    names = [world.catalogue.objects[o].name for o in rng.sample(world.pool.objects, count)]
    told = list(zip(rng.sample(range(len(prop.levels)), count), names, strict=True))
    builder = Builder("POM")
    for number, (level, name) in enumerate(told):
        labels = tuple(level if i == index else UNKNOWN for i in range(len(world.catalogue.properties)))
        builder.given(f"{' ' if number else ''}{prop.levels[level]} is", Hint(labels=labels))
        builder.given(f" {name}.", Hint(named=labels, copied=True))
    for level, name in rng.sample(told, count):
        labels = tuple(level if i == index else UNKNOWN for i in range(len(world.catalogue.properties)))
        builder.given(f" {prop.levels[level]} is", Hint(labels=labels)).decided(f" {name}", hint=Hint(named=labels))
        builder.given(".")
    return builder.build()


def repetition(words: Sequence[str], rng: random.Random) -> Document:
    """Random words, then the same again: the skill that copying a name rests on."""
    chosen = " ".join(rng.choices(words, k=rng.randint(3, 12)))
    first, rest = chosen.split(" ", 1)
    hint = Hint(copied=True)
    builder = Builder("repetition").given(chosen, hint)
    for _ in range(rng.randint(1, 3)):
        builder.given(f"{rng.choice('.,:')} {first}", hint).decided(f" {rest}", hint=hint)
    return builder.build()
