"""Scores by variant and measure, as the tables about the language model look them up."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from pipeline.records import Score, Task
from pipeline.reporting.accuracy import Measure
from pipeline.reporting.inputs import Inputs
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

    def chance(self, measure: Measure) -> float:
        """Accuracy of a uniform guess."""
        return TASKS[measure.task].chance(self.inputs.catalogue)[measure.name]

    def gate(self, measure: Measure) -> str:
        """Whether the base language model passes the task's gate, and whether questions tell what it need not know."""
        passed = self.inputs.gate.get(measure.task)
        words = [] if passed is None else ["passed" if passed else FAILED]
        words += ["facts told"] * self.inputs.told(measure.task)
        return ", ".join(words)
