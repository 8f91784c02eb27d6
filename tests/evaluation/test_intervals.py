"""Intervals and paired comparisons: closed forms, brute force, scipy, statsmodels, quadrature, simulated coverage."""

import itertools
import math
import random
from statistics import fmean

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad
from statsmodels.stats.proportion import proportion_confint

from pipeline.evaluation.intervals import accuracy_interval, components, coverage_note, design_of, variance, wilson
from pipeline.evaluation.paired import FLIPS, flip_units, paired, sign_flip, smallest_effect, standard_error
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


def test_an_interval_by_hand() -> None:
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
def test_intervals_cover(objects: int, about: int, correlation: float, least: float) -> None:
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


GAINS = st.lists(st.integers(-1, 1), min_size=24, max_size=24)


def test_a_comparison_by_hand() -> None:
    """Four objects of three questions: Bonett and Price's interval with the effective number of questions and t."""
    rows = np.array([(1, 1, 0), (1, 0, 0), (0, 0, -1), (1, 1, 1)], dtype=float)
    gap = paired(rows.reshape(1, 12), single(4, 3))
    d, square = 5 / 12, 7 / 12
    n = (square - d * d) * 12 / 11 / (4 / 3 * sum((sum(x) - 3 * d) ** 2 for x in rows) / 144)
    assert n < 12
    centre = n * d / (n + 2)
    half = 3.1824463053 * math.sqrt(((n * square + 2) / (n + 2) - centre**2) / (n + 2))
    assert (gap.difference, gap.low, gap.high) == pytest.approx((d, centre - half, min(1, centre + half)), abs=1e-9)
    ways = [abs(sum(s * x for s, x in zip(signs, (2, 1, -1, 3), strict=True))) for signs in signs_of(4)]
    assert gap.p == fmean(way >= 5 for way in ways)
    assert (gap.n, gap.objects, gap.seeds) == (12, 4, 1)


def signs_of(count: int) -> list[tuple[int, ...]]:
    return list(itertools.product((1, -1), repeat=count))


def test_without_difference_with_one_object_and_with_none() -> None:
    gap = paired(np.zeros((1, 3)), single(3, 1))
    assert (gap.difference, gap.p) == (0, 1)
    assert gap.low is not None
    assert gap.low == -gap.high < 0, "that nothing was seen is no proof that nothing is there"  # type: ignore[operator]
    alone = paired(np.array([[1.0, 0.0]]), (("a",), ("a",)))
    assert (alone.difference, alone.low, alone.high, alone.p, alone.smallest_effect) == (0.5, None, None, None, None)
    with pytest.raises(ValueError, match="there must be questions"):
        paired(np.ones((1, 0)), ())


@given(about=designs(), gains=GAINS, more=GAINS, seed=st.integers(0, 9))
def test_a_comparison_turned_round_or_reordered(about: About, gains: list[int], more: list[int], seed: int) -> None:
    values = np.array([gains[: len(about)], more[: len(about)]], dtype=float)
    gap, mirrored = paired(values, about), paired(-values, about)
    order = random.Random(seed).sample(range(len(about)), len(about))
    assert paired(values[:, order], [about[i] for i in order]) == gap
    assert mirrored.difference == pytest.approx(-gap.difference)
    if gap.low is not None and gap.high is not None and gap.p is not None and gap.smallest_effect is not None:
        assert -1 <= gap.low <= gap.difference <= gap.high <= 1
        assert (-mirrored.high, -mirrored.low) == pytest.approx((gap.low, gap.high))  # type: ignore[operator]
        assert mirrored.p == gap.p
        assert gap.smallest_effect > 0
        units = flip_units(design_of(about))
        assert 2 / 2 ** len(units) <= gap.p <= 1
        # What is flipped adds up to what is tested.
        assert float((units @ values[0]).sum()) == pytest.approx(values[0].sum(), abs=1e-9)


def test_sign_flip_of_darwins_maize() -> None:
    """Fisher 1935, section 21: of 32768 ways to sign the 15 differences, 1726 are as far from 0."""
    differences = np.array([49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48], dtype=float)
    assert sign_flip(differences, design_of(single(15, 1))) == 1726 / 32768
    # A sixteenth object that brings nothing changes no sum, but there are too many now to go through.
    drawn = sign_flip(np.append(differences, 0.0), design_of(single(16, 1)))
    assert drawn == pytest.approx(1726 / 32768, abs=0.007)
    assert sign_flip(np.ones(40), design_of(single(40, 1))) == 1 / (FLIPS + 1)


def test_pairs_are_split_by_least_squares_and_all_signs_gone_through() -> None:
    """Each difference as the mean of its objects' effects; their shares of the sum are flipped, one by one."""
    about = tuple(itertools.combinations("abcde", 2))
    values = np.random.default_rng(2).integers(-1, 2, len(about)).astype(float)
    shares = np.array([[0.5 * (name in row) for name in "abcde"] for row in about])
    parts = np.linalg.lstsq(shares, values, rcond=None)[0] * shares.sum(axis=0)
    assert parts.sum() == pytest.approx(values.sum())
    far = [abs(float(np.dot(signs, parts))) >= abs(values.sum()) - 1e-9 for signs in signs_of(5)]
    assert sign_flip(values, design_of(about)) == pytest.approx(fmean(far), abs=1e-12)


def test_what_questions_cannot_tell_apart_is_flipped_together() -> None:
    pairs = design_of((("a", "b"), ("c", "d"), ("c", "d"), ("e", "f")))
    assert flip_units(pairs).tolist() == [[1, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 1]]
    assert sign_flip(np.ones(4), pairs) == 2 / 8
    chain = design_of((("a", "b"), ("b", "c"), ("c", "d")))
    assert sign_flip(np.ones(3), chain) is None, "one part has one sign"


def test_several_seeds_are_one_comparison_of_their_means() -> None:
    rng = np.random.default_rng(5)
    table, about = rng.integers(-1, 2, (4, 35)).astype(float), single(7, 5)
    several, means = paired(table, about), paired(table.mean(axis=0, keepdims=True), about)
    assert (several.difference, several.p) == (pytest.approx(table.mean()), means.p)
    again = paired(np.tile(table[:1], (3, 1)), about)
    one = paired(table[:1], about)
    assert (again.low, again.high, again.p) == pytest.approx((one.low, one.high, one.p)), "the same answers add nothing"


def test_the_interval_covers_new_seeds() -> None:
    """Two equally good settings whose runs deviate by ten points: what leaves the seeds out covers less."""
    rng, objects, seeds, repeats = np.random.default_rng(2), 20, 5, 300
    sets = [rng.choice(objects, 2, replace=False) for _ in range(100)]
    design = design_of(tuple(tuple(f"{o:02}" for o in sorted(s)) for s in sets))
    of_seeds = rng.normal(0, 0.1, (repeats, 2, seeds, 1))
    rates = 0.5 + of_seeds + rng.normal(0, 0.05, (repeats, 2, 1, objects))[..., sets].mean(axis=-1)
    right = (rng.random((repeats, 2, seeds, 100)) < rates).astype(float)
    gains = right[:, 0] - right[:, 1]

    def covered(values: np.ndarray) -> float:
        error, centre, freedom = standard_error(values, design)
        return float((np.abs(centre) <= stats.t.ppf(0.975, freedom) * error).mean())

    assert covered(gains) >= 0.93
    assert covered(gains.mean(axis=1, keepdims=True)) <= 0.88


@pytest.mark.parametrize("freedom", [1, 2.5, 6, 59])
def test_the_smallest_effect_has_its_power_by_quadrature(freedom: float) -> None:
    """Over the deviation's distribution, the normal mean beyond the critical value on either side."""
    shift, critical = smallest_effect(1, freedom), stats.t.ppf(0.975, freedom)

    def found(s: float) -> float:
        beyond = stats.norm.sf(critical * s - shift) + stats.norm.cdf(-critical * s - shift)
        return float(beyond * stats.chi.pdf(s * math.sqrt(freedom), freedom) * math.sqrt(freedom))

    assert quad(found, 0, 10, limit=200, points=[1])[0] == pytest.approx(0.8, abs=1e-7)
