"""The order of learning: formats from short to long, each left only when its gate is passed."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from pipeline.records import Opd
from standins.asking import Distance, listing
from standins.conversing import RESTATED, Manner, converse
from standins.describing import Style, property_words
from standins.documents import Builder, Document, Hint
from standins.matching import Reach, matching, matching_one, repetition
from standins.vocabulary import EOS, words_of
from standins.world import World, draw_fact, load_situations, real_catalogue, reworded, wording

Write = Callable[[World, random.Random], Document]


@dataclass(frozen=True)
class Format:
    """A kind of training text; `kinds` are the decisions whose accuracy must pass before the next one."""

    name: str
    write: Write
    kinds: tuple[str, ...]
    replay: float = 1.0
    """How often it is drawn, against the others, once it has been left."""
    earlier: float = 0.2
    """Share of earlier formats while this one is learnt."""
    least: int = 0
    """Rounds before it may be left."""
    enlarge: float = 1.0
    """By how much the words' vectors are enlarged before it (`training.enlarge`)."""
    most: int = 1000
    """Rounds after which it is left in any case: what it lacks is easier to learn in the formats that follow."""


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
    from pipeline.language.chat import TACTILE
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


def asked_first(world: World, rng: random.Random) -> Document:
    """The pipeline's question before the closing sentences that answer it."""
    mode = rng.choice((Opd.ALL, Opd.ALL, Opd.ALL, Opd.NEEDED))
    return converse(world, _comparing(rng), mode, rng, Manner(Style.STRUCTURED, follow_ups=5 * (mode == Opd.ALL)))


def full(world: World, rng: random.Random) -> Document:
    """The pipeline's comparisons in full."""
    if rng.random() < 0.2:
        return listing(world, Style.FULL, Distance.CHAT, rng)
    style = rng.choice((Style.STRUCTURED, Style.FULL, Style.FULL, Style.FULL))
    return converse(world, _comparing(rng), Opd.ALL, rng, Manner(style, follow_ups=5))


def slots(world: World, rng: random.Random) -> Document:
    """The pipeline's questions with the classes where the videos would be, answered at once."""
    return converse(world, _comparing(rng), Opd.NONE, rng, Manner(slots=True, blended=_often(rng), follow_ups=4))


def told(world: World, rng: random.Random) -> Document:
    """Classes in the question, said as descriptions in the answer: one object's or, before the conclusion, several'."""
    style = rng.choice((Style.STRUCTURED, Style.FULL))
    if rng.random() < 0.35:
        return converse(world, "OPD", Opd.ALL, rng, Manner(style, slots=True, blended=_often(rng)))
    mode = rng.choice((Opd.ALL, Opd.NEEDED))
    return converse(world, _comparing(rng), mode, rng, Manner(style, slots=True, blended=_often(rng)))


def free(world: World, rng: random.Random) -> Document:
    """Comparisons by the objects' own sentences, without the closing one."""
    if rng.random() < 0.5:
        return listing(world, Style.FREE, Distance.CHAT, rng)
    return converse(world, _comparing(rng), Opd.ALL, rng, Manner(Style.FREE, follow_ups=5))


def fact(_: World, rng: random.Random) -> Document:
    """What a situation asks for, as a statement or as the answer to a plain request."""
    said = draw_fact(rng)
    builder = Builder("fact")
    if rng.random() < 0.5:
        builder.given("USER: Tell me a fact. ASSISTANT: ")
    builder.given(said.opening, Hint(asked=said.asked)).given(said.middle, Hint(asked=said.asked))
    return builder.decided(said.word, 2.0).said(said.end + EOS, 0.1).build()


def wanted(_: World, rng: random.Random) -> Document:
    """What a situation asks for, in answer to random words around it, with no object to choose."""
    said = draw_fact(rng)
    question = f"USER: {wording(rng).format(situation=said.situation)} What is it like? ASSISTANT:"
    builder = Builder("fact").given(question, Hint(asked=said.asked))
    return builder.given(f" Something{said.joint}").decided(said.word, 2.0).said(f".{EOS}", 0.1).build()


def situations(world: World, rng: random.Random) -> Document:
    """Which of two objects suits a situation, in every mode, with slots and without."""
    if rng.random() < 0.25:
        return fact(world, rng)
    mode = rng.choice(tuple(Opd))
    style = rng.choice((Style.SHORT, Style.STRUCTURED, Style.FULL))
    known = mode == Opd.NONE or rng.random() < 0.5
    return converse(world, "PSR", mode, rng, Manner(style, slots=known, blended=_often(rng)))


def rephrased(world: World, rng: random.Random) -> Document:
    """The same in wordings of which only the situation makes sense."""
    return situations(reworded(world, rng), rng)


def repeat(_: World, rng: random.Random) -> Document:
    """Words to repeat: mostly those of the made-up names, otherwise any."""
    made_up = (*load_situations().adjectives, *load_situations().nouns)
    return repetition(made_up if rng.random() < 0.8 else vocabulary(), rng)


def named(world: World, rng: random.Random) -> Document:
    """Copying by what an object is like: facts said once more, or names beside bare descriptions."""
    drawn = rng.random()
    if drawn < 0.15:
        return repeat(world, rng)
    if drawn < 0.35:
        return matching_one(world, rng)
    if drawn < 0.75:
        return matching(world, Style.SHORT, Reach.FACT, rng)
    return matching(world, rng.choice((Style.SHORT, Style.STRUCTURED)), Reach.BESIDE, rng)


def matched(world: World, rng: random.Random) -> Document:
    """Names from beside the descriptions to behind them all."""
    reach = rng.choices(tuple(Reach), (3, 3, 5, 9))[0]
    return matching(world, rng.choices((Style.SHORT, Style.STRUCTURED, Style.FULL), (6, 3, 1))[0], reach, rng)


def matched_fully(world: World, rng: random.Random) -> Document:
    """The pipeline's matching, after facts about the named objects."""
    mode = rng.choice((Opd.ALL, Opd.ALL, Opd.NONE))
    known = mode == Opd.NONE or rng.random() < 0.5
    return converse(world, "POM", mode, rng, Manner(slots=known, blended=_often(rng), facts=True))


def matched_by_likeness(world: World, rng: random.Random) -> Document:
    """The same where touch errs by a class here and there: each object is what it is most like, and no two are one."""
    mode = rng.choice((Opd.ALL, Opd.ALL, Opd.NONE))
    known = mode == Opd.NONE or rng.random() < 0.5
    manner = Manner(slots=known, blended=_often(rng), facts=True, misread=True)
    return converse(world, "POM", mode, rng, manner)


def everything(world: World, rng: random.Random) -> Document:
    """Every conversation of the pipeline as it is, with and without slots; and the facts that scenarios rest on."""
    compared = {full: 6, slots: 5, told: 8, free: 2}
    suited = {situations: 5, rephrased: 6, fact: 3, wanted: 6}
    named_right = {matched: 2, matched_fully: 5, matched_by_likeness: 8}
    weights = compared | suited | named_right
    return rng.choices(tuple(weights), tuple(weights.values()))[0](world, rng)


def _often(rng: random.Random) -> bool:
    return rng.random() < 0.5


def _comparing(rng: random.Random) -> str:
    return rng.choice(("PC", "PSS"))


COMPARING = ("PC", "PSS")
FORMATS = (
    Format("compressed", compressed, COMPARING, replay=0.3),
    Format("bridge", bridge, COMPARING, replay=0.3),
    Format("chat", chat, COMPARING, replay=0.3),
    Format("structured", structured, COMPARING, replay=0.3),
    Format("asked first", asked_first, COMPARING),
    Format("full", full, COMPARING, replay=2.0),
    Format("slots", slots, COMPARING, most=36, replay=3.0),
    Format("told", told, ("OPD", RESTATED, *COMPARING), most=108, replay=3.0),
    Format("free", free, COMPARING, most=36),
    Format("situations", situations, ("PSR",), earlier=0.3, replay=2.0, most=60),
    Format("repeated", repeat, ("repetition",), earlier=0.3, enlarge=6.0),
    Format("named", named, ("POM",), earlier=0.3, replay=2.0, most=102),
    Format("matched", matched, ("POM",), earlier=0.25, replay=2.0, most=102),
    Format("everything", everything, ("OPD", RESTATED, *COMPARING, "PSR", "POM"), earlier=0.15, most=60),
)
