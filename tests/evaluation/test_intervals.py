"""Intervals over questions that share objects: closed forms, brute force, statsmodels and simulated coverage."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats
from statsmodels.stats.proportion import proportion_confint

from pipeline.evaluation.intervals import accuracy_interval, components, coverage_note, design_of, variance, wilson
from tests.evaluation.conftest import About, designs, single

RIGHT = st.lists(st.booleans(), min_size=24, max_size=24)


def test_components_are_found_on_average() -> None:
    """Pairs of seven objects, twice each: known variances of objects, questions and pairs."""
    design = design_of(tuple(itertools.combinations("abcdefg", 2)) * 2)
    rng, deviations = np.random.default_rng(0), (2.0, 1.5, 1.0)
    drawn = [rng.normal(0, d, (10_000, f.shape[1])) for d, f in zip(deviations, design.factors, strict=True)]
    values = sum(d @ f.T for d, f in zip(drawn, design.factors, strict=True))
    # Components below 0 count as 0, which lifts the smallest a little.
    assert components(values, design).mean(axis=0) == pytest.approx(np.square(deviations), rel=0.08)
    assert float(variance(values, design).mean()) == pytest.approx(float(values.mean(axis=1).var()), rel=0.06)


def test_by_hand() -> None:
    """Six objects, two questions each: Wilson's formula with t and the effective number of questions."""
    right = [(1, 1), (1, 1), (0, 0), (1, 0), (1, 1), (0, 0)]
    p = 7 / 12
    n = p * (1 - p) / (6 / 5 * sum((sum(pair) - 2 * p) ** 2 for pair in right) / 144)
    t = 2.5705818356
    assert n < 12
    centre = (p + t * t / (2 * n)) / (1 + t * t / n)
    half = t / (1 + t * t / n) * math.sqrt(p * (1 - p) / n + t * t / (4 * n * n))
    found = accuracy_interval(np.array(right, dtype=float).ravel(), single(6, 2))
    assert found == pytest.approx((centre - half, centre + half), abs=1e-9)


@given(about=designs(), right=RIGHT, seed=st.integers(0, 9))
def test_it_holds_wilsons_and_depends_on_no_order_or_name(about: About, right: list[bool], seed: int) -> None:
    values = np.array(right[: len(about)], dtype=float)
    found = accuracy_interval(values, about)
    assume(found is not None)
    assert found is not None
    low, high = proportion_confint(values.sum(), len(values), method="wilson")
    assert 0 <= found.low <= low + 1e-9 <= values.mean() + 1e-9
    assert values.mean() - 1e-9 <= high - 1e-9 <= found.high <= 1
    mirrored = accuracy_interval(1 - values, about)
    assert mirrored is not None
    assert (1 - mirrored.high, 1 - mirrored.low) == pytest.approx(found, abs=1e-9)
    names = list("abcdefg")
    random.Random(seed).shuffle(names)
    renamed = [(v, tuple(names["abcdefg".index(n)] for n in row)) for v, row in zip(values, about, strict=True)]
    random.Random(seed).shuffle(renamed)
    other = accuracy_interval(np.array([v for v, _ in renamed]), [row for _, row in renamed])
    assert other == pytest.approx(found, abs=1e-9)


def test_what_cannot_show_that_objects_differ_has_no_interval() -> None:
    for about in ((), (("a",), ("a",)), (("a", "b"), ("b", "a"))):
        assert accuracy_interval(np.ones(len(about)), about) is None
    for about in ((), ((),)):
        with pytest.raises(ValueError, match="some object"):
            design_of(about)


@pytest.mark.parametrize(
    ("objects", "about", "correlation", "least"),
    [(7, 1, 0.7, 0.94), (7, 2, 0.7, 0.92), (7, 3, 0.7, 0.90), (20, 3, 0.3, 0.93)],
)
def test_coverage(objects: int, about: int, correlation: float, least: float) -> None:
    """Right where a normal variable, in part the mean of its objects' own, lies below a quantile; 3000 data sets each.

    For triples of seven objects that matter this is what the note in reports is for.
    """
    rng = np.random.default_rng(objects + about)
    if about == 1:
        rows = single(objects, 5)
    else:
        rows = tuple(tuple(f"{o:02}" for o in rng.choice(objects, about, replace=False)) for _ in range(10 * objects))
    design, shape = design_of(rows), (3000, len(rows))
    own = rng.standard_normal((3000, objects)) @ design.membership.T / math.sqrt(about)
    latent = math.sqrt(correlation) * own + math.sqrt(1 - correlation) * rng.standard_normal(shape)
    for truth in (0.3, 0.5):
        low, high = wilson((latent < stats.norm.ppf(truth)).astype(float), design)
        assert ((low <= truth) & (truth <= high)).mean() >= least
    assert bool(coverage_note(rows)) == (about > 1 and objects < 20)
