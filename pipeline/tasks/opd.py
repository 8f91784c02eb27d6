"""Object Property Description: describe one tactile video by its properties."""

from __future__ import annotations

import math
import random
import re
from string import Formatter

from pipeline.core.records import Opd, Prediction, Question
from pipeline.tasks.base import Classes, Draft, Pool, TaskDefinition, draft_about, find_level, scored, single_turn
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.catalogue.wording import OPENING, unmarked

TEMPLATES = ("Describe the physical properties of {tactile}.", "How does this tactile video {tactile} feel?")


class ObjectPropertyDescription(TaskDefinition):
    """Trained and evaluated; has no `none` mode, since without descriptions there is no task."""

    name = "OPD"
    title = "Object Property Description"
    measure = "combined"

    def strata(self, catalogue: Catalogue) -> int:
        return len(catalogue.objects)

    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        # A stratum is an object of the catalogue: those without videos here fall out, the others come equally often.
        object_id = sorted(pool.catalogue.objects)[stratum % len(pool.catalogue.objects)]
        if object_id not in pool.videos:
            return None
        user, answer = rng.choice(TEMPLATES), pool.catalogue.describe(object_id)
        modes = (Opd.NEEDED, Opd.ALL)
        turns = single_turn(dict.fromkeys(modes, user), dict.fromkeys(modes, answer))
        return draft_about(pool, [object_id], rng, turns=turns, choice="", properties=pool.catalogue.property_names)

    def grade(self, question: Question, prediction: Prediction, catalogue: Catalogue) -> list[Score]:
        """One score a property, read from the closing sentence ("Overall ..."), and `combined` for all at once."""
        expected, predicted = question.gold.labels[0], read(prediction.outputs[0], catalogue)
        strict = as_published(prediction.outputs[0], expected, catalogue)
        scores = [
            scored(question, prediction, p.name, p.levels[e], None if g is None else p.levels[g], strict[p.name])
            for p, e, g in zip(catalogue.properties, expected, predicted, strict=True)
        ]
        right, said = (", ".join(getattr(s, side) for s in scores) for side in ("expected", "predicted"))
        whole = said if all(s.parsed for s in scores) else None
        return [*scores, scored(question, prediction, "combined", right, whole, strict["combined"])]

    def conclude(self, question: Question, classes: Classes, catalogue: Catalogue) -> str:
        return catalogue.structured(tuple(level for level, _ in classes[0]))

    def chance(self, catalogue: Catalogue) -> dict[str, float]:
        single = {p.name: 1 / len(p.levels) for p in catalogue.properties}
        return {**single, "combined": math.prod(single.values())}


def read(said: str, catalogue: Catalogue) -> list[int | None]:
    """The class of each property that the closing sentence ("Overall ...") names; None where it names none."""
    # Before that sentence an answer describes freely, in words that may name a class in passing.
    closing = "".join(re.split(rf"\b{OPENING}\b", unmarked(said), flags=re.IGNORECASE)[1:][-1:])
    return [find_level(closing, p) for p in catalogue.properties]


def named(said: str, catalogue: Catalogue) -> dict[str, str]:
    """By property, the class that `read` finds, where it finds one."""
    found = zip(catalogue.properties, read(said, catalogue), strict=True)
    return {p.name: p.levels[level] for p, level in found if level is not None}


def as_published(said: str, labels: tuple[int, ...], catalogue: Catalogue) -> dict[str, bool | None]:
    """By property, and `combined`, whether a description is right as the published code compares it.

    That code cuts the closing sentence at its fixed words and compares what stands between them letter by letter; the
    last class with its full stop, and the whole sentence, may be followed by anything. A sentence that lacks a fixed
    word is all wrong. Where no word stands between two classes it cannot cut, and all is None.
    """
    right = catalogue.structured(labels)
    fields = [(before, name) for before, name, *_ in Formatter().parse(catalogue.language.structured) if name]
    if not all(before.strip() for before, _ in fields):  # Nothing stands between two classes to cut at.
        return dict.fromkeys((*catalogue.property_names, "combined"))
    opening, (ending, last) = fields[0][0], fields[-1]
    wrong: dict[str, bool | None] = dict.fromkeys((*catalogue.property_names, "combined"), False)
    if opening not in said:
        return wrong
    rest, values = said.split(opening)[-1], []
    for before, _ in fields[1:]:
        value, cut, rest = rest.partition(before.rstrip())
        if not cut:
            return wrong
        values.append(value.strip())
    levels = {p.name: p.levels[label] for p, label in zip(catalogue.properties, labels, strict=True)}
    found = {name: value == levels[name] for (_, name), value in zip(fields, values, strict=False)}
    found[last] = rest.strip().startswith(right.split(ending)[-1])
    return {**found, "combined": said.split(opening)[-1].startswith(right.split(opening)[-1])}


TASK = ObjectPropertyDescription()
