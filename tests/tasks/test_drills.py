"""Drills: conversations in words that do nothing but conclude, each rightly, by a reader of its own."""

from __future__ import annotations

import random
import re
from collections import Counter

import pytest

from pipeline.records import Turn
from pipeline.tasks import TASKS
from pipeline.videos.catalogue import Property
from tests.tasks.shared import CATALOGUE


def drawn(task: str, count: int) -> list[list[Turn]]:
    return [TASKS[task].drill(CATALOGUE, random.Random(seed)) for seed in range(count)]


def asked(turn: Turn) -> tuple[Property, bool]:
    """The property of a question, and whether it asks for more of it."""
    named = {
        word: (p, word in (p.more, p.most)) for p in CATALOGUE.properties for word in (p.more, p.less, p.most, p.least)
    }
    return named[max((word for word in named if word in turn.user), key=len)]


def levels(turn: Turn, prop: Property, names: tuple[str, ...]) -> list[int]:
    said = turn.assistant.partition(": ")[2].partition(". ")[0].split(", ")
    return [prop.levels.index(part.removeprefix(f"{name} ")) for part, name in zip(said, names, strict=True)]


@pytest.mark.parametrize(("task", "names"), [("PC", ("first object", "second object")), ("PSS", ("a)", "b)", "c)"))])
def test_what_is_concluded_follows_from_the_classes(task: str, names: tuple[str, ...]) -> None:
    concluded = Counter()
    for turn in (t for turns in drawn(task, 60) for t in turns):
        prop, more = asked(turn)
        assert turn.assistant.startswith(f"{prop.spoken.capitalize()}: ")
        found = levels(turn, prop, names)
        end = max(found) if more else min(found)
        ends = [name for name, level in zip(names, found, strict=True) if level == end]
        said = turn.assistant[turn.described :].strip().removesuffix(".")
        assert said == (ends[0] if len(ends) == 1 else "neither")
        assert turn.assistant[: turn.described].endswith(":")
        concluded[said] += 1
    assert len(concluded) == 3
    assert min(concluded.values()) > 0.25 * sum(concluded.values())


def test_matching_looks_up_a_fact() -> None:
    names = set()
    for turns in drawn("POM", 60):
        facts = dict(re.findall(r"(\w[^.]*?) is ((?:a|object) \w+)\.", turns[0].user))
        assert len(facts) == len(set(facts.values())) == len(turns) == 3
        for letter, turn in zip("abc", turns, strict=True):
            given, said = turn.assistant[: turn.described], turn.assistant[turn.described :]
            classes = given.removeprefix(f"{letter}) ").removesuffix(" is")
            assert said == f" {facts[classes]}."
        assert [t.user[-3:] for t in turns] == ["a)?", "b)?", "c)?"]
        names |= set(facts.values())
    assert len(names) > 170
    assert not names & {o.name for o in CATALOGUE.objects.values()}


def test_a_task_that_concludes_nothing_drills_nothing() -> None:
    assert not TASKS["OPD"].drill(CATALOGUE, random.Random(0))
    assert not TASKS["PSR"].drill(CATALOGUE, random.Random(0)), "scenarios are never trained on"
