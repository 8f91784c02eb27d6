"""Ripeness Classification: which of two fruits is the riper one? Evaluation only, after a talk about ripeness.

Property prediction of the same fruits needs no task of its own: it is OPD, asked about their videos (docs/avocado.md).
"""

from __future__ import annotations

import random
import re

from pipeline.core.records import Opd, Prediction, Question, Turn
from pipeline.tasks import base
from pipeline.tasks.base import Draft, Pool, TaskDefinition
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue

NUMBERS = {1: "one", 2: "two", 3: "three", 4: "four"}


class Ripeness(TaskDefinition):
    """First the model is asked which properties tell ripeness; its own answer stands before the pair, as in the paper.

    Fruits are what a column `ripeness_<fruit>` of objects.csv ranks; a pair has two ranks.
    """

    name = "RIPE"
    title = "Ripeness Classification"
    trained = False

    def strata(self, catalogue: Catalogue) -> int:
        return 2 * len(_fruits(catalogue))

    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        catalogue, fruits = pool.catalogue, _fruits(pool.catalogue)
        position, fruit = stratum % 2, fruits[stratum // 2 % len(fruits)]
        ranks = {
            o: catalogue.objects[o].ripeness[fruit] for o in pool.objects if fruit in catalogue.objects[o].ripeness
        }
        if len(set(ranks.values())) < 2:
            return None
        objects = rng.sample(sorted(ranks), 2)
        if ranks[objects[0]] == ranks[objects[1]]:
            return None
        objects.sort(key=ranks.__getitem__, reverse=position == 0)
        # The properties whose classes differ between ripe and unripe ones; all, where none does.
        ranked = [o.labels for o in catalogue.objects.values() if fruit in o.ripeness]
        telling = [p for p, *classes in zip(catalogue.properties, *ranked, strict=True) if len(set(classes)) > 1]
        names, spoken = zip(*((p.name, p.spoken) for p in telling or catalogue.properties), strict=True)
        aspects = " and ".join(spoken)
        answer = f"The riper {fruit} is {base.LETTERS[position]}), because of its {aspects}."
        talk = Turn(user=papers_question(catalogue, fruit), assistant=f"First to last: {', '.join(spoken)}.")
        ask = f"Each shows one {fruit}. Which {fruit} is riper? Use the format 'The riper {fruit} is x), because xxx'."
        whole = Turn(user=base.described_first(2), assistant=base.descriptions(catalogue, objects))
        needed = Turn(user=base.described_first(2, aspects), assistant=base.descriptions(catalogue, objects, names))
        last = Turn(user=ask, assistant=answer)
        turns = {
            Opd.NONE: [talk, Turn(user=f"Given two tactile videos: {base.lettered(2)}. {ask}", assistant=answer)],
            Opd.NEEDED: [talk, needed, last],
            Opd.ALL: [talk, whole, last],
        }
        return base.draft_about(pool, objects, rng, turns=turns, choice=base.LETTERS[position], properties=names)

    def grade(self, question: Question, prediction: Prediction, catalogue: Catalogue) -> list[Score]:
        """Read from "The riper FRUIT is x)"; two different letters there are no answer."""
        fruits = "|".join(map(re.escape, _fruits(catalogue)))
        said = (rf"riper (?:{fruits}|one) is CHOICE", rf"{base.BEGUN}CHOICE is (?:the )?riper\b")
        return base.choice_score(
            question, prediction, base.chosen_letter(prediction.outputs[-1], base.LETTERS[:2], *said)
        )


def _fruits(catalogue: Catalogue) -> list[str]:
    return sorted({fruit for o in catalogue.objects.values() for fruit in o.ripeness})


def papers_question(catalogue: Catalogue, fruit: str) -> str:
    """The paper's question (section "Avocado Ripeness Classification"), about this catalogue's properties."""
    count = NUMBERS.get(len(catalogue.properties), str(len(catalogue.properties)))
    told = " ".join(
        f"{p.spoken.capitalize()} categories in increasing {p.spoken}: {', '.join(p.levels)}."
        for p in catalogue.properties
    )
    return (
        f"You will be given tactile descriptions that consist of {count} physical properties: "
        f"{', '.join(p.spoken for p in catalogue.properties)}. {told} "
        f"Which of these properties help to determine {fruit} ripeness? Rank them."
    )


TASK = Ripeness()
