"""Scores by variant and measure, as the tables about the language model look them up."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping

from pipeline.records import Score, Task
from pipeline.reporting.accuracy import Measure
from pipeline.reporting.inputs import Inputs
from pipeline.statistics import Answer
from pipeline.tasks import TASKS

FAILED = "not passed"


class Answered:
    """Scores by variant and measure."""

    def __init__(self, inputs: Inputs) -> None:
        self.inputs = inputs
        self._scores: dict[tuple[str, Task, str], dict[str, Score]] = defaultdict(dict)
        for key, scores in inputs.scores.items():
            for score in scores:
                self._scores[key, score.task, score.measure][score.question_id] = score

    def scores(self, key: str, measure: Measure) -> dict[str, Score]:
        """By question."""
        return self._scores.get((key, measure.task, measure.name), {})

    def every(self, keys: Iterable[str], measure: Measure) -> list[Score]:
        """Of several variants."""
        return [s for key in keys for s in self.scores(key, measure).values()]

    def runs(self, keys: Mapping[int, str], measure: Measure) -> list[Answer]:
        """A variant's answers under each seed that has any, to the questions that all these have answered.

        Args:
            keys: Seed to key.
        """
        found = {seed: scores for seed, key in keys.items() if (scores := self.scores(key, measure))}
        asked = shared(found.values())
        return [
            Answer(q, seed, float(scores[q].correct), scores[q].objects)
            for seed, scores in found.items()
            for q in asked
        ]

    def gains(self, pairs: Mapping[int, tuple[str, str]], measure: Measure) -> list[Answer]:
        """How much more often the first of two variants is right, on the questions that all of them have answered.

        Args:
            pairs: Seed to keys; a seed under which either has no answer is left out.
        """
        both = {seed: [self.scores(key, measure) for key in pair] for seed, pair in pairs.items()}
        both = {seed: pair for seed, pair in both.items() if all(pair)}
        asked = shared(scores for pair in both.values() for scores in pair)
        return [
            Answer(q, seed, float(one[q].correct - other[q].correct), one[q].objects)
            for seed, (one, other) in both.items()
            for q in asked
        ]

    def chance(self, measure: Measure) -> float:
        """Accuracy of a uniform guess."""
        return TASKS[measure.task].chance(self.inputs.catalogue)[measure.name]

    def gate(self, measure: Measure) -> str:
        """Whether the base language model passes the task's gate, and whether questions tell what it need not know."""
        passed = self.inputs.gate.get(measure.task)
        words = [] if passed is None else ["passed" if passed else FAILED]
        words += ["facts told"] * self.inputs.told(measure.task)
        return ", ".join(words)


def shared(answered: Iterable[Mapping[str, Score]]) -> list[str]:
    """The questions that all have answered, sorted."""
    asked = [set(scores) for scores in answered]
    return sorted(set.intersection(*asked)) if asked else []
