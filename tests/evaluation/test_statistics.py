"""Statistics against closed forms, brute force and published worked examples."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from pathlib import Path
from statistics import NormalDist

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pipeline.statistics import (
    Interval,
    Outcome,
    Spread,
    clustered,
    compositions,
    confusion,
    icc3k,
    icc3k_interval,
    proportion,
    quadratic_kappa,
    resampled,
    wilson,
)

from pipeline.videos.catalogue import load_catalogue
from tests.closure import ROOT

SHROUT_FLEISS = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
"""The example of Shrout and Fleiss 1979: six targets, four judges."""


@given(n=st.integers(1, 500), data=st.data())
@settings(deadline=None, max_examples=60)
def test_wilson_is_the_closed_form(n: int, data: st.DataObject) -> None:
    k = data.draw(st.integers(0, n))
    z, p = NormalDist().inv_cdf(0.975), k / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    interval = wilson(k, n)
    assert interval.low == pytest.approx(max(0.0, centre - half), abs=1e-12)
    assert interval.high == pytest.approx(min(1.0, centre + half), abs=1e-12)
    # Seen the other way: at its ends the score test of the share just doubts what was counted.
    for end in (interval.low, interval.high):
        assert (p - end) ** 2 * n == pytest.approx(z * z * end * (1 - end), abs=1e-9)


def test_wilson_worked_example() -> None:
    """Newcombe 1998: 81 of 263, the score method without correction."""
    interval = wilson(81, 263)
    assert (round(interval.low, 4), round(interval.high, 4)) == (0.2553, 0.3662)


def test_wilson_takes_the_nearest_whole_number() -> None:
    assert wilson(7.5, 10) == wilson(8, 10)
    with pytest.raises(ValueError, match="n"):
        wilson(0, 0)


def brute_force(outcomes: Sequence[Outcome]) -> Interval:
    """All m**m equally likely ordered resamples, one by one."""
    objects = sorted({o for outcome in outcomes for o in outcome.objects})
    accuracies = []
    for drawn in itertools.product(objects, repeat=len(objects)):
        weights = [math.prod(drawn.count(o) for o in outcome.objects) for outcome in outcomes]
        if sum(weights):
            right = sum(w * o.correct for w, o in zip(weights, outcomes, strict=True))
            accuracies.append(right / sum(weights))
    accuracies.sort()
    low, high = (math.ceil(share * len(accuracies) - 1e-6) - 1 for share in (0.025, 0.975))
    return Interval(accuracies[low], accuracies[high])


@pytest.mark.parametrize("about", [1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_resampled_equals_brute_force(about: int, seed: int) -> None:
    rng = random.Random(seed)
    objects = [f"object {i}" for i in range(5)]
    outcomes = [Outcome(rng.choice([0, 1, 0.5]), tuple(rng.sample(objects, about))) for _ in range(17)]
    ours, reference = resampled(outcomes), brute_force(outcomes)
    assert ours is not None
    assert ours.low == pytest.approx(reference.low, abs=1e-12)
    assert ours.high == pytest.approx(reference.high, abs=1e-12)


@pytest.mark.parametrize("about", [1, 2])
def test_seven_objects_equal_all_823543_ordered_resamples(about: int) -> None:
    """The paper's number of test objects; ten questions each that are right by halves as well."""
    import numpy as np

    rng = np.random.default_rng(about)
    sets = [rng.choice(7, about, replace=False) for _ in range(35)]
    correct = rng.choice([0, 0.5, 1], 35)
    drawn = np.stack(np.unravel_index(np.arange(7**7), (7,) * 7), axis=1).astype(np.int8)
    counts = np.stack([(drawn == o).sum(axis=1, dtype=np.int8) for o in range(7)], axis=1).astype(np.float64)
    weights = [counts[:, s].prod(axis=1) for s in sets]
    total = sum(weights)
    means = sum(w * c for w, c in zip(weights, correct, strict=True))[total > 0] / total[total > 0]
    means.sort()
    low, high = (means[math.ceil(share * len(means) - 1e-6) - 1] for share in (0.025, 0.975))
    found = resampled([Outcome(float(c), tuple(f"{o}" for o in s)) for c, s in zip(correct, sets, strict=True)])
    assert found is not None
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-12)


@pytest.mark.parametrize("clusters", range(1, 9))
def test_every_distinct_resample_is_enumerated_once(clusters: int) -> None:
    every = list(compositions(clusters, clusters))
    assert len(every) == len(set(every)) == math.comb(2 * clusters - 1, clusters)
    assert all(sum(counts) == clusters for counts in every)


def test_seven_objects_have_1716_resamples() -> None:
    assert sum(1 for _ in compositions(7, 7)) == 1716


def test_many_objects_are_drawn_and_close_to_normal_theory() -> None:
    """Forty objects of one question each: the bootstrap of a mean, standard error sqrt(p (1 - p) / n)."""
    outcomes = [Outcome(float(i < 20), (f"object {i}",)) for i in range(40)]
    interval = resampled(outcomes, seed=3)
    assert interval is not None
    assert interval == resampled(outcomes, seed=3)
    half = 1.96 * math.sqrt(0.25 / 40)
    assert interval.low == pytest.approx(0.5 - half, abs=0.03)
    assert interval.high == pytest.approx(0.5 + half, abs=0.03)


def test_one_object_has_nothing_to_resample() -> None:
    for interval in (resampled, clustered):
        assert interval([Outcome(1, ("a",)), Outcome(0, ("a",))]) is None
        assert interval([]) is None
        # Two objects that every question is about cannot be seen to differ either.
        assert interval([Outcome(1, ("a", "b")), Outcome(0, ("b", "a"))]) is None
    assert proportion([Outcome(1, ("a",))]).clustered is None


def test_all_right_is_one() -> None:
    result = proportion([Outcome(1, (o,)) for o in "abcabc"])
    assert result.value == 1
    assert result.resampled == Interval(1, 1), "why it is not the interval that reports give"
    assert result.clustered is not None
    assert (result.clustered.high, result.clustered.low < result.wilson.low) == (1, True)
    assert result.wilson.high == pytest.approx(1)
    assert result.wilson.low < 0.7


def test_order_of_questions_does_not_matter() -> None:
    outcomes = [Outcome(float(i % 3 == 0), ("abcdefg"[i % 7], "abcdefg"[(i * 3 + 1) % 7])) for i in range(38)]
    assert proportion(outcomes) == proportion(outcomes[::-1])


def test_no_questions_no_accuracy() -> None:
    with pytest.raises(ValueError, match="at least one"):
        proportion([])


def test_icc3k_of_shrout_and_fleiss() -> None:
    value = icc3k(SHROUT_FLEISS)
    assert value is not None
    assert round(value, 2) == 0.91


def test_icc3k_ignores_a_rater_who_is_always_stricter() -> None:
    value = icc3k([[x, x + 2, x + 5] for x in (1, 2, 4, 8)])
    assert value == pytest.approx(1)


@pytest.mark.parametrize("ratings", [[], [[1, 2, 3]], [[1], [2]], [[1, 2], [1, 2], [1, 2]], [[2, 2], [2, 2]]])
def test_icc3k_undefined(ratings: list[list[float]]) -> None:
    assert icc3k(ratings) is None
    assert icc3k_interval(ratings) is None


def f_quantile(share: float, first: int, second: int) -> float:
    """The F distribution's quantile, by the inverse of the incomplete beta function."""
    from scipy.special import betaincinv

    x = float(betaincinv(first / 2, second / 2, share))
    return second * x / (first * (1 - x))


def anova(ratings: Sequence[Sequence[float]]) -> tuple[float, int, int]:
    """F of targets over error and its degrees of freedom, from the residuals of the two-way model."""
    import numpy as np

    table = np.array(ratings, dtype=float)
    targets, raters = table.shape
    fitted = table.mean(1, keepdims=True) + table.mean(0, keepdims=True) - table.mean()
    error = ((table - fitted) ** 2).sum() / ((targets - 1) * (raters - 1))
    return float(raters * table.mean(1).var(ddof=1) / error), targets - 1, (targets - 1) * (raters - 1)


@pytest.mark.parametrize("seed", range(6))
def test_icc3k_is_that_of_the_analysis_of_variance(seed: int) -> None:
    rng = random.Random(seed)
    ratings = [[rng.gauss(t, 1) for _ in range(2 + seed % 3)] for t in range(3 + 4 * seed)]
    ratio, targets, errors = anova(ratings)
    value, interval = icc3k(ratings), icc3k_interval(ratings)
    assert value == pytest.approx(1 - 1 / ratio, abs=1e-12)
    assert interval is not None
    assert interval.low == pytest.approx(1 - f_quantile(0.975, targets, errors) / ratio, abs=1e-12)
    assert interval.high == pytest.approx(1 - f_quantile(0.025, targets, errors) / ratio, abs=1e-12)


def test_icc3k_interval_of_shrout_and_fleiss() -> None:
    """F(5, 15) = 11.03 (their table 3: 11.24 / 1.02)."""
    ratio, targets, errors = anova(SHROUT_FLEISS)
    assert (round(ratio, 2), targets, errors) == (11.03, 5, 15)
    interval = icc3k_interval(SHROUT_FLEISS)
    assert interval is not None
    # A quantile's reciprocal is the other tail's quantile with the degrees of freedom exchanged.
    assert interval.low == pytest.approx(1 - f_quantile(0.975, 5, 15) / ratio, rel=1e-9)
    assert interval.high == pytest.approx(1 - f_quantile(0.025, 5, 15) / ratio, rel=1e-9)
    assert (round(interval.low, 2), round(interval.high, 2)) == (0.68, 0.99)


def test_icc3k_interval_covers_the_truth() -> None:
    """Two-way data with variance 1 between targets and of the error: the agreement of 3 raters is 3 / (3 + 1)."""
    rng = random.Random(4)
    covered = 0
    for _ in range(400):
        severity = [rng.gauss(0, 2) for _ in range(3)]
        targets = [rng.gauss(0, 1) for _ in range(12)]
        interval = icc3k_interval([[t + s + rng.gauss(0, 1) for s in severity] for t in targets])
        assert interval is not None
        covered += interval.low <= 0.75 <= interval.high
    assert 0.92 <= covered / 400 <= 0.98


def test_icc3k_interval_of_perfect_agreement_has_no_width() -> None:
    assert icc3k_interval([[0, 0, 0], [1, 1, 1], [2, 2, 2]]) == Interval(1, 1)
    assert icc3k_interval([[x, x + 0.1, x + 0.7] for x in (0.1, 0.2, 0.7)]) == Interval(1, 1)


def test_icc3k_interval_of_two_objects_and_two_raters() -> None:
    """The fewest that there is an interval of: F(1, 1), whose quantiles are squared tangents."""
    ratings = [[0, 1], [3, 2]]
    ratio, targets, errors = anova(ratings)
    assert (ratio, targets, errors) == (pytest.approx(4), 1, 1)
    interval = icc3k_interval(ratings)
    assert interval is not None
    quantile = math.tan(math.pi / 2 * 0.975) ** 2
    assert interval.low == pytest.approx(1 - quantile / 4)
    assert interval.high == pytest.approx(1 - 1 / (4 * quantile))


@st.composite
def rating_tables(draw: st.DrawFn) -> list[list[int]]:
    raters = draw(st.integers(2, 5))
    row = st.lists(st.integers(0, 4), min_size=raters, max_size=raters)
    return draw(st.lists(row, min_size=2, max_size=9))


@given(ratings=rating_tables(), strict=st.lists(st.integers(-9, 9), min_size=5, max_size=5))
def test_icc3k_is_of_consistency_and_lies_in_its_interval(ratings: list[list[int]], strict: list[int]) -> None:
    value, interval = icc3k(ratings), icc3k_interval(ratings)
    assert (value is None) == (interval is None)
    shifted = [[r + s for r, s in zip(row, strict, strict=False)] for row in ratings]
    if value is None or interval is None:
        assert icc3k(shifted) is None
        return
    assert interval.low <= value + 1e-9
    assert value - 1e-9 <= interval.high <= 1
    assert value <= 1
    assert icc3k(shifted) == pytest.approx(value, rel=1e-6, abs=1e-6)
    other = icc3k_interval(shifted)
    assert other is not None
    assert other.low == pytest.approx(interval.low, rel=1e-6, abs=1e-6)
    if value < 1 - 1e-9:
        ratio = anova(ratings)[0]
        assert value == pytest.approx(1 - 1 / ratio, rel=1e-6, abs=1e-9)


def test_icc3k_of_the_papers_ratings() -> None:
    catalogue = load_catalogue(ROOT / Path("pipeline/physiclear"))
    values = [icc3k([o.ratings[i] for o in catalogue.objects.values()]) for i in range(3)]
    assert [round(v, 3) for v in values if v is not None] == [0.893, 0.979, 0.773]


def test_confusion_counts_rows_as_expected() -> None:
    assert confusion([0, 0, 1, 2], [0, 1, 1, 0], 3) == ((1, 1, 0), (0, 1, 0), (1, 0, 0))
    with pytest.raises(ValueError, match="zip"):
        confusion([0], [], 3)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=40))
@settings(deadline=None, max_examples=60)
def test_kappa_is_one_less_the_ratio_of_distances(pairs: list[tuple[int, int]]) -> None:
    expected, predicted = [a for a, _ in pairs], [b for _, b in pairs]
    apart = sum((a - b) ** 2 for a, b in pairs) / len(pairs)
    by_chance = sum((a - b) ** 2 for a in expected for b in predicted) / len(pairs) ** 2
    kappa = quadratic_kappa(expected, predicted, 4)
    if by_chance == 0:
        assert kappa is None
    else:
        assert kappa == pytest.approx(1 - apart / by_chance, abs=1e-12)


def test_kappa_of_cohens_example() -> None:
    """Counts after Cohen 1968 with quadratic weights, by hand."""
    table = [[88, 14, 18], [10, 40, 10], [2, 6, 12]]
    pairs = [(r, c) for r, row in enumerate(table) for c, count in enumerate(row) for _ in range(count)]
    rows, columns = [120, 60, 20], [100, 60, 40]
    apart = 14 + 10 + 10 + 6 + 4 * (18 + 2)
    by_chance = sum((r - c) ** 2 * rows[r] * columns[c] for r in range(3) for c in range(3)) / 200
    kappa = quadratic_kappa([r for r, _ in pairs], [c for _, c in pairs], 3)
    assert kappa == pytest.approx(1 - apart / by_chance, abs=1e-12)
    assert quadratic_kappa([0, 0], [1, 1], 3) == 0, "constant answers that are wrong agree by chance alone"


def test_spread_of_seeds() -> None:
    assert Spread((1.0, 3.0)).deviation == pytest.approx(math.sqrt(2))
    assert Spread((1.0,)).deviation is None
