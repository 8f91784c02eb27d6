"""The teaching text: it says nothing of the tasks' wordings or objects, and its answers are right."""

from __future__ import annotations

import random
import re
from collections.abc import Iterable

import pytest

from pipeline.language.teach.gate import GateQuestion, gate_questions
from pipeline.language.teach.items import OURS, Item, draw, held_out, words
from pipeline.records import Assignment, Opd, Part
from pipeline.tasks import TASKS
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import Catalogue

GRAM = 6


def grams(text: str) -> set[tuple[str, ...]]:
    """Runs of six words, in small letters and without punctuation."""
    said = re.findall(r"[a-z0-9']+", text.lower())
    return {tuple(said[i : i + GRAM]) for i in range(len(said) - GRAM + 1)}


def text(item: Item) -> str:
    return " ".join(f"{turn.user} {turn.assistant}" for turn in item.turns)


@pytest.fixture(scope="module")
def items() -> list[Item]:
    return [draw(random.Random(i), whole=i % 2 == 1, held=i % 6 == 5, follow_ups=i % 3) for i in range(9000)]


def asked(catalogue: Catalogue, facts: bool) -> Iterable[str]:
    """Every question and answer of a large set over the whole catalogue, in every mode of OPD."""
    videos = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TEST) for o in catalogue.objects]
    counts = dict.fromkeys(TASKS, 400)
    for question in build_questions(pool_of(Part.TEST, videos, catalogue), counts, seed=1, distinct=False, facts=facts):
        for mode in Opd:
            dialogue = question.dialogue(mode)
            for turn in dialogue.turns if dialogue else ():
                # Videos stand where embeddings will be, so that the words around one do not touch.
                yield from (*turn.user.split("{tactile}"), turn.user.replace("{tactile}", ""), turn.assistant)


@pytest.mark.parametrize("facts", [False, True])
def test_no_six_words_of_a_task(items: list[Item], catalogue: Catalogue, facts: bool) -> None:
    """Descriptions are held to it too, though the templates alone would do."""
    tasks: set[tuple[str, ...]] = set().union(*map(grams, asked(catalogue, facts)))
    assert len(tasks) > 5000
    taught: set[tuple[str, ...]] = set().union(*map(grams, map(text, items)))
    assert len(taught) > 50_000
    assert not [" ".join(gram) for gram in tasks & taught]


def test_no_object_of_the_catalogue(items: list[Item], catalogue: Catalogue) -> None:
    names = [re.sub(r"^(an?|the) ", "", o.name.lower()) for o in catalogue.objects.values()]
    pattern = re.compile(
        "|".join(rf"\b{re.escape(name)}\b" for name in [*names, *(o.replace("_", " ") for o in catalogue.objects)])
    )
    assert not {found[0] for item in items if (found := pattern.search(text(item).lower()))}
