"""Variances over questions that share objects, and the intervals and tests made of them."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pipeline.statistics import Interval, Outcome, clustered, resampled, wilson
from pipeline.statistics.clusters import clusters_of, components, overlapping_variance, variance
from pipeline.statistics.flips import DRAWS, flip_units, least_p, sign_flip
from scipy import stats

About = tuple[tuple[str, ...], ...]


@st.composite
def designs(draw: st.DrawFn, least: int = 2) -> About:
    """Questions about one to three of up to seven objects."""
    names = "abcdefg"[: draw(st.integers(least, 7))]
    sets = st.lists(st.sampled_from(names), min_size=1, max_size=min(3, len(names)), unique=True)
    rows = draw(st.lists(sets, min_size=2, max_size=24))
    return tuple(tuple(row) for row in rows)


def single(objects: int, each: int) -> About:
    return tuple((f"{o:02}",) for o in range(objects) for _ in range(each))


def ordinary(values: np.ndarray, about: About) -> float:
    """Cluster-robust variance of a mean with G / (G - 1)."""
    names = [row[0] for row in about]
    groups = sorted(set(names))
    sums = [sum(v - values.mean() for v, n in zip(values, names, strict=True) if n == g) for g in groups]
    return len(groups) / (len(groups) - 1) * math.fsum(s * s for s in sums) / len(values) ** 2


@pytest.mark.parametrize("seed", range(8))
def test_single_objects_have_the_ordinary_cluster_robust_variance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    about = single(7, 5)
    values = (np.repeat(rng.random(7), 5) > rng.random(35)).astype(float)
    reference, clusters = ordinary(values, about), clusters_of(about)
    assert float(overlapping_variance(values, clusters)) == pytest.approx(reference, rel=1e-12)
    independent = values.var(ddof=1) / 35
    found = float(variance(values, clusters))
    if reference >= independent:
        assert found == pytest.approx(reference, rel=1e-9)
    else:
        assert found >= independent * (1 - 1e-12)


def test_one_question_an_object_has_the_variance_of_independent_questions() -> None:
    values = np.array([0.0, 1, 1, 0, 1, 1])
    clusters = clusters_of(single(6, 1))
    assert len(clusters.factors) == 1, "objects and questions are the same"
    for found in (variance, overlapping_variance):
        assert float(found(values, clusters)) == pytest.approx(values.var(ddof=1) / 6, rel=1e-12)


@given(about=designs(), seed=st.integers(0, 99))
@settings(deadline=None, max_examples=50)
def test_overlapping_variance_is_the_sum_over_pairs_that_share_an_object(about: About, seed: int) -> None:
    values = np.random.default_rng(seed).random(len(about))
    rest = values - values.mean()
    shared = [(i, j) for i, a in enumerate(about) for j, b in enumerate(about) if set(a) & set(b)]
    found = float(overlapping_variance(values, clusters_of(about)))
    if len(shared) == len(about) ** 2:
        assert math.isnan(found)
    else:
        reference = sum(rest[i] * rest[j] for i, j in shared) / (len(about) ** 2 - len(shared))
        assert found == pytest.approx(reference, rel=1e-9, abs=1e-12)


@given(about=designs())
@settings(deadline=None, max_examples=50)
def test_moments_are_what_the_model_expects(about: About) -> None:
    clusters = clusters_of(about)
    n = len(about)
    centre = np.eye(n) - 1 / n
    groups = [np.eye(n) if f is None else f for f in clusters.factors]
    for i, a in enumerate(groups):
        for j, b in enumerate(groups):
            expected = np.trace(centre @ a @ a.T @ centre @ b @ b.T)
            assert clusters.moments[i, j] == pytest.approx(expected, rel=1e-9, abs=1e-9)
            assert clusters.totals[j] == pytest.approx((b @ b.T).sum())


def test_components_are_found_on_average() -> None:
    """Pairs of seven objects, twice each: known variances of objects, pairs and questions."""
    about = tuple(itertools.combinations("abcdefg", 2)) * 2
    clusters = clusters_of(about)
    assert len(clusters.factors) == 3
    rng, deviations = np.random.default_rng(0), (2.0, 1.0, 1.5)
    sizes = [len(about) if f is None else f.shape[1] for f in clusters.factors]
    drawn = [rng.normal(0, d, (20_000, s)) for d, s in zip(deviations, sizes, strict=True)]
    values = sum(d if f is None else d @ f.T for d, f in zip(drawn, clusters.factors, strict=True))
    found = components(values, clusters).mean(axis=0)
    # Components below 0 count as 0, which lifts the smallest a little.
    assert found == pytest.approx(np.square(deviations), rel=0.08)
    true = float(values.mean(axis=1).var())
    assert float(variance(values, clusters).mean()) == pytest.approx(true, rel=0.06)
    assert float(overlapping_variance(values, clusters).mean()) == pytest.approx(true, rel=0.06)


def test_clustered_by_hand() -> None:
    """Six objects, two questions each: Wilson's formula with t and the effective number of questions."""
    right = [(1, 1), (1, 1), (0, 0), (1, 0), (1, 1), (0, 0)]
    outcomes = [Outcome(x, (f"{o}",)) for o, pair in enumerate(right) for x in pair]
    p = 7 / 12
    v = 6 / 5 * sum((sum(pair) - 2 * p) ** 2 for pair in right) / 144
    n, t = p * (1 - p) / v, 2.5705818356
    assert n < 12
    centre = (p + t * t / (2 * n)) / (1 + t * t / n)
    half = t / (1 + t * t / n) * math.sqrt(p * (1 - p) / n + t * t / (4 * n * n))
    found = clustered(outcomes)
    assert found is not None
    assert (found.low, found.high) == pytest.approx((centre - half, centre + half), abs=1e-9)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_all_alike_counts_objects(value: float) -> None:
    found = clustered([Outcome(value, (o,)) for o in "abcdefg" for _ in range(5)])
    assert found is not None
    c = 2.4469118511**2 / 7
    assert (found.low, found.high) == pytest.approx((0, c / (1 + c)) if value == 0 else (1 / (1 + c), 1), abs=1e-9)


@given(about=designs(), right=st.lists(st.booleans(), min_size=24, max_size=24), seed=st.integers(0, 9))
@settings(deadline=None, max_examples=80)
def test_clustered_properties(about: About, right: list[bool], seed: int) -> None:
    outcomes = [Outcome(float(r), o) for r, o in zip(right, about, strict=False)]
    found = clustered(outcomes)
    assume(found is not None)
    assert found is not None
    k = sum(o.correct for o in outcomes)
    assert 0 <= found.low <= k / len(outcomes) <= found.high <= 1
    naive = wilson(k, len(outcomes))
    assert found.low <= naive.low + 1e-9
    assert found.high >= naive.high - 1e-9
    mirrored = clustered([Outcome(1 - o.correct, o.objects) for o in outcomes])
    assert mirrored is not None
    assert (1 - mirrored.high, 1 - mirrored.low) == pytest.approx((found.low, found.high), abs=1e-9)
    names = list("abcdefg")
    random.Random(seed).shuffle(names)
    renamed = [Outcome(o.correct, tuple(names["abcdefg".index(n)] for n in o.objects)) for o in outcomes]
    random.Random(seed).shuffle(renamed)
    other = clustered(renamed)
    assert other is not None
    assert (other.low, other.high) == pytest.approx((found.low, found.high), abs=1e-9)


@given(about=designs(), right=st.lists(st.booleans(), min_size=24, max_size=24), place=st.integers(0, 23))
@settings(deadline=None, max_examples=40)
def test_resampled_and_wilson_rise_with_every_right_answer(about: About, right: list[bool], place: int) -> None:
    first = [Outcome(float(r), o) for r, o in zip(right, about, strict=False)]
    more = [Outcome(1.0 if i == place % len(first) else o.correct, o.objects) for i, o in enumerate(first)]
    pairs = [(resampled(first), resampled(more))]
    pairs += [(wilson(sum(o.correct for o in first), len(first)), wilson(sum(o.correct for o in more), len(more)))]
    for before, after in pairs:
        if before and after:
            assert after.low >= before.low - 1e-12
            assert after.high >= before.high - 1e-12


def test_resampled_against_scipys_bootstrap() -> None:
    values = np.random.default_rng(3).random(12)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=20_000, method="percentile", rng=1).confidence_interval
    ours = resampled([Outcome(v, (f"{i}",)) for i, v in enumerate(values)])
    assert ours is not None
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=0.01)


def test_the_same_object_twice_counts_once() -> None:
    twice = [Outcome(float(i % 2), ("abc"[i % 3], "abc"[i % 3])) for i in range(9)]
    once = [Outcome(o.correct, o.objects[:1]) for o in twice]
    assert clustered(twice) == clustered(once)
    assert resampled(twice) == resampled(once)
    for about in ((), ((),)):
        with pytest.raises(ValueError, match="some object"):
            clusters_of(about)


# The sign-flip test


def test_sign_flip_of_darwins_maize() -> None:
    """Fisher 1935, section 21: of 32768 ways to sign the 15 differences, 1726 are as far from 0."""
    differences = np.array([49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48], dtype=float)
    assert float(sign_flip(differences, clusters_of(single(15, 1)))) == 1726 / 32768


@pytest.mark.parametrize("seed", range(6))
def test_sign_flip_against_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(-1, 2, size=35) + 0.1 * rng.integers(-3, 4, size=35)
    sums = values.reshape(7, 5).sum(axis=1)
    theirs = stats.permutation_test(
        (sums,), lambda x, axis: x.sum(axis=axis), permutation_type="samples", n_resamples=np.inf, vectorized=True
    )
    assert float(sign_flip(values, clusters_of(single(7, 5)))) == pytest.approx(theirs.pvalue, abs=1e-12)


def test_seven_objects_that_all_gain_have_the_smallest_p() -> None:
    p = sign_flip(np.ones(35), clusters_of(single(7, 5)))
    assert float(p) == least_p(7) == 2 / 128
    assert least_p(40) == 1 / (DRAWS + 1)


@given(about=designs(), gains=st.lists(st.integers(-1, 1), min_size=24, max_size=24))
@settings(deadline=None, max_examples=80)
def test_sign_flip_properties(about: About, gains: list[int]) -> None:
    values, clusters = np.array(gains[: len(about)], dtype=float), clusters_of(about)
    p, units = float(sign_flip(values, clusters)), flip_units(clusters)
    assert least_p(len(units)) <= p <= 1
    assert float(sign_flip(-values, clusters)) == p
    if values.sum() == 0:
        assert p == 1
    # What is flipped adds up to what is tested.
    assert float((units @ values).sum()) == pytest.approx(values.sum(), abs=1e-9)
    relabelled = clusters_of(tuple(tuple({"a": "g", "g": "a"}.get(o, o) for o in row) for row in about))
    assert float(sign_flip(values, relabelled)) == pytest.approx(p, abs=1e-12)


@pytest.mark.parametrize("about", [1, 2, 3])
def test_flips_have_at_least_the_variance_that_chance_has(about: int) -> None:
    """Objects' own effects exactly; questions' own chance at least as often as they have objects."""
    rows = tuple(itertools.combinations("abcdefg", about)) * 2
    clusters = clusters_of(rows)
    units = flip_units(clusters)
    effects = units @ clusters.membership / about
    assert effects == pytest.approx(np.diag(clusters.membership.sum(axis=0) / about), abs=1e-9)
    assert (units**2).sum() >= about * len(rows) - 1e-9


def test_what_questions_cannot_tell_apart_is_flipped_together() -> None:
    pairs = clusters_of((("a", "b"), ("c", "d"), ("c", "d"), ("e", "f")))
    assert flip_units(pairs).tolist() == [[1, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 1]]
    assert float(sign_flip(np.array([1.0, 1, 1, 1]), pairs)) == 2 / 8
    chain = clusters_of((("a", "b"), ("b", "c"), ("c", "d")))
    assert float(sign_flip(np.array([1.0, 1, 1]), chain)) == 1, "one part has one sign"


def test_drawn_signs_agree_with_all_of_them() -> None:
    values = np.random.default_rng(1).normal(0.3, 1, 15)
    exact = float(sign_flip(values, clusters_of(single(15, 1))))
    # A sixteenth object that brings nothing changes no sum, but there are too many now to go through.
    drawn = float(sign_flip(np.append(values, 0.0), clusters_of(single(16, 1))))
    assert drawn == pytest.approx(exact, abs=0.012)
    assert drawn != exact


def test_intervals_and_tests_take_many_data_sets() -> None:
    about = tuple(itertools.combinations("abcde", 2))
    table, clusters = np.random.default_rng(0).random((4, 3, len(about))), clusters_of(about)
    for function in (variance, overlapping_variance, sign_flip):
        found = function(table, clusters)
        assert found.shape == (4, 3)
        assert found[2, 1] == pytest.approx(float(function(table[2, 1], clusters)), rel=1e-9)
    assert isinstance(clustered([Outcome(0.5, o) for o in about]), Interval)
