"""Touch in words: questions in which the classes of a video are told in the place of what was felt.

A language model that does not conclude from classes in words does not conclude from touch either.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Mapping, Sequence

from pipeline.config import QuestionsConfig
from pipeline.records import Dialogue, Opd, Part, Question
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import Catalogue, Object

SYLLABLES = (
    *("bal", "bim", "dop", "fen", "gar", "hul", "jin", "kov", "lur", "mip"),
    *("nor", "pel", "quo", "rix", "sab", "tem", "vop", "wug", "yal", "zib"),
)
EACH = 10
"""Made-up objects of each combination of classes."""


def in_words(question: Question, classes: Sequence[Sequence[int]], catalogue: Catalogue) -> Question:
    """The question with "(hard, smooth, no bumps)" in the place of a video, which it then has none of.

    Args:
        classes: One entry a video of the question, with a class for each property.
    """
    told = [
        f"({', '.join(p.levels[level] for p, level in zip(catalogue.properties, video, strict=True))})"
        for video in classes
    ]
    dialogues = []
    for dialogue in question.dialogues:
        turns, rest = [], list(told)
        for turn in dialogue.turns:
            first, *others = turn.user.split("{tactile}")
            user = "".join([first, *(rest.pop(0) + other for other in others)])
            turns.append(turn.model_copy(update={"user": user}))
        dialogues.append(Dialogue(opd=dialogue.opd, turns=tuple(turns)))
    return question.model_copy(update={"videos": (), "dialogues": tuple(dialogues)})


def made_up(catalogue: Catalogue, seed: int) -> Catalogue:
    """Objects of all combinations of classes, whose names mean nothing: half words, half with a number."""
    combinations = list(itertools.product(*(range(len(p.levels)) for p in catalogue.properties))) * EACH
    rng = random.Random(seed)
    pairs = rng.sample(list(itertools.product(SYLLABLES, repeat=2)), min(len(combinations), len(SYLLABLES) ** 2))
    objects = {}
    for number, labels in enumerate(combinations):
        name = f"a {''.join(pairs[number % len(pairs)])}" if number % 2 else f"thing {rng.randrange(10**5):05d}"
        ratings = tuple((level,) for level in labels)
        objects[str(number)] = Object(object_id=str(number), name=name, splits={}, ratings=ratings)
    return catalogue.model_copy(update={"objects": objects})


def told_questions(
    catalogue: Catalogue,
    counts: Mapping[str, int],
    modes: Sequence[Opd],
    config: QuestionsConfig,
    seed: int,
    part: Part,
) -> list[Question]:
    """Questions in words about made-up objects, in these OPD modes by turns.

    Each has one dialogue, filed as OPD mode `all` whichever it is: a training set has one mode.
    """
    objects = made_up(catalogue, seed)
    pool = Pool(part, objects, {o: [o] for o in objects.objects})
    trained = part is Part.TRAIN
    drawn = build_questions(
        pool,
        counts,
        seed=seed,
        distinct=False,
        facts=config.facts,
        restate=config.restate,
        two_turns=config.two_turns * trained,
        plainly=config.plainly * trained,
    )
    told = []
    for number, question in enumerate(drawn):
        dialogue = question.dialogue(modes[number % len(modes)]) or question.dialogues[-1]
        filed = question.model_copy(update={"dialogues": (Dialogue(opd=Opd.ALL, turns=dialogue.turns),)})
        told.append(in_words(filed, question.gold.labels, objects))
    return told
