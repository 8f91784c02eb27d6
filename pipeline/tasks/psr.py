"""Property Scenario Reasoning: which of two videos suits a situation? Evaluation only, in two turns."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence

from pipeline.core.records import Opd, Prediction, Question, Turn
from pipeline.tasks import base
from pipeline.tasks.base import Classes, Draft, Pool, TaskDefinition
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue

BASED = " based on physical property descriptions of the two objects"
REQUEST = (
    "{question} Select only one most appropriate object for this scenario{based}. "
    "Use the format 'The most suitable object is x), because xxx'."
)


def asked(question: str, aspects: str) -> dict[Opd, tuple[str, ...]]:
    """The turns of every OPD mode: first a description, of `aspects` alone or of all, then the situation."""
    second = REQUEST.format(question=question, based=BASED)
    return {
        Opd.NONE: (f"Given two tactile videos: {base.lettered(2)}. {REQUEST.format(question=question, based='')}",),
        Opd.NEEDED: (base.described_first(2, aspects), second),
        Opd.ALL: (base.described_first(2), second),
    }


def in_words(letter: str, reasons: str) -> str:
    """The conclusion in words."""
    return f"The most suitable object is {letter}), because of its {reasons}."


def read(answer: str) -> str | None:
    """The letter in "The most suitable object is x)", or "... for this is x)"; "x) or y)", or two letters, are none."""
    said = r"most suitable object(?: for [^.;]*?)? is:? CHOICE"
    return base.chosen_letter(answer, base.LETTERS[:2], said, rf"{base.BEGUN}CHOICE is the (?:most suitable|best)\b")


class PropertyScenarioReasoning(TaskDefinition):
    """With OPD the objects are described in a first turn; without, the one turn asks at once."""

    name = "PSR"
    title = "Property Scenario Reasoning"
    trained = False
    told = "told the classes that suit the scenario"

    def strata(self, catalogue: Catalogue) -> int:
        return 2 * len(catalogue.language.scenarios)

    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        catalogue = pool.catalogue
        position, number = stratum % 2, stratum // 2 % len(catalogue.language.scenarios)
        scenario = catalogue.language.scenarios[number]
        named = scenario.object
        targets = [named] if named is not None and named in pool.videos else _matching(pool, scenario.target)
        others = [o for o in _matching(pool, scenario.other) if o not in targets]
        if not targets or not others:
            return None
        objects = [rng.choice(targets), rng.choice(others)]
        if position == 1:
            objects.reverse()
        names = [p for p in catalogue.property_names if p in scenario.target or p in scenario.other]
        spoken = {p.name: p.spoken for p in catalogue.properties}
        reasons, aspects = (" and ".join(spoken[p] for p in chosen) for chosen in (scenario.target, names))
        answer = in_words(base.LETTERS[position], reasons)
        said = {
            Opd.NONE: (answer,),
            Opd.NEEDED: (base.descriptions(catalogue, objects, names), answer),
            Opd.ALL: (base.descriptions(catalogue, objects), answer),
        }
        turns = {
            mode: [Turn(user=user, assistant=answer) for user, answer in zip(users, said[mode], strict=True)]
            for mode, users in asked(scenario.question, aspects).items()
        }
        return base.draft_about(pool, objects, rng, turns=turns, choice=base.LETTERS[position], properties=names)

    def conclude(self, question: Question, classes: Classes, catalogue: Catalogue) -> str | None:
        """The video whose classes are nearest to the suitable ones; ties go by the expected classes."""
        asked = question.dialogues[0].turns[-1].user
        # The longest, as one scenario's question may stand in another's.
        found = [s for s in catalogue.language.scenarios if s.question in asked]
        scenario = max(found, key=lambda s: len(s.question), default=None)
        if scenario is None:
            return None

        def distance(video: Sequence[tuple[int, float]]) -> tuple[float, ...]:
            pairs = [(video[catalogue.property_index(name)], levels) for name, levels in scenario.target.items()]
            return tuple(sum(min(abs(said[i] - x) for x in levels) for said, levels in pairs) for i in (0, 1))

        return f"The most suitable object is {base.LETTERS[min((0, 1), key=lambda i: distance(classes[i]))]})."

    def grade(self, question: Question, prediction: Prediction, catalogue: Catalogue) -> list[Score]:
        return base.choice_score(question, prediction, read(prediction.outputs[-1]))


def _matching(pool: Pool, classes: Mapping[str, tuple[int, ...]]) -> list[str]:
    wanted = [(pool.catalogue.property_index(name), allowed) for name, allowed in classes.items()]
    return [o for o in pool.objects if all(pool.catalogue.labels(o)[place] in allowed for place, allowed in wanted)]


TASK = PropertyScenarioReasoning()
