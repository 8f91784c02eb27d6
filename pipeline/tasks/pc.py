"""Property Comparison: does a comparative hold between two videos?"""

from __future__ import annotations

import random
import re
from typing import Literal

from pipeline.core.records import Dialogue, Opd, Prediction, Question, Turn
from pipeline.tasks import base, psr
from pipeline.tasks.base import Classes, Draft, Pool, TaskDefinition
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue, Property
from pipeline.videos.catalogue.wording import plain

TEMPLATES = (
    "Is the object in the tactile video {tactile} COMPARATIVE than the one in {tactile}?",
    "Is the object in {tactile} COMPARATIVE than the object in {tactile}?",
)
Reading = Literal["yes", "no", "same"]
CHOICES: tuple[Reading, ...] = ("yes", "no", "same")


def asked(template: str, comparative: str, spoken: str) -> dict[Opd, str]:
    """The question by a template, in every OPD mode; `spoken` is the property as a sentence has it."""
    ask = template.replace("COMPARATIVE", comparative)
    return {
        Opd.NONE: ask,
        Opd.NEEDED: f"{ask} Describe the {spoken} of both objects before answering.",
        Opd.ALL: f"{ask} Describe both objects before answering.",
    }


def compare(first: int, second: int, rising: bool) -> Reading:
    """Whether the first class is beyond the second in the direction that is asked for."""
    return "same" if first == second else "yes" if (first > second) == rising else "no"


def in_words(choice: Reading, comparative: str, prop: Property) -> str:
    """The conclusion in words."""
    return {
        "yes": f"Yes, the first object is {comparative}.",
        "no": f"No, the second object is {comparative}.",
        "same": f"Both objects are similar in {prop.spoken}.",
    }[choice]


def read(answer: str, comparative: str, opposite: str) -> Reading | None:
    """One of `CHOICES`, from how the conclusion begins: "Yes", "No" or "Both"; "yes and no" is none of them.

    Nor is what contradicts itself: asked which one is softer, "Yes, the first object is harder.".
    """
    pattern = r"\W*(yes|no|both)\b(?!\s*(?:and|or|/)\s*(?:yes|no|both)\b|\s+(?:idea|answer|conclusion|clue)\b)"
    parts, (asked, other) = base.conclusion(answer), map(plain, (comparative, opposite))
    found = {m[1].lower() for part in parts if (m := re.match(pattern, part, flags=re.IGNORECASE))}
    named = rf"{base.BEGUN}the (first|second) object is ({re.escape(asked)}|{re.escape(other)})(?!\w)"
    said = {"no" if (x == "first") == (y == other) else "yes" for x, y in re.findall(named, plain(" ".join(parts)))}
    readings: dict[str, Reading] = {"yes": "yes", "no": "no", "both": "same"}
    return readings[found.pop()] if len(found) == 1 and said <= found else None


class PropertyComparison(TaskDefinition):
    """Three answers are possible (yes, no, the same), which fits the paper's chance of one third."""

    name = "PC"
    title = "Property Comparison"
    listed = ("first object", "second object")
    adjectives = ("more", "less")
    choices = 3

    def strata(self, catalogue: Catalogue) -> int:
        return len(CHOICES) * len(catalogue.properties) * 2

    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        if len(pool.objects) < 2:
            return None
        choice = CHOICES[stratum % 3]
        index, rising = divmod(stratum // 3 % (2 * len(pool.catalogue.properties)), 2)
        prop = pool.catalogue.properties[index]
        objects = rng.sample(pool.objects, 2)
        first, second = (pool.catalogue.labels(o)[index] for o in objects)
        if compare(first, second, bool(rising)) != choice:
            return None
        comparative = prop.more if rising else prop.less
        user = asked(rng.choice(TEMPLATES), comparative, prop.spoken)
        told, prefixes = in_words(choice, comparative, prop), [f"{o} object:" for o in base.ORDINALS]
        answer = base.concluded(pool.catalogue, objects, told, [prop.name], prefixes)
        found = {"yes": self.listed[0], "no": self.listed[1], "same": "neither"}[choice]
        return base.draft_about(
            pool,
            objects,
            rng,
            turns=base.single_turn(user, answer),
            choice=choice,
            properties=[prop.name],
            finding=f"{comparative.capitalize()}: {found}.",
        )

    def plainly(self, draft: Draft, catalogue: Catalogue, rng: random.Random) -> Draft:
        """ "Which is softer?", videos in front or behind, which is answered by the name of one, or by "Both"."""
        comparative, _ = self.adjective(draft, catalogue)
        places = ("{{tactile}} {{tactile}} Which is {}?", "Which is {}? {{tactile}} {{tactile}}")
        user, dialogues = rng.choice(places).format(comparative), []
        for dialogue in draft.dialogues:
            (turn,) = dialogue.turns
            said = re.sub(r"(?:Yes|No), the (?=first|second)", "The ", turn.assistant)
            plain = turn.model_copy(update={"user": user, "assistant": said})
            dialogues.append(Dialogue(opd=dialogue.opd, turns=(plain,)))
        return draft.with_dialogues(dialogues)

    def as_choice(self, draft: Draft, catalogue: Catalogue) -> Draft | None:
        """ "Which object is softer?", answered as scenarios want it: "The most suitable object is b), ..."."""
        if draft.gold.choice == "same":
            return None
        spoken = catalogue.properties[catalogue.property_index(draft.gold.properties[0])].spoken
        question = f"Which object is {self.adjective(draft, catalogue)[0]}?"
        ask = psr.REQUEST.format(question=question, based=psr.BASED)
        turn = Turn(user=ask, assistant=psr.in_words("ab"[draft.gold.choice == "no"], spoken))
        return draft.with_dialogues(Dialogue(opd=d.opd, turns=(turn,)) for d in draft.dialogues)

    def conclude(self, question: Question, classes: Classes, catalogue: Catalogue) -> str:
        place, (word, _) = catalogue.property_index(question.gold.properties[0]), self.adjective(question, catalogue)
        prop = catalogue.properties[place]
        (first, _), (second, _) = (video[place] for video in classes)
        return in_words(compare(first, second, word == prop.more), word, prop)

    def grade(self, question: Question, prediction: Prediction, catalogue: Catalogue) -> list[Score]:
        said = read(prediction.outputs[0], *self.adjective(question, catalogue))
        return base.choice_score(question, prediction, said, published=True)


TASK = PropertyComparison()
