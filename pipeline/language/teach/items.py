"""What is taught: questions about invented things whose qualities are told in words.

Items have four forms. A plain one compares things by one of the catalogue's properties, in one wording. One of several
properties tells all of them in that wording, often behind looser words. A short one is about any one property, asks
more and is worded in many ways. A whole one has all of this. The wordings stand in words.yaml. Everything is drawn from
a random generator, so nothing needs to be stored.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml

from pipeline.records import Record, Turn

OURS = ("hardness", "roughness", "bumpiness")
"""Properties that the catalogue of PhysiCLeAR rates too. Items in one wording are about them, as are half of others."""
COUNTS = {"compare": 2, "which": 2, "same": 2, "need": 2}
"""Things of an item; three for all other kinds."""
LETTERS = ("a)", "b)", "c)")
SYLLABLES = (
    *("bal", "bim", "dop", "fen", "gar", "hul", "jin", "kov", "lur", "mip"),
    *("nor", "pel", "quo", "rix", "sab", "tem", "vop", "wug", "yal", "zib"),
)

Form = Literal["plain", "several", "short", "whole"]
FEW = {"compare": 4, "extreme": 4, "which": 2}
SEVERAL = FEW | {"need": 3}
MANY = {"compare": 5, "which": 2, "extreme": 9, "same": 1, "pair": 1, "odd": 1, "match": 4, "need": 4}
KINDS: dict[Form, dict[str, int]] = {
    "plain": FEW,
    "several": SEVERAL,
    "short": MANY,
    "whole": MANY | {"match": 2, "sort": 2},
}
"""Kinds of questions (words.yaml says what each asks), by how often they come."""
ONE_WORDING = ("plain", "several")
KEPT = ("needs", "hints", "answers", "answer_as", "tell", "therefore")
"""Of these, items of several properties have every wording: they say another thing, or stand where a task's do."""
ONE_PROPERTY = ("plain", "short")
STYLES = {
    "several": ("list", "sentence", "twice"),
    "short": ("list", "sentence"),
    "whole": ("list", "list", "sentence", "twice"),
}
PLACES = {"plain": (10, 0, 8, 2), "several": (7, 0, 9, 4), "short": (13, 5, 2, 0), "whole": (9, 4, 7, 3)}
"""How often each place comes. Plain items have most of them: the shortest are learnt in the least time."""
FORMED = {"which", "extreme", "need"}
"""Kinds whose questions may say in which form the answer is wanted."""
FOLLOW_UPS = {"several": 3, "whole": 5}
"""At most so many further questions about the same things, in turns of their own or, ahead of an answer that begins by
describing, in one list: a description costs more than a question about it."""

Place = Literal["behind", "ahead", "told", "earlier"]
"""Where a question stands: behind the descriptions; ahead of them; alone, so that the answer begins by describing, as
the tasks' answers do; in a second turn, when the descriptions are the first turn's answer."""


class Topic(Record):
    """One property and its words."""

    levels: tuple[tuple[str, ...], ...]
    more: tuple[str, ...]
    less: tuple[str, ...]
    most: tuple[str, ...]
    least: tuple[str, ...]
    needs: dict[Literal["low", "high"], tuple[str, ...]]
    verb: Literal["is", "has"] = "is"


class Words(Record):
    """Everything in words.yaml."""

    properties: dict[str, Topic]
    questions: dict[str, tuple[str, ...]]
    before: tuple[str, ...]
    therefore: tuple[str, ...]
    tell: tuple[str, ...]
    loosely: tuple[str, ...]
    finally_: tuple[str, ...]
    hints: dict[str, tuple[str, ...]]
    answers: tuple[str, ...]
    answer_as: tuple[str, ...]


@cache
def words(form: Form = "whole") -> Words:
    """The words of the teaching text, of which plain items have the first wording of everything alone.

    Items of several properties have all of `KEPT` as well.
    """
    read = yaml.safe_load(Path(__file__).with_name("words.yaml").read_text(encoding="utf-8"))
    kept = KEPT if form == "several" else ()
    return Words.model_validate(_first_wordings(read, kept) if form in ONE_WORDING else read)


def _first_wordings(part: Any, kept: Sequence[str]) -> Any:
    if isinstance(part, dict):
        return {key: value if key in kept else _first_wordings(value, kept) for key, value in part.items()}
    if isinstance(part, list):
        return part[:1] if isinstance(part[0], str) else [_first_wordings(wordings, kept) for wordings in part]
    return part


def held_out(levels: Sequence[int]) -> bool:
    """Whether this combination of classes is never taught: every third one, each class of each property among them.

    Args:
        levels: The class of each property, in the order of the catalogue.
    """
    return sum((1 + i % 2) * level for i, level in enumerate(levels)) % 3 == 0


@dataclass(frozen=True)
class Item:
    """A conversation, of whose answers only what they conclude is learnt."""

    kind: str
    turns: tuple[Turn, ...]


@dataclass(frozen=True)
class Things:
    """What an item is about: things with labels, and the level of each topic."""

    labels: tuple[str, ...]
    """As a list has them: "First:"."""
    names: tuple[str, ...]
    """As a question has them: "the first"."""
    answers: tuple[str, ...]
    topics: tuple[str, ...]
    levels: tuple[Mapping[str, int], ...]
    words: Words


def draw(rng: random.Random, form: Form, *, held: bool = False, further: bool = False) -> Item:
    """Draw an item.

    Args:
        held: About combinations of our properties that are never taught, in place of those that may be.
        further: With further questions about the same things, in turns of their own, where the form has them.
    """
    kinds = KINDS[form]
    while True:
        kind = rng.choices(list(kinds), list(kinds.values()))[0]
        things = _things(rng, COUNTS.get(kind, 3), form, held)
        topic = rng.choice(things.topics)
        asked = _ask(kind, things, topic, rng) if _allowed(things, held) else None
        if asked is None:
            continue
        place: Place = "behind"
        if kind not in ("match", "sort"):
            place = rng.choices(("behind", "ahead", "told", "earlier"), PLACES[form])[0]
        # By their text, so that nothing is asked twice.
        more = dict([asked])
        for _ in range(FOLLOW_UPS.get(form, 0) if further else 0):
            asks = ("compare", "extreme", "need")[: 5 - len(things.levels)]
            again = _ask(rng.choice(asks), things, rng.choice(things.topics), rng)
            if again is not None:
                more[again[0]] = again[1]
        if place == "told" and len(more) > 1 and rng.random() < 0.7:
            # A description is long, and so more is concluded from it.
            questions, answers = (_numbered(texts) for texts in (more.keys(), more.values()))
            more = {questions: answers}
        first, *later = more.items()
        chosen, style = _wordings(things, rng), rng.choice(STYLES.get(form, ("list",)))
        described = " ".join(_describe(label, things, i, chosen, style, rng) for i, label in enumerate(things.labels))
        turns = _place(*first, described, place, things.words, rng)
        turns += [Turn(user=question, assistant=answer) for question, answer in later]
        return Item(kind, tuple(turns))


def _things(rng: random.Random, count: int, form: Form, held: bool) -> Things:
    own, simple = words(form), form in ONE_WORDING
    every, ours = list(own.properties), simple or rng.random() < 0.5
    if form in ONE_PROPERTY:
        topics = [rng.choice(OURS if ours else every)]
    elif held or simple:
        topics = list(OURS)
    else:
        topics = [*OURS, *rng.sample(every, 1)] if ours else rng.sample(every, rng.choice((2, 3, 4)))
    topics = list(dict.fromkeys(topics))
    rng.shuffle(topics)
    levels = tuple({topic: rng.randrange(3) for topic in topics} for _ in range(count))
    scheme = rng.choices(("ordinals", "letters", "names"), (2, 2, 0 if simple else 1))[0]
    if scheme == "ordinals":
        places, noun = ("first", "second", "third"), "" if form == "plain" else rng.choice(("", " one", " thing"))
        labels, names = tuple(f"{p.capitalize()}{noun}:" for p in places), tuple(f"the {p}{noun}" for p in places)
        answers = tuple(f"The {p}." for p in places)
    elif scheme == "letters":
        labels = names = answers = LETTERS
    else:
        names = tuple(invent(rng, 3))
        labels, answers = tuple(f"{n}:" for n in names), tuple(f"{n}." for n in names)
    return Things(labels[:count], names[:count], answers[:count], tuple(topics), levels, own)


def invent(rng: random.Random, count: int) -> list[str]:
    """Different names that mean nothing."""
    parts = rng.sample(SYLLABLES, 2 * count)
    return ["".join(pair).capitalize() for pair in zip(parts[::2], parts[1::2], strict=True)]


def _allowed(things: Things, held: bool) -> bool:
    """Whether no thing mixes what is taught and what is held out."""
    if not set(OURS) <= set(things.topics):
        return True
    return all(held_out([levels[name] for name in OURS]) == held for levels in things.levels)


def _ask(kind: str, things: Things, topic: str, rng: random.Random) -> tuple[str, str] | None:
    """A question and its answer; None where these things leave no clear one."""
    own, rising = things.words.properties[topic], rng.random() < 0.5
    levels = [thing[topic] for thing in things.levels]
    order = rng.sample(range(len(levels)), len(levels))
    x, y = order[:2]
    fields = {"x": things.names[x], "y": things.names[y], "noun": topic}
    fields["more"] = rng.choice(own.more if rising else own.less)
    fields["most"] = rng.choice(own.most if rising else own.least)
    answer: str | None = None
    if kind == "compare":
        answer = "Both alike." if levels[x] == levels[y] else "Yes." if (levels[x] > levels[y]) == rising else "No."
    elif kind == "same":
        answer = "Yes." if levels[x] == levels[y] else "No."
    elif kind in ("which", "extreme", "need"):
        ends = [i for i, level in enumerate(levels) if level == (max(levels) if rising else min(levels))]
        answer = things.answers[ends[0]] if len(ends) == 1 else "Neither." if kind == "which" else None
        fields["need"] = rng.choice(own.needs["high" if rising else "low"])
        if kind == "need" and levels[ends[0]] != (2 if rising else 0):
            answer = None
    elif kind in ("pair", "odd"):
        alone = [i for i, level in enumerate(levels) if levels.count(level) == 1]
        if len(alone) == 1:
            pair = [name for i, name in enumerate(things.names) if i != alone[0]]
            answer = things.answers[alone[0]] if kind == "odd" else f"{pair[0][0].upper()}{pair[0][1:]} and {pair[1]}."
    elif kind == "match" and len({tuple(thing.values()) for thing in things.levels}) == len(levels):
        fields["thing"] = _describe("", things, x, _wordings(things, rng), rng.choice(("list", "sentence")), rng)
        answer = things.answers[x]
    elif kind == "sort" and len({tuple(thing.values()) for thing in things.levels}) == len(levels):
        return _sort(things, order, rng)
    if answer is None:
        return None
    question = rng.choice(things.words.questions[kind]).format(**fields)
    hint = rng.choice(things.words.hints.get("letter" if answer in LETTERS else kind, ("",)))
    if kind in FORMED and answer in things.answers and len(things.topics) > 1 and rng.random() < 0.25:
        form = rng.choice(things.words.answers)
        hint = rng.choice(things.words.answer_as).format(form.format("x", noun="y"))
        answer = form.format(things.names[things.answers.index(answer)], noun=topic)
        answer = f"{answer[0].upper()}{answer[1:]}"
    return f"{question[0].upper()}{question[1:]} {hint}".strip(), answer


def _numbered(texts: Iterable[str]) -> str:
    return " ".join(f"{i}. {text}" for i, text in enumerate(texts, start=1))


def _sort(things: Things, order: Sequence[int], rng: random.Random) -> tuple[str, str]:
    """Tell what named things are like, in another order, and ask which is which."""
    names, chosen = invent(rng, len(order)), _wordings(things, rng)
    told = " ".join(_describe(f"{name}:", things, i, chosen, "list", rng) for name, i in zip(names, order, strict=True))
    owner = {i: name for name, i in zip(names, order, strict=True)}
    said = ", ".join(f"{things.names[i]} {owner[i]}" for i in range(len(order)))
    return rng.choice(things.words.questions["sort"]).format(told=told), f"{said[0].upper()}{said[1:]}."


def _wordings(things: Things, rng: random.Random) -> dict[str, list[str]]:
    """One wording of each level of each topic: what is alike is called alike."""
    return {topic: [rng.choice(level) for level in things.words.properties[topic].levels] for topic in things.topics}


def _describe(
    label: str, things: Things, index: int, chosen: Mapping[str, Sequence[str]], style: str, rng: random.Random
) -> str:
    """One thing in words: a list, a sentence, or first loosely and then plainly."""
    levels = things.levels[index]
    if style == "sentence":
        name = things.names[index]
        subject = "It" if not label else name if name.endswith(")") else f"{name[0].upper()}{name[1:]}"
        clauses = [f"{things.words.properties[t].verb} {chosen[t][levels[t]]}" for t in things.topics]
        return f"{subject} {_joined(clauses)}."
    plain = _listed(chosen, things, index)
    if style == "twice":
        # Loose words are any: what counts is said behind them.
        loose = _joined(_listed(_wordings(replace(things, words=words()), rng), things, index))
        said = f"{rng.choice(words().loosely).format(loose)} {rng.choice(words().finally_).format(', '.join(plain))}"
        return f"{label} {said}".strip()
    text = ", ".join(plain)
    return f"{label} {text}." if label else f"{text[0].upper()}{text[1:]}."


def _listed(chosen: Mapping[str, Sequence[str]], things: Things, index: int) -> list[str]:
    """The qualities of a thing; beside others, what it has comes behind "with"."""
    linked = {"is": "", "has": "with " if len(things.topics) > 1 else ""}
    return [linked[things.words.properties[t].verb] + chosen[t][things.levels[index][t]] for t in things.topics]


def _joined(parts: Sequence[str]) -> str:
    return " and ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]


def _place(question: str, answer: str, described: str, place: Place, words: Words, rng: random.Random) -> list[Turn]:
    """The turns of a conversation."""
    if place == "told":
        before = f"{described} {rng.choice(words.therefore)}"
        told = Turn(user=f"{question} {rng.choice(words.tell)}", assistant=f"{before} {answer}", described=len(before))
        return [told]
    if place == "earlier":
        told = Turn(user=rng.choice(words.tell), assistant=described, described=len(described))
        return [told, Turn(user=question, assistant=answer)]
    before = rng.choice(words.before)
    asked = [before, described, question] if place == "behind" else [question, described]
    return [Turn(user=" ".join(filter(None, asked)), assistant=answer)]
