"""The world that the tiny language model reads about: made-up objects with random properties, and situations."""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict

import pipeline.physiclear
from pipeline.physiclear.catalogue import Catalogue, Object, Property, Scenario, load_catalogue
from pipeline.records import Part
from pipeline.tasks.base import Pool
from standins.settings import FOLDER

Labels = tuple[int, ...]


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
    return load_catalogue(Path(pipeline.physiclear.__file__).parent)


@cache
def forbidden_descriptions() -> frozenset[str]:
    """The free descriptions of the test objects, which no training text may hold."""
    real = real_catalogue()
    return frozenset(real.unstructured(o.object_id) for o in real.objects.values() if o.splits["paper"] == Part.TEST)


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


def make_world(combos: Sequence[Labels], scenarios: Sequence[Scenario], rng: random.Random, size: int = 30) -> World:
    """A world of made-up objects with random properties among `combos` and names of an adjective and a noun."""
    situations = load_situations()
    objects: dict[str, Object] = {}
    language = real_catalogue().language.model_copy(update={"scenarios": tuple(scenarios)})
    while len(objects) < size:
        name = f"{rng.choice(situations.adjectives)} {rng.choice(situations.nouns)}"
        article = "an" if name[0] in "aeiou" else "a"
        entry = Object.model_construct(
            object_id=f"{name} {rng.getrandbits(20)}",
            name=f"{article} {name}",
            material="",
            part_of="",
            part="",
            splits={},
            ratings=tuple((level,) for level in rng.choice(combos)),
        )
        draft = Catalogue.model_construct(language=language, objects={entry.object_id: entry})
        if draft.unstructured(entry.object_id) not in forbidden_descriptions():
            objects[entry.object_id] = entry
    catalogue = Catalogue.model_construct(language=language, objects=objects)
    return World(Pool(part=Part.TRAIN, catalogue=catalogue, videos={o: [o] for o in objects}))


@cache
def questions(kind: Literal["training", "seen", "unseen"]) -> tuple[Scenario, ...]:
    """Scenarios for training, of seen kinds in a wording kept for the gate, and of unseen kinds."""
    situations, properties = load_situations(), {p.name: p for p in real_catalogue().properties}
    scenarios = []
    for need in situations.situations:
        prop = properties[need.property]
        level = need.level(prop)
        chosen = need.situations[-1:] if kind == "unseen" else need.situations[:-1]
        openings = (situations.held_out_opening,) if kind == "seen" else situations.openings
        for situation, opening in itertools.product(chosen, openings):
            others = tuple(i for i in range(len(prop.levels)) if i != level)
            question = opening.format(situation=situation)
            scenarios.append(
                Scenario(name=situation, question=question, target={prop.name: (level,)}, other={prop.name: others})
            )
    return tuple(scenarios)


def fact(rng: random.Random) -> str:
    """A sentence that ties a situation to a class of a property."""
    situations, properties = load_situations(), {p.name: p for p in real_catalogue().properties}
    need = rng.choice(situations.situations)
    prop = properties[need.property]
    word = prop.levels[need.level(prop)]
    text = rng.choice(situations.facts).format(situation=rng.choice(need.situations), word=_attribute(word))
    return text[0].upper() + text[1:]


def _attribute(word: str) -> str:
    return f"with {word}" if " bumps" in word else word
