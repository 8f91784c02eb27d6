"""ICC(3,k), written out in the audit, against pingouin; its edge cases are in tests/numerics/test_evaluation.py."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pingouin import intraclass_corr
from scipy.special import betaincinv

from pipeline.videos.audit.labels import icc3k

SHROUT_FLEISS = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
"""The example of Shrout and Fleiss 1979: six targets, four judges."""
RNG = np.random.default_rng(0)
DRAWN = [(RNG.normal(size=(n, 1)) + RNG.normal(size=(n, k))).tolist() for n, k in ((3, 2), (8, 4), (30, 3))]


def reference(ratings: list[list[float]]) -> tuple[float, float]:
    """Value and F of targets over error, by pingouin."""
    rows = [(i, j, value) for i, row in enumerate(ratings) for j, value in enumerate(row)]
    table = intraclass_corr(pd.DataFrame(rows, columns=["target", "rater", "value"]), "target", "rater", "value")
    found = table[table["Type"].isin(("ICC3k", "ICC(C,k)"))].iloc[0]
    return float(found["ICC"]), float(found["F"])


def f_quantile(share: float, first: int, second: int) -> float:
    """The F distribution's quantile, by the inverse of the incomplete beta function."""
    x = float(betaincinv(first / 2, second / 2, share))
    return second * x / (first * (1 - x))


@pytest.mark.parametrize("ratings", [SHROUT_FLEISS, *DRAWN])
def test_it_is_pingouins(ratings: list[list[float]]) -> None:
    """Pingouin rounds the interval to two places, so its ends follow from pingouin's F (Shrout and Fleiss 1979)."""
    value, ratio = reference(ratings)
    free, error = len(ratings) - 1, (len(ratings) - 1) * (len(ratings[0]) - 1)
    low, high = (1 - f_quantile(tail, free, error) / ratio for tail in (0.975, 0.025))
    assert icc3k(ratings) == pytest.approx((value, low, high), abs=1e-9)


@given(
    ratings=st.lists(st.lists(st.integers(0, 4), min_size=3, max_size=3), min_size=2, max_size=9),
    strict=st.lists(st.integers(-9, 9), min_size=3, max_size=3),
)
def test_it_is_of_consistency_and_lies_in_its_interval(ratings: list[list[int]], strict: list[int]) -> None:
    found = icc3k(ratings)
    shifted = icc3k([[r + s for r, s in zip(row, strict, strict=True)] for row in ratings])
    if found is None:
        assert shifted is None
    else:
        assert found[1] - 1e-9 <= found[0] <= found[2] + 1e-9 <= 1 + 2e-9
        assert shifted == pytest.approx(found, rel=1e-6, abs=1e-6)
