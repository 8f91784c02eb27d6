"""How base models reason about objects that are described to them in words, without touch."""

from __future__ import annotations

from collections.abc import Iterable

from statsmodels.stats.proportion import proportion_confint

from pipeline.evaluation.intervals import LEVEL
from pipeline.records import ALL_SEEDS, DESCRIBED, Described, ScoreRow
from pipeline.tasks import TASKS
from pipeline.videos.catalogue import Catalogue


def described_rows(found: Iterable[Described], catalogue: Catalogue) -> list[ScoreRow]:
    """Their rows of scores.csv: the measure is the task, the encoder's place holds the model's name.

    Intervals are Wilson's (1927) over questions, since each question makes up objects of its own.
    """
    rows = []
    for asked in found:
        task = TASKS.get(asked.task)
        low, high = proportion_confint(asked.right, asked.n, alpha=1 - LEVEL, method="wilson")
        rows.append(
            ScoreRow(
                task=DESCRIBED,
                measure=asked.task,
                encoder=asked.model,
                seed=ALL_SEEDS,
                n=asked.n,
                right=asked.right,
                unread=asked.unread,
                accuracy=asked.right / asked.n,
                low=float(low),
                high=float(high),
                chance=task.chance(catalogue)[task.measure] if task else None,
            )
        )
    return rows
