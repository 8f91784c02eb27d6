"""The pipeline's own conversations about made-up objects, cut into pieces to be learnt and tested."""

from __future__ import annotations

import random
import re
from dataclasses import dataclass, replace

from pipeline.language.chat import TACTILE, vicuna
from pipeline.records import Opd, Turn
from pipeline.tasks import TASKS
from pipeline.tasks.base import Draft
from pipeline.tasks.pom import fact
from standins.asking import Distance, ask_all, conclude
from standins.describing import Style, short, shuffled
from standins.documents import UNKNOWN, Builder, Document, Hint
from standins.vocabulary import EOS
from standins.world import World, misread

MAIN = 2.0
"""Loss weight of what decides in a conversation's conclusion; a follow-up's is 1."""
RESTATED = "restated"
"""The decisions that a conversation about several objects makes where it says the classes in their slots."""
PLAIN = 0.05
"""Loss weight of words that describe; they can be foreseen in part only."""
VIDEOS, FACTS = "\ue000\ue001\ue002", "\ue010\ue011\ue012"
"""Stand where videos and facts go until the conversation is rendered; no text of the pipeline holds them."""


@dataclass(frozen=True)
class Manner:
    """How a conversation is put."""

    style: Style = Style.FULL
    slots: bool = False
    """Say the classes where the videos would be, instead of nothing."""
    blended: bool = False
    """Put the classes' words there all at once, as one vector several times over, instead of one after the other."""
    restating: float = 1.0
    """Loss weight of the classes said in descriptions whose slots hold them."""
    facts: bool = False
    """Begin with what each object is like (for matching)."""
    misread: bool = False
    """Feel some objects a class off what they are like."""
    follow_ups: int = 0
    """At most so many short questions about the same objects after the conversation."""


def draw_draft(world: World, task: str, rng: random.Random) -> Draft:
    """A question of the pipeline's own making, of a random stratum."""
    definition = TASKS[task]
    while True:
        draft = definition.draft(world.pool, rng.randrange(definition.strata(world.catalogue)), rng)
        if draft is not None:
            return draft


def converse(world: World, task: str, mode: Opd, rng: random.Random, manner: Manner = Manner()) -> Document:
    """One conversation of a task under an OPD mode."""
    draft = draw_draft(world, task, rng)
    felt = misread(world, draft.objects, rng) if manner.misread else world
    turns = [t for d in draft.dialogues if d.opd == mode for t in d.turns]
    told = f"{' '.join(rng.sample(FACTS, len(FACTS)))} " if manner.facts else ""
    filled = [
        Turn(user=_mark(t.user), assistant=_restyle(t.assistant, world, felt, draft, manner.style)) for t in turns
    ]
    filled[0] = filled[0].model_copy(update={"user": told + filled[0].user})
    rendered = vicuna(filled, "", EOS, complete=True)
    writer, position = _Writer(Builder(task), felt, world, draft, manner, rng), 0
    for start, stop in rendered.answers:
        writer.question(rendered.text[position:start])
        writer.answer(rendered.text[start : stop - len(EOS)])
        position = stop
    if manner.follow_ups and len(draft.objects) == (2 if task == "PC" else 3):
        # Not tested: many easy ones would hide whether the first question, asked before the descriptions, is.
        count = rng.randint(1, manner.follow_ups)
        ask_all(writer.builder, world, draft.objects, Distance.CHAT, rng, at_most=count, tested=False)
    return writer.builder.build()


@dataclass
class _Writer:
    builder: Builder
    world: World
    """As it is felt."""
    told: World
    """As it is."""
    draft: Draft
    manner: Manner
    rng: random.Random
    asked: int = UNKNOWN

    def question(self, text: str) -> None:
        """Append what is read before an answer, with the classes in the videos' places."""
        self.asked = asked_number(self.world, self.builder.kind, text, self.asked)
        # The space before a word is part of its token.
        for part in re.split(f"( ?[{VIDEOS}{FACTS}])", text):
            if part and part[-1] in VIDEOS:
                self._slot(part[:-1], VIDEOS.index(part[-1]))
            elif part and part[-1] in FACTS:
                tell(self.builder, self.told, self.draft.objects[FACTS.index(part[-1])], part[:-1])
            else:
                self.builder.given(part, Hint(asked=self.asked) if text.endswith(part) else Hint())

    def _slot(self, space: str, number: int) -> None:
        catalogue, hint = self.world.catalogue, Hint(thing=number)
        labels = catalogue.labels(self.draft.objects[number])
        if not self.manner.slots:
            self.builder.given(space)
        elif self.manner.blended:
            words = [p.levels[level] for p, level in zip(catalogue.properties, labels, strict=True)]
            self.builder.given(space, hint).blended(words, replace(hint, labels=labels))
        else:
            either = (short(catalogue, labels), shuffled(catalogue, labels, self.rng))
            self.builder.given(space + self.rng.choice(either), replace(hint, labels=labels))

    def answer(self, text: str) -> None:
        """Append an answer: its descriptions and its conclusion."""
        body, marker, verdict = text.rpartition(" Conclusion:")
        if marker:
            self._describe(body)
            self.builder.said(marker, PLAIN, Hint(asked=self.asked))
            self._conclude(verdict.strip())
        elif self.asked == UNKNOWN and self.builder.kind != "POM":
            self._describe(text)
            self.builder.said(EOS, PLAIN)
        else:
            self._conclude(text.strip())

    def _conclude(self, verdict: str) -> None:
        hints = [Hint(asked=self.asked)]
        if self.builder.kind == "POM":
            labels = map(self.world.catalogue.labels, self.draft.objects)
            hints = [Hint(thing=number, recalled=each) for number, each in enumerate(labels)]
        conclude(self.builder, verdict, weight=MAIN, hints=hints)

    def _describe(self, text: str) -> None:
        parts = re.split(r"((?:^| )(?:First object:|Second object:|[abc]\)))", text)
        if len(parts) == 1:
            self._describe_one(text, 0)
        for number, (prefix, body) in enumerate(zip(parts[1::2], parts[2::2], strict=True)):
            self.builder.said(prefix, PLAIN, Hint(thing=number))
            self._describe_one(body, number)

    def _describe_one(self, text: str, number: int) -> None:
        """The classes' words are decisions where a slot tells them."""
        labels = self.world.catalogue.labels(self.draft.objects[number])
        known, position = self.manner.slots, 0
        thing = Hint(thing=number if len(self.draft.objects) > 1 else UNKNOWN)
        words = "|".join(w for p in self.world.catalogue.properties for w in sorted(p.levels, key=len, reverse=True))
        # Only the closing sentence names classes as such; the free one may hold the same words in its phrases.
        closing = max(text.rfind("Overall"), 0)
        kind = "OPD" if self.builder.kind == "OPD" else RESTATED
        found = list(re.compile(rf" ({words})(?!\w)").finditer(text, closing))
        for match in found:
            self.builder.said(text[position : match.start()], PLAIN, thing)
            weight = self.manner.restating if known else PLAIN
            self.builder.decided(match[0], weight, kind=kind, tested=known, hint=thing)
            position = match.end()
        whole = len(found) == len(labels) or self.manner.style == Style.FREE
        self.builder.said(text[position:], PLAIN, Hint(thing=thing.thing, labels=labels if whole else ()))


def tell(builder: Builder, world: World, object_id: str, space: str = " ") -> None:
    """Append the fact about an object."""
    labels = world.catalogue.labels(object_id)
    classes, name = fact(world.catalogue, object_id)
    builder.given(space + classes, Hint(labels=labels)).given(name, Hint(named=labels, copied=True))


def asked_number(world: World, task: str, text: str, before: int = UNKNOWN) -> int:
    """Which property and direction a question asks for: twice the property's number, plus one for the lower end."""
    properties = world.catalogue.properties
    if task == "PSR":
        for scenario in world.catalogue.language.scenarios:
            if scenario.question in text:
                name, (level, *_) = next(iter(scenario.target.items()))
                return 2 * world.catalogue.property_index(name) + (level == 0)
        return before
    ends = {"PC": ("more", "less"), "PSS": ("most", "least")}.get(task, ())
    for index, p in enumerate(properties):
        for falling, end in enumerate(ends):
            if f" {getattr(p, end)}" in text:
                return 2 * index + falling
    return before


def _mark(user: str) -> str:
    for mark in VIDEOS:
        user = user.replace(TACTILE, mark, 1)
    return user


def _restyle(answer: str, world: World, felt: World, draft: Draft, style: Style) -> str:
    """The answer with other descriptions, of what is felt, in place of the full ones."""
    replaced = {world.catalogue.describe(o): _styled(felt, o, style) for o in draft.objects}
    # All at once: what one object feels like may be how another is described.
    return re.sub("|".join(map(re.escape, replaced)), lambda found: replaced[found[0]], answer)


def _styled(world: World, object_id: str, style: Style) -> str:
    catalogue = world.catalogue
    match style:
        case Style.STRUCTURED:
            return catalogue.structured(catalogue.labels(object_id))
        case Style.SHORT:
            return f"{short(catalogue, catalogue.labels(object_id))}."
        case Style.FREE:
            return catalogue.unstructured(object_id)
    return catalogue.describe(object_id)
