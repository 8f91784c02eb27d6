"""The paper's qualitative examples, rice and a toothbrush. Reports show the answers; no accuracy counts them."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from typing import NamedTuple

from pipeline.core.records import Opd, Part, Prediction, Question, Turn
from pipeline.core.runtime import derive_seed
from pipeline.tasks.base import (
    LETTERS,
    Pool,
    choice_score,
    chosen_letter,
    described_first,
    descriptions,
    draft_about,
)
from pipeline.tasks.opd import TEMPLATES
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment

LEAST_KNOWN_FIRST = (Part.TEST, Part.VALIDATION, Part.TRAIN)
"""The parts of a split, the least familiar to a model first."""


class Example(NamedTuple):
    """A question with two choices, of which the first is right: two options for one object, or two objects."""

    name: str
    objects: tuple[str, ...]
    question: str
    answer: str
    """How an answer begins; the letter of its choice comes next."""
    options: tuple[str, ...] = ()


EXAMPLES = (
    Example("rice", ("rice",), "Is this scoop of rice {options}?", "The rice is", ("uncooked", "cooked")),
    Example(
        "toothbrush",
        ("toothbrush_handle", "toothbrush_bristles"),
        "One of them is the handle and the other are the bristles of the same toothbrush. Which one is the handle?",
        "The handle is",
    ),
)
"""PhysiCLeAR's objects; a catalogue without them has no examples."""


def build_examples(assignments: Sequence[Assignment], catalogue: Catalogue, *, seed: int) -> list[Question]:
    """Each example whose objects all have videos in this split, with the right answer at a) and then at b).

    A question's part is the most familiar one of its objects: `train` where the model was trained on one of them.
    """
    rng, questions = random.Random(derive_seed(seed, "examples")), []
    parts = {a.object_id: a.part for a in assignments if a.part in LEAST_KNOWN_FIRST}
    for example in EXAMPLES:
        if not parts.keys() >= {*example.objects}:
            continue
        part = max((parts[o] for o in example.objects), key=LEAST_KNOWN_FIRST.index)
        videos = {o: [a.video_id for a in assignments if a.object_id == o] for o in example.objects}
        pool = Pool(part, catalogue, videos)
        for letter, step in zip(LETTERS, (1, -1), strict=False):
            objects, options = example.objects[::step], example.options[::step]
            if options:
                opening, described = TEMPLATES[0], catalogue.describe(*objects)
            else:
                opening, described = described_first(2), descriptions(catalogue, objects)
            named = " or ".join(f"{x}) {option}" for x, option in zip(LETTERS, options, strict=False))
            request = f"{example.question.format(options=named)} Use the format '{example.answer} x), because xxx'."
            turns = [
                Turn(user=opening, assistant=described),
                Turn(user=request, assistant=f"{example.answer} {letter})."),
            ]
            draft = draft_about(
                pool, objects, rng, turns={Opd.ALL: turns}, choice=letter, properties=catalogue.property_names
            )
            questions.append(draft.numbered(f"{example.name}-{letter}", example.name, part))
    return questions


def grade_example(question: Question, prediction: Prediction) -> Score:
    """Read from the letter behind the example's `answer`; two different letters there are no choice."""
    before = next(e.answer for e in EXAMPLES if e.name == question.task)
    letter = chosen_letter(prediction.outputs[-1], LETTERS[:2], rf"{re.escape(before)} CHOICE")
    (score,) = choice_score(question, prediction, letter)
    return score
