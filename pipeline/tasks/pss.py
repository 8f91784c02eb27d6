"""Property Superlative Selection: which of three videos is the extreme one?"""

from __future__ import annotations

import random
import re

from pipeline.core.records import Opd, Prediction, Question
from pipeline.tasks import base
from pipeline.tasks.base import Classes, Draft, Pool, TaskDefinition
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue

TEMPLATES = (
    ("Given three tactile videos: {videos}.", "select the {superlative}."),
    ("You have tactile videos of one object each: {videos}.", "select the {superlative} object."),
    ("Given these tactile videos: {videos}.", "select the {superlative}."),
)


def asked(template: tuple[str, str], superlative: str, spoken: str) -> dict[Opd, str]:
    """The question by a template, in every OPD mode; `spoken` is the property as a sentence has it."""
    opening, request = template[0].format(videos=base.lettered(3)), template[1].format(superlative=superlative)
    return {
        Opd.NONE: f"{opening} {request[0].upper()}{request[1:]}",
        Opd.NEEDED: f"{opening} Describe the {spoken} of each object and then {request}",
        Opd.ALL: f"{opening} Describe each object and then {request}",
    }


def read(answer: str, opposite: str = "") -> str | None:
    """The one letter that the conclusion calls the superlative, and not also the `opposite` of what was asked for."""
    named = (r"CHOICE is (?:\w+ly )?the\b(?! same)", r"(?:\w+est|(?:most|least) \w+)(?: \w+)? is CHOICE")
    letter, other = base.chosen_letter(answer, base.LETTERS, *named, concluded=True), re.escape(opposite)
    contrary = rf"{base.CHOICE} is (?:\w+ly )?the {other}\b|\b{other}(?: \w+)? is {base.CHOICE}"
    said = re.findall(contrary, " ".join(base.conclusion(answer)), re.I) if opposite else []
    return None if letter in {name.lower() for names in said for name in names} else letter


class PropertySuperlativeSelection(TaskDefinition):
    """The right video has the extreme class of all objects of the part, and the others do not (the published code)."""

    name = "PSS"
    title = "Property Superlative Selection"
    listed = base.LISTED
    adjectives = ("most", "least")
    choices = 3

    def strata(self, catalogue: Catalogue) -> int:
        return 3 * 2 * len(catalogue.properties)

    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        position = stratum % 3
        index, most = divmod(stratum // 3 % (2 * len(pool.catalogue.properties)), 2)
        prop = pool.catalogue.properties[index]
        levels = {o: pool.catalogue.labels(o)[index] for o in pool.objects}
        extreme = (max if most else min)(levels.values(), default=0)
        others = [o for o, level in levels.items() if level != extreme]
        if len(others) < 2:
            return None
        objects = rng.sample(others, 2)
        objects.insert(position, rng.choice([o for o, level in levels.items() if level == extreme]))
        superlative = prop.most if most else prop.least
        user = asked(rng.choice(TEMPLATES), superlative, prop.spoken)
        letter = base.LETTERS[position]
        turns = base.single_turn(
            user, base.concluded(pool.catalogue, objects, f"{letter}) is the {superlative}.", [prop.name])
        )
        finding = f"{superlative.capitalize()}: {letter})."
        return base.draft_about(pool, objects, rng, turns=turns, choice=letter, properties=[prop.name], finding=finding)

    def conclude(self, question: Question, classes: Classes, catalogue: Catalogue) -> str:
        place, (word, _) = catalogue.property_index(question.gold.properties[0]), self.adjective(question, catalogue)
        furthest = max if word == catalogue.properties[place].most else min
        extreme = furthest(range(len(classes)), key=lambda i: classes[i][place])
        return f"{base.LETTERS[extreme]}) is the {word}."

    def grade(self, question: Question, prediction: Prediction, catalogue: Catalogue) -> list[Score]:
        _, opposite = self.adjective(question, catalogue)
        return base.choice_score(question, prediction, read(prediction.outputs[0], opposite), published=True)


TASK = PropertySuperlativeSelection()
