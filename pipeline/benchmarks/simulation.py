"""Answers drawn from a model whose accuracy is known, to hold intervals and tests against it.

An answer is right where a normal variable lies below the quantile that belongs to the accuracy; part of the variable's
variance (the correlation) is the sum of its objects' own, so that every question has exactly that accuracy over all
objects, whatever it is about. Questions about one object come five to each (one a video); questions about two or three
reuse the videos and are twice as many, about sets of objects that are drawn once a design.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.runtime import derive_seed
from pipeline.statistics.clusters import Clusters, Values, clusters_of

VIDEOS = 5
SHARED = 0.5
"""Of what makes a question right or wrong, the part that two settings have in common."""
RUNS = 0.02
"""Of the variance, what is due to the run: accuracies of .5 deviate by 5 to 6 points over seeds."""


@dataclass(frozen=True)
class Design:
    """What is simulated."""

    objects: int
    about: int
    """Objects that a question is about."""
    correlation: float
    """Between what makes two answers about the same objects right, before it is cut into right and wrong."""

    def questions(self) -> tuple[tuple[int, ...], ...]:
        """Each question's objects, by number; the same whenever it is asked."""
        return _questions(self.objects, self.about)

    def clusters(self) -> Clusters:
        """As the intervals need it. Names are padded, so that objects sort by number."""
        return clusters_of(tuple(tuple(f"{o:02}" for o in s) for s in self.questions()))

    def generator(self, *purpose: object) -> np.random.Generator:
        """Randomness of its own for every purpose."""
        return np.random.default_rng(derive_seed(self, *purpose))

    def latent(self, rng: np.random.Generator, repetitions: int) -> Values:
        """Standard normal: repetitions x questions."""
        membership = self.clusters().membership
        own = rng.standard_normal((repetitions, self.objects)) @ membership.T / np.sqrt(self.about)
        rest = rng.standard_normal((repetitions, len(membership)))
        drawn: Values = np.sqrt(self.correlation) * own + np.sqrt(1 - self.correlation) * rest
        return drawn

    def answers(self, truths: Iterable[float], repetitions: int) -> list[Values]:
        """Right (1) or wrong (0), repetitions x questions, for each true accuracy."""
        latent = self.latent(self.generator("answers"), repetitions)
        return [(latent < _threshold(truth)).astype(np.float64) for truth in truths]

    def differences(self, pairs: Iterable[tuple[float, float]], repetitions: int) -> list[Values]:
        """Of two settings with these accuracies on the same questions: 1, 0 or -1, repetitions x questions.

        What the settings do not have in common is correlated within objects as well.
        """
        rng = self.generator("differences")
        both, first, second = (self.latent(rng, repetitions) for _ in range(3))
        one, other = (np.sqrt(SHARED) * both + np.sqrt(1 - SHARED) * own for own in (first, second))
        return [(one < _threshold(a)).astype(np.float64) - (other < _threshold(b)) for a, b in pairs]

    def runs(self, truths: Iterable[float], seeds: int, repetitions: int) -> list[Values]:
        """Right or wrong under several seeds, repetitions x seeds x questions.

        Runs are better or worse as a whole (`RUNS` of the variance); half of what neither objects nor runs explain is
        the question's, the other half its answer's in one run.
        """
        lasting, passing = self._of_runs(self.generator("runs", seeds), seeds, repetitions)
        return [(lasting + passing < _threshold(truth)).astype(np.float64) for truth in truths]

    def run_differences(self, pairs: Iterable[tuple[float, float]], seeds: int, repetitions: int) -> list[Values]:
        """Of two settings, each run under several seeds: 1, 0 or -1, repetitions x seeds x questions.

        As `runs`; of what objects and questions make under all seeds, `SHARED` is common to both settings.
        """
        rng = self.generator("run differences", seeds)
        both, _ = self._of_runs(rng, 1, repetitions)
        found = []
        for _ in range(2):
            lasting, passing = self._of_runs(rng, seeds, repetitions)
            found.append(np.sqrt(SHARED) * both + np.sqrt(1 - SHARED) * lasting + passing)
        one, other = found
        return [(one < _threshold(a)).astype(np.float64) - (other < _threshold(b)) for a, b in pairs]

    def _of_runs(self, rng: np.random.Generator, seeds: int, repetitions: int) -> tuple[Values, Values]:
        """What objects and questions make under all seeds (repetitions x 1 x questions), and what runs and single
        answers bring (repetitions x seeds x questions); their sum is standard normal."""
        membership = self.clusters().membership
        own = rng.standard_normal((repetitions, 1, self.objects)) @ membership.T / np.sqrt(self.about)
        run = rng.standard_normal((repetitions, seeds, 1))
        question = rng.standard_normal((repetitions, 1, len(membership)))
        answer = rng.standard_normal((repetitions, seeds, len(membership)))
        rest = np.sqrt((1 - self.correlation - RUNS) / 2)
        return np.sqrt(self.correlation) * own + rest * question, np.sqrt(RUNS) * run + rest * answer


@lru_cache(maxsize=4)
def _questions(objects: int, about: int) -> tuple[tuple[int, ...], ...]:
    if about == 1:
        return tuple((o,) for o in range(objects) for _ in range(VIDEOS))
    rng = np.random.default_rng(derive_seed("sets", objects, about))
    drawn = (rng.choice(objects, about, replace=False) for _ in range(2 * VIDEOS * objects))
    return tuple(tuple(sorted(s.tolist())) for s in drawn)


def _threshold(truth: float) -> float:
    from scipy.stats import norm

    return float(norm.ppf(truth))
