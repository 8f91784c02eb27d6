"""The world that the tiny language model reads about: made-up objects with random properties, and situations."""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict

import pipeline
from pipeline.records import Part
from pipeline.runtime import derive_seed
from pipeline.tasks.base import Pool
from pipeline.videos.catalogue import Catalogue, Object, Property, Scenario, load_catalogue
from standins.settings import FOLDER
from standins.vocabulary import words_of

Labels = tuple[int, ...]
ODD_NAMES = 0.4
"""Share of training's names that are made of any words."""
PLAIN_NAMES = 0.6
"""Share of the other names that are an adjective and a noun; the rest name a part or an amount of something."""
MISREAD = 0.7
"""Share of objects that `misread` tries to feel wrongly."""
MISREADINGS = 40
"""Tries before it feels everything as it is."""
UNSEEN = 2
"""Situations at the end of each list that are told as facts and never asked about."""
JOINTS = (" ", " ", " ", "'s ", "' ", " of ", " of a ", " on a ")
"""What stands between the words of a name that nobody foresees."""
ARTICLES = ("a", "an")


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Need(_Entry):
    """Situations that ask for the highest (`most`) or lowest class of one property."""

    property: str
    wanted: Literal["most", "least"]
    situations: tuple[str, ...]

    def level(self, prop: Property) -> int:
        """The class that suits."""
        return len(prop.levels) - 1 if self.wanted == "most" else 0


class Situations(_Entry):
    """Everything in situations.yaml."""

    adjectives: tuple[str, ...]
    nouns: tuple[str, ...]
    openings: tuple[str, ...]
    held_out_opening: str
    facts: tuple[str, ...]
    situations: tuple[Need, ...]
    words: tuple[str, ...]


@cache
def load_situations() -> Situations:
    """Read situations.yaml."""
    return Situations.model_validate(yaml.safe_load((FOLDER / "situations.yaml").read_text(encoding="utf-8")))


@cache
def real_catalogue() -> Catalogue:
    """The catalogue whose words the pipeline speaks."""
    return load_catalogue(Path(pipeline.__file__).parent / "physiclear")


@cache
def forbidden_descriptions() -> frozenset[str]:
    """The free descriptions of the test objects, which no training text may hold."""
    real = real_catalogue()
    return frozenset(real.unstructured(o.object_id) for o in real.objects.values() if o.splits["paper"] == Part.TEST)


@cache
def spare_words() -> tuple[str, ...]:
    """Words for names that nobody foresees: all of the catalogue's names but those that join or begin one, and more."""
    texts = [o.name for o in real_catalogue().objects.values()] + list(load_situations().words)
    return tuple(sorted(words_of(texts) - words_of((*JOINTS, *ARTICLES))))


@cache
def held_out_name(adjective: str, noun: str) -> bool:
    """Whether these two words make a name only where the model is tested: one pair in six."""
    return derive_seed("name", adjective, noun) % 6 == 0


@dataclass(frozen=True)
class World:
    """Objects to ask about, as the pipeline's tasks see them."""

    pool: Pool

    @property
    def catalogue(self) -> Catalogue:
        """The objects and the words for them."""
        return self.pool.catalogue


def combinations(held_out: Sequence[Labels], *, held: bool) -> tuple[Labels, ...]:
    """The property combinations of training, or those kept for the gate."""
    counts = [range(len(p.levels)) for p in real_catalogue().properties]
    return tuple(c for c in itertools.product(*counts) if (c in set(held_out)) == held)


def make_world(
    combos: Sequence[Labels], scenarios: Sequence[Scenario], rng: random.Random, *, held: bool, size: int = 30
) -> World:
    """A world of made-up objects with random properties among `combos`; `held`: with names kept out of training."""
    objects: dict[str, Object] = {}
    language = real_catalogue().language.model_copy(update={"scenarios": tuple(scenarios)})
    taken = {o.name for o in real_catalogue().objects.values()}
    while len(objects) < size:
        name = _draw_name(rng, held)
        entry = Object.model_construct(
            object_id=f"{name} {rng.getrandbits(20)}",
            name=name,
            material="",
            part_of="",
            part="",
            splits={},
            ratings=tuple((level,) for level in rng.choice(combos)),
        )
        draft = Catalogue.model_construct(language=language, objects={entry.object_id: entry})
        if name not in taken and draft.unstructured(entry.object_id) not in forbidden_descriptions():
            taken.add(name)
            objects[entry.object_id] = entry
    catalogue = Catalogue.model_construct(language=language, objects=objects)
    return World(Pool(part=Part.TRAIN, catalogue=catalogue, videos={o: [o] for o in objects}))


def _draw_name(rng: random.Random, held: bool) -> str:
    situations = load_situations()
    if not held and rng.random() < ODD_NAMES:
        return _odd_name(rng)
    while True:
        words = [rng.choice(situations.adjectives), rng.choice(situations.nouns)]
        if held_out_name(*words) == held:
            break
    whole, part = " ".join(words), rng.choice(situations.nouns)
    if rng.random() < PLAIN_NAMES:
        return _with_article(whole)
    forms = (
        f"{_with_article(whole)}'s {part}",
        f"{_with_article(part)} of {whole}",
        f"the {rng.choice(situations.adjectives)} {part} of {_with_article(whole)}",
        f"the {part} of {_with_article(whole)}'s {rng.choice(situations.nouns)}",
    )
    return rng.choice(forms)


def _odd_name(rng: random.Random) -> str:
    """Any words in any order, now and then joined as in names of parts: whoever copies these can copy every name."""
    words = rng.choices((*spare_words(), *load_situations().nouns), k=rng.randint(1, 4))
    name = words[0]
    for word in words[1:]:
        name += rng.choice(JOINTS) + word
    return name if rng.random() < 0.1 else _with_article(name)


def _with_article(name: str) -> str:
    return f"{ARTICLES[name[0] in 'aeiou']} {name}"


def misread(world: World, objects: Sequence[str], rng: random.Random) -> World:
    """The world as touch may feel it: a property or two of some of these objects are a class off.

    Of all ways to tell them apart the right one fits best still, and alone; no combination is felt that none of the
    world's objects has.
    """
    catalogue = world.catalogue
    known = {catalogue.labels(o) for o in catalogue.objects}
    truth = [catalogue.labels(o) for o in objects]
    for _ in range(MISREADINGS):
        felt = [_nudged(labels, rng) if rng.random() < MISREAD else labels for labels in truth]
        possible = len(set(felt)) == len(felt) and known.issuperset(felt)
        if possible and felt != truth and _fits_alone(felt, truth):
            entries = dict(catalogue.objects)
            for object_id, labels in zip(objects, felt, strict=True):
                ratings = tuple((level,) for level in labels)
                entries[object_id] = entries[object_id].model_copy(update={"ratings": ratings})
            changed = Catalogue.model_construct(language=catalogue.language, objects=entries)
            return World(replace(world.pool, catalogue=changed))
    return world


def _fits_alone(felt: Sequence[Labels], truth: Sequence[Labels]) -> bool:
    costs = [sum(map(_distance, felt, order)) for order in itertools.permutations(truth)]
    # The first permutation is the order as it is.
    return all(cost > costs[0] for cost in costs[1:])


def _nudged(labels: Labels, rng: random.Random) -> Labels:
    felt = list(labels)
    for index in rng.sample(range(len(labels)), rng.choice((1, 1, 2))):
        highest = len(real_catalogue().properties[index].levels) - 1
        felt[index] = min(highest, max(0, felt[index] + rng.choice((-1, 1))))
    return tuple(felt)


def _distance(one: Labels, other: Labels) -> int:
    return sum(abs(a - b) for a, b in zip(one, other, strict=True))


@cache
def questions(kind: Literal["training", "seen", "unseen"]) -> tuple[Scenario, ...]:
    """Scenarios for training, of seen kinds in a wording kept for the gate, and of unseen kinds."""
    openings = load_situations().openings if kind != "seen" else (load_situations().held_out_opening,)
    return _scenarios(openings, unseen=kind == "unseen")


def wording(rng: random.Random) -> str:
    """An opening of random words, with a place for the situation."""
    opening = [rng.choice(("Which", "What", "Here", "Someone")), *_filler(rng), "{situation}", *_filler(rng)]
    return " ".join(opening) + rng.choice("?.")


def reworded(world: World, rng: random.Random) -> World:
    """The same world, its scenarios asked for in random words: whoever answers these reads the situation alone."""
    language = world.catalogue.language.model_copy(update={"scenarios": _scenarios((wording(rng),), unseen=False)})
    catalogue = Catalogue.model_construct(language=language, objects=world.catalogue.objects)
    return World(replace(world.pool, catalogue=catalogue))


def _filler(rng: random.Random) -> list[str]:
    return rng.choices(spare_words(), k=rng.randint(0, 4))


def _scenarios(openings: Sequence[str], *, unseen: bool) -> tuple[Scenario, ...]:
    situations, properties = load_situations(), {p.name: p for p in real_catalogue().properties}
    scenarios = []
    for need in situations.situations:
        prop = properties[need.property]
        level = need.level(prop)
        chosen = need.situations[-UNSEEN:] if unseen else need.situations[:-UNSEEN]
        for situation, opening in itertools.product(chosen, openings):
            others = tuple(i for i in range(len(prop.levels)) if i != level)
            question = opening.format(situation=situation)
            scenarios.append(
                Scenario(name=situation, question=question, target={prop.name: (level,)}, other={prop.name: others})
            )
    return tuple(scenarios)


@dataclass(frozen=True)
class Fact:
    """A sentence that ties a situation to a class of a property, cut after the situation and around the class."""

    opening: str
    middle: str
    word: str
    end: str
    asked: int
    """Property and direction, as `documents.Hint` numbers them."""
    situation: str
    joint: str
    """What stands between "something" and the class."""


def draw_fact(rng: random.Random) -> Fact:
    """A fact about any situation, those that are never asked about included."""
    situations, catalogue = load_situations(), real_catalogue()
    need = rng.choice(situations.situations)
    index = catalogue.property_index(need.property)
    prop = catalogue.properties[index]
    situation, word = rng.choice(need.situations), prop.levels[need.level(prop)]
    before, after = rng.choice(situations.facts).split("{word}")
    # The space before a word is part of its token.
    opening, middle = before.removesuffix(" ").split("{situation}")
    opening += situation
    joint = " with" if " bumps" in word else ""
    asked = 2 * index + (need.wanted == "least")
    return Fact(opening[0].upper() + opening[1:], middle + joint, f" {word}", after, asked, situation, joint)
