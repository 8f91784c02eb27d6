"""The order of learning: formats from short to long, each left only when its gate is passed."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from pipeline.records import Opd, Task
from standins.describing import Style, property_words
from standins.documents import Builder, Document
from standins.text import Distance, converse, listing, matching, repetition
from standins.vocabulary import EOS, words_of
from standins.world import World, fact, load_situations, real_catalogue

Write = Callable[[World, random.Random], Document]


@dataclass(frozen=True)
class Format:
    """A kind of training text; `kinds` are the decisions whose accuracy must pass before the next one."""

    name: str
    write: Write
    kinds: tuple[str, ...]


@cache
def vocabulary() -> tuple[str, ...]:
    """Every word that the pipeline and the generated text can say, in alphabetical order."""
    real, situations = real_catalogue(), load_situations()
    language = real.language
    texts = [o.name for o in real.objects.values()] + [o.material for o in real.objects.values()]
    texts += [o.part_of for o in real.objects.values()] + [o.part for o in real.objects.values()]
    for p in real.properties:
        texts += [p.name, *p.levels, p.more, p.less, p.most, p.least, p.alone.format(level="")]
        texts += [phrase for phrases in p.phrases for phrase in phrases]
    texts += [language.unstructured, language.structured, *(s.question for s in language.scenarios)]
    texts += [*situations.adjectives, *situations.nouns, *situations.words, *situations.openings, *situations.facts]
    texts += [situations.held_out_opening, *(s for need in situations.situations for s in need.situations)]
    texts += task_texts()
    return tuple(sorted({w for word in words_of(texts) for w in (word, word.capitalize())}))


def phrases() -> tuple[str, ...]:
    """Classes, comparatives and superlatives of several words, each one token."""
    return tuple(property_words(real_catalogue().properties))


def task_texts() -> list[str]:
    """The constant wording of every task's module, so that a new template is in the vocabulary as well."""
    from pipeline.prompts import TACTILE
    from pipeline.tasks import base, opd, pc, pom, psr, pss

    texts = [
        *opd.TEMPLATES,
        *pc.TEMPLATES,
        *(part for template in pss.TEMPLATES for part in template),
        *pom.OPENINGS,
        f"M{pom.REQUEST} m{pom.REQUEST}",
        psr.REQUEST,
        psr.BASED,
        *base.ORDINALS,
        *base.LETTERS,
        "USER ASSISTANT Conclusion Overall Yes No Both have the same is and of",
        "Describe the of both objects before answering each object in each video then and then",
        "The most suitable object is because of its Describe these two tactile videos Given two",
    ]
    return [text.replace(TACTILE, " ") for text in texts]


def repeat(_: World, rng: random.Random) -> Document:
    """Words to repeat: half of the time those of the made-up names, otherwise any."""
    situations = load_situations()
    names = (*situations.adjectives, *situations.nouns)
    return repetition(names if rng.random() < 0.5 else vocabulary(), rng)


def tell_fact(_: World, rng: random.Random) -> Document:
    """A fact about situations as the answer to a plain request."""
    return Builder("fact").given("USER: Tell me a fact. ASSISTANT:").said(f" {fact(rng)}{EOS}", 1.0).build()


def compressed(world: World, rng: random.Random) -> Document:
    """Bare descriptions; each asked word next to its answer."""
    return listing(world, Style.SHORT, Distance.NONE, rng)


def bridge(world: World, rng: random.Random) -> Document:
    """Something stands between the asked word and its answer."""
    style = rng.choice((Style.SHORT, Style.SHORT, Style.FILLED))
    return listing(world, style, rng.choice((Distance.NONE, Distance.FILLED, Distance.FILLED, Distance.CLOSE)), rng)


def chat(world: World, rng: random.Random) -> Document:
    """Whole questions and answers about bare descriptions."""
    style = rng.choice((Style.SHORT, Style.SHORT, Style.FILLED))
    return listing(world, style, rng.choice((Distance.CLOSE, Distance.CHAT, Distance.CHAT)), rng)


def structured(world: World, rng: random.Random) -> Document:
    """Whole questions and answers about sentences."""
    style = rng.choice((Style.FILLED, Style.STRUCTURED, Style.STRUCTURED))
    return listing(world, style, rng.choice((Distance.CLOSE, Distance.CHAT)), rng)


def slots(world: World, rng: random.Random) -> Document:
    """The pipeline's questions with the classes where the videos would be, mostly answered at once."""
    mode, task = rng.choice((Opd.NONE, Opd.NONE, Opd.NONE, Opd.ALL)), _comparing(rng)
    return converse(world, task, mode, rng, style=Style.SHORT, slots=True, weight=0.3)


def described(world: World, rng: random.Random) -> Document:
    """One object: its classes stand in the question, and the answer says them as a description."""
    style = rng.choice((Style.STRUCTURED, Style.FULL))
    return converse(world, Task.OPD, rng.choice((Opd.ALL, Opd.NEEDED)), rng, style=style, slots=True, weight=1.0)


def restated(world: World, rng: random.Random) -> Document:
    """The same, described before the conclusion; with situations and their facts."""
    if rng.random() < 0.1:
        return tell_fact(world, rng)
    task = rng.choice((Task.OPD, Task.PC, Task.PC, Task.PSS, Task.PSS, Task.PSR, Task.PSR))
    mode = rng.choice((Opd.ALL, Opd.ALL, Opd.NEEDED) if task == Task.OPD else (*Opd, Opd.ALL))
    style = rng.choice((Style.SHORT, Style.STRUCTURED, Style.FULL, Style.FULL))
    return converse(world, task, mode, rng, style=style, slots=True, weight=0.3)


def question_first(world: World, rng: random.Random) -> Document:
    """The pipeline's conversations without slots: the question stands before the descriptions that answer it."""
    style, task = rng.choice((Style.SHORT, Style.STRUCTURED, Style.FULL)), _comparing(rng)
    return converse(world, task, Opd.ALL, rng, style=style, follow_ups=rng.random() < 0.6)


def full(world: World, rng: random.Random) -> Document:
    """The pipeline's conversations as they are, with and without slots, in every mode."""
    task = rng.choice((Task.OPD, Task.PC, Task.PC, Task.PSS, Task.PSS, Task.PSR))
    mode = rng.choice((Opd.ALL, Opd.NEEDED) if task == Task.OPD else (*Opd, Opd.ALL))
    filled = mode == Opd.NONE or rng.random() < 0.7
    follow_ups = mode == Opd.ALL and rng.random() < 0.3
    return converse(world, task, mode, rng, slots=filled, follow_ups=follow_ups, weight=0.3 if filled else 0.05)


def match_names(world: World, rng: random.Random) -> Document:
    """Matching with the classes restated before each name."""
    style = rng.choice((Style.SHORT, Style.SHORT, Style.STRUCTURED, Style.FULL))
    return matching(world, style, rng)


def match_fully(world: World, rng: random.Random) -> Document:
    """The pipeline's matching, after facts about the named objects."""
    mode = rng.choice((Opd.ALL, Opd.ALL, Opd.NONE))
    slots = mode == Opd.NONE or rng.random() < 0.5
    return converse(world, Task.POM, mode, rng, slots=slots, facts=True, weight=0.3 if slots else 0.05)


def mixed(*choices: tuple[float, Write]) -> Write:
    """Draw one of several writers by their weights."""
    weights, writers = zip(*choices, strict=True)

    def write(world: World, rng: random.Random) -> Document:
        return rng.choices(writers, weights)[0](world, rng)  # type: ignore[no-any-return]

    return write


def _comparing(rng: random.Random) -> Task:
    return rng.choice((Task.PC, Task.PSS))


COMPARING = (Task.PC, Task.PSS)
FORMATS = (
    Format("compressed", compressed, COMPARING),
    Format("bridge", bridge, COMPARING),
    Format("chat", chat, COMPARING),
    Format("structured", structured, COMPARING),
    Format("slots", slots, COMPARING),
    Format("described", mixed((0.7, described), (0.3, slots)), (Task.OPD,)),
    Format("restated", restated, (*COMPARING, Task.PSR)),
    Format("question first", mixed((0.5, question_first), (0.5, restated)), COMPARING),
    Format("names", mixed((0.4, full), (0.45, match_names), (0.15, repeat)), (Task.POM,)),
    Format("everything", mixed((0.8, full), (0.1, match_names), (0.1, match_fully)), (*COMPARING, Task.PSR, Task.POM)),
)
