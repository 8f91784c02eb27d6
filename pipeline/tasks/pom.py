"""Property-object Matching: which of three videos is of which of three named objects?"""

from __future__ import annotations

import itertools
import random
import re
from collections.abc import Iterable, Sequence

from pipeline.core.records import Dialogue, Opd, Prediction, Question
from pipeline.tasks import base
from pipeline.tasks.base import Classes, Draft, Pool, TaskDefinition
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.catalogue.wording import unmarked

OPENINGS = ("Given three tactile videos: {videos}.", "You have tactile videos of one object each: {videos}.")
REQUEST = "atch each video to one of the following objects in alphabetical order: {options}."
ORDERS = tuple("".join(order) for order in itertools.permutations("123"))


def fact(catalogue: Catalogue, object_id: str) -> str:
    """What an object is like, by its classes: "hard, smooth, no bumps is a ruler."."""
    classes = zip(catalogue.properties, catalogue.labels(object_id), strict=True)
    return sentence([p.levels[level] for p, level in classes], catalogue.objects[object_id].name)


def sentence(classes: Iterable[str], name: str) -> str:
    """A fact about an object of whichever catalogue."""
    return f"{', '.join(classes)} is {name}."


def facts(catalogue: Catalogue, objects: Sequence[str], rng: random.Random) -> str:
    """What each object is like, in random order."""
    return " ".join(rng.sample([fact(catalogue, o) for o in objects], len(objects)))


def steps(some: Iterable[Sequence[float]], others: Iterable[Sequence[float]]) -> float:
    """By how many classes two lists of objects differ, pair by pair, over all properties."""
    pairs = zip(some, others, strict=True)
    return sum(abs(a - b) for one, other in pairs for a, b in zip(one, other, strict=True))


def asked(opening: str, names: Iterable[str]) -> dict[Opd, str]:
    """The question in every OPD mode; `names` in the order of the options."""
    names = list(names)
    opening = opening.format(videos=base.lettered(len(names)))
    request = REQUEST.format(options=", ".join(f"{i}) {name}" for i, name in enumerate(names, 1)))
    # Every property may tell the objects apart, so `needed` is `all`.
    whole = f"{opening} Describe the object in each video, then m{request}"
    return {Opd.NONE: f"{opening} M{request}", Opd.NEEDED: whole, Opd.ALL: whole}


def read(answer: str, names: Sequence[str]) -> dict[str, int] | None:
    """Each letter's place among the names, from "a) is NAME": one name for each, and no name twice; else None."""
    # As they stand behind "is": a name that begins like an item of a list keeps that.
    known = [" ".join(unmarked(f"is {name}").removeprefix("is ").split()).lower() for name in names]
    said = "|".join(re.escape(name) for name in sorted(known, key=len, reverse=True))
    pattern = rf"\b([abc])(?:\)|(?=\s*[:=-]|\s+is\b))(?:\s*:|\s*=|\s*->?|\s+is)?\s+({said})(?!'?\w|\s+or\b)"
    pairs = re.findall(pattern, " ".join(base.conclusion(answer)), flags=re.IGNORECASE)
    found = {letter.lower(): known.index(name.lower()) for letter, name in pairs}
    letters, places = list(base.LETTERS[: len(known)]), list(range(len(known)))
    whole = len(pairs) == len(known) and sorted(found) == letters and sorted(found.values()) == places
    return found if whole else None


def nearest(classes: Classes, catalogue: Catalogue, objects: Iterable[str] | None = None) -> tuple[str, ...]:
    """The object ids, one for each video, whose labels are nearest to its classes; ties go by the expected classes.

    Args:
        objects: Ids to match, as many as there are videos; by default all of the catalogue.
    """

    def distance(order: Sequence[str]) -> tuple[float, ...]:
        labels = [catalogue.labels(o) for o in order]
        # Rounded, since equal distances would otherwise differ by the order that they are added up in.
        return tuple(round(steps([[said[i] for said in video] for video in classes], labels), 9) for i in (0, 1))

    return min(itertools.permutations(sorted(catalogue.objects if objects is None else objects)), key=distance)


def in_words(catalogue: Catalogue, objects: Sequence[str]) -> str:
    """The conclusion in words, for three object ids in the order of their videos."""
    names = [f"{letter}) is {catalogue.objects[o].name}" for letter, o in zip(base.LETTERS, objects, strict=True)]
    return f"{names[0]}, {names[1]} and {names[2]}."


class PropertyObjectMatching(TaskDefinition):
    """Any two of the three objects differ in at least one property; otherwise touch could not tell them apart."""

    name = "POM"
    title = "Property-object Matching"
    choices = 6
    told = "told the classes of the named objects"

    def strata(self, catalogue: Catalogue) -> int:
        return len(ORDERS)

    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        if len(pool.objects) < 3:
            return None
        catalogue = pool.catalogue
        drawn = rng.sample(pool.objects, 3)
        if len({catalogue.labels(o) for o in drawn}) < 3:
            return None
        options = sorted(drawn, key=lambda o: catalogue.objects[o].name.lower())
        order = ORDERS[stratum % len(ORDERS)]
        objects = [options[int(number) - 1] for number in order]
        user = asked(rng.choice(OPENINGS), [catalogue.objects[o].name for o in options])
        turns = base.single_turn(user, base.concluded(catalogue, objects, in_words(catalogue, objects)))
        return base.draft_about(pool, objects, rng, turns=turns, choice=order, properties=catalogue.property_names)

    def with_facts(self, draft: Draft, catalogue: Catalogue, rng: random.Random) -> Draft:
        """The question after facts about its objects, so that it tests touch and reasoning, not knowledge of
        objects."""
        told, dialogues = facts(catalogue, draft.objects, rng), []
        for dialogue in draft.dialogues:
            first, *rest = dialogue.turns
            first = first.model_copy(update={"user": f"{told} {first.user}"})
            dialogues.append(Dialogue(opd=dialogue.opd, turns=(first, *rest)))
        return draft.with_dialogues(dialogues)

    def restated(self, draft: Draft, catalogue: Catalogue) -> Draft:
        """The question whose answer states the fact about each video's object, between descriptions and conclusion."""
        told = zip(base.LETTERS, draft.objects, strict=True)
        return base.before_concluding(draft, " ".join(f"{x}) {fact(catalogue, o)}" for x, o in told))

    def conclude(self, question: Question, classes: Classes, catalogue: Catalogue) -> str:
        return in_words(catalogue, nearest(classes, catalogue, question.objects))

    def grade(self, question: Question, prediction: Prediction, catalogue: Catalogue) -> list[Score]:
        names = sorted((catalogue.objects[o].name for o in question.objects), key=str.lower)
        found = read(prediction.outputs[0], names)
        predicted = "".join(str(found[x] + 1) for x in base.LETTERS) if found else None
        return base.choice_score(question, prediction, predicted, published=True)


TASK = PropertyObjectMatching()
