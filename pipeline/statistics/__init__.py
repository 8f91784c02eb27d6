"""How sure a figure is: intervals, tests, agreement, confusion, and what a design can show.

Importing this is quick: NumPy, scipy and scikit-learn are loaded by what needs them. What works on arrays of many data
sets at once is in `clusters`, `bounds`, `flips` and `seeds.crossed`; everything here takes one.
"""

from __future__ import annotations

from pipeline.statistics.agreement import confusion, icc3k, icc3k_interval, quadratic_kappa
from pipeline.statistics.design import Deviations, deviations, planned_error, smallest_effect
from pipeline.statistics.factorial import Factor, FactorialEffect, factorial_effects
from pipeline.statistics.figures import Answer, Interval, Outcome, Spread
from pipeline.statistics.paired import Difference, holm, mcnemar, paired, paired_over_seeds
from pipeline.statistics.proportions import Proportion, clustered, proportion, wilson
from pipeline.statistics.resampling import compositions, resampled
from pipeline.statistics.seeds import OverSeeds, SeedParts, over_seeds

__all__ = [
    "Answer",
    "Deviations",
    "Difference",
    "Factor",
    "FactorialEffect",
    "Interval",
    "Outcome",
    "OverSeeds",
    "Proportion",
    "SeedParts",
    "Spread",
    "clustered",
    "compositions",
    "confusion",
    "deviations",
    "factorial_effects",
    "holm",
    "icc3k",
    "icc3k_interval",
    "mcnemar",
    "over_seeds",
    "paired",
    "paired_over_seeds",
    "planned_error",
    "proportion",
    "quadratic_kappa",
    "resampled",
    "smallest_effect",
    "wilson",
]
