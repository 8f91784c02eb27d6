"""Comparisons on the same questions, seeds, factorial effects and what a design can find."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from fractions import Fraction
from statistics import fmean

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pipeline.statistics import (
    Answer,
    Factor,
    Outcome,
    clustered,
    deviations,
    factorial_effects,
    holm,
    mcnemar,
    over_seeds,
    paired,
    paired_over_seeds,
    planned_error,
    smallest_effect,
)
from scipy import stats
from scipy.integrate import quad


def test_paired_by_hand() -> None:
    """Four objects of three questions: Bonett and Price's interval with the effective number of questions and t."""
    rows = {"a": (1, 1, 0), "b": (1, 0, 0), "c": (0, 0, -1), "d": (1, 1, 1)}
    gap = paired([Outcome(x, (o,)) for o, values in rows.items() for x in values])
    d, square = 5 / 12, 7 / 12
    v = 4 / 3 * sum((sum(x) - 3 * d) ** 2 for x in rows.values()) / 144
    n = (square - d * d) * 12 / 11 / v
    assert n < 12
    centre = n * d / (n + 2)
    half = 3.1824463053 * math.sqrt(((n * square + 2) / (n + 2) - centre**2) / (n + 2))
    assert gap.value == pytest.approx(d)
    assert gap.interval is not None
    assert (gap.interval.low, gap.interval.high) == pytest.approx((centre - half, min(1, centre + half)), abs=1e-9)
    # Sums 2, 1, -1, 3: flipping the third (7), none (5), the second and none else of the rest (3)...
    sums = (2, 1, -1, 3)
    far = [
        abs(sum(s * x for s, x in zip(signs, sums, strict=True))) >= 5 for signs in itertools.product((1, -1), repeat=4)
    ]
    assert gap.p == fmean(far)
    assert gap.least == 2 / 16
    assert gap.mcnemar == 2 * (1 + 7) / 2**7


@given(better=st.integers(0, 12), worse=st.integers(0, 12), same=st.integers(0, 12))
@settings(deadline=None, max_examples=60)
def test_independent_questions_have_bonett_and_prices_interval(better: int, worse: int, same: int) -> None:
    """One question an object: both kinds of discordant questions get one more, and t stands in place of z."""
    n = better + worse + same
    if n < 2 or max(better, worse, same) == n:
        return
    values = [1.0] * better + [-1.0] * worse + [0.0] * same
    gap = paired([Outcome(v, (f"{i:02}",)) for i, v in enumerate(values)])
    one, other = (better + 1) / (n + 2), (worse + 1) / (n + 2)
    half = stats.t.ppf(0.975, n - 1) * math.sqrt((one + other - (one - other) ** 2) / (n + 2))
    assert gap.interval is not None
    # It must hold the difference itself, which the two more questions pull towards nothing.
    low, high = min(one - other - half, gap.value), max(one - other + half, gap.value)
    assert gap.interval.low == pytest.approx(max(-1.0, low), abs=1e-12)
    assert gap.interval.high == pytest.approx(min(1.0, high), abs=1e-12)


def test_paired_without_difference_and_with_one_object() -> None:
    gap = paired([Outcome(0.0, (o,)) for o in "abc"])
    assert (gap.value, gap.p, gap.mcnemar) == (0, 1, 1)
    assert gap.interval is not None
    assert gap.interval.low == -gap.interval.high < 0, "that nothing was seen is no proof that nothing is there"
    alone = paired([Outcome(1.0, ("a",)), Outcome(0.0, ("a",))])
    assert (alone.value, alone.interval, alone.p, alone.detectable) == (0.5, None, None, None)
    every = paired([Outcome(1.0, (o,)) for o in "abcdefg" for _ in range(5)])
    assert every.value == every.interval.high == 1  # type: ignore[union-attr]
    assert every.p == 2 / 128
    with pytest.raises(ValueError, match="at least one question"):
        paired([])


@given(
    gains=st.lists(
        st.tuples(st.integers(-2, 2), st.lists(st.sampled_from("abcdef"), min_size=1, max_size=3, unique=True))
    ),
    seed=st.integers(0, 9),
)
@settings(deadline=None, max_examples=80)
def test_paired_properties(gains: list[tuple[int, list[str]]], seed: int) -> None:
    outcomes = [Outcome(value / 2, tuple(objects)) for value, objects in gains]
    if not outcomes:
        return
    gap, mirrored = paired(outcomes), paired([Outcome(-o.correct, o.objects) for o in outcomes])
    random.Random(seed).shuffle(outcomes)
    assert paired(outcomes) == gap
    assert (mirrored.value, mirrored.mcnemar) == pytest.approx((-gap.value, gap.mcnemar))
    if gap.interval and mirrored.interval and gap.p is not None and gap.least is not None:
        assert -1 <= gap.interval.low <= gap.value <= gap.interval.high <= 1
        assert (-mirrored.interval.high, -mirrored.interval.low) == pytest.approx((gap.interval.low, gap.interval.high))
        assert gap.least <= gap.p <= 1
        assert mirrored.p == gap.p
        assert gap.detectable is not None
        assert gap.detectable > 0


def test_mcnemar_of_agrestis_ratings() -> None:
    """Agresti 2013: approval of a prime minister twice; 150 and 86 changed their minds, z = -4.17."""
    p = mcnemar([1] * 150 + [-1] * 86 + [0] * (794 + 570))
    exact = 2 * sum(Fraction(math.comb(236, k), 2**236) for k in range(87))
    assert p == pytest.approx(float(exact), rel=1e-12)
    assert (86 - 150) / math.sqrt(236) == pytest.approx(-4.17, abs=0.005)
    assert p == pytest.approx(2 * stats.norm.cdf(-4.17), rel=0.5)


@given(better=st.integers(0, 40), worse=st.integers(0, 40), same=st.integers(0, 3))
@settings(deadline=None, max_examples=60)
def test_mcnemar_is_the_binomial_tail(better: int, worse: int, same: int) -> None:
    n = better + worse
    p = mcnemar([1.0] * better + [0.0] * same + [-1.0] * worse)
    tail = sum(Fraction(math.comb(n, k), 2**n) for k in range(min(better, worse) + 1))
    assert p == pytest.approx(min(1.0, float(2 * tail)), abs=1e-12)
    assert p == (stats.binomtest(better, n).pvalue if n else 1)
    assert mcnemar([0.5] + [1.0] * better) is None, "a mean over seeds is no count"


@pytest.mark.parametrize(
    ("ps", "adjusted"),
    [
        # Worked by hand.
        ([0.01, 0.04, 0.03, 0.005], [0.03, 0.06, 0.06, 0.02]),
        ([0.5, 0.6], [1.0, 1.0]),
        ([], []),
    ],
)
def test_holm(ps: list[float], adjusted: list[float]) -> None:
    assert holm(ps) == pytest.approx(adjusted, abs=1e-12)


@given(st.lists(st.floats(0.001, 1), min_size=1, max_size=6))
@settings(max_examples=60)
def test_holm_is_the_closure_of_bonferroni(ps: list[float]) -> None:
    """Marcus, Peritz, Gabriel 1976: a p is worth the largest that any family with it gives by Bonferroni."""
    places = range(len(ps))
    families = [f for size in range(1, len(ps) + 1) for f in itertools.combinations(places, size)]
    worth = {f: min(1.0, len(f) * min(ps[i] for i in f)) for f in families}
    assert holm(ps) == pytest.approx([max(w for f, w in worth.items() if i in f) for i in places], abs=1e-12)


def over_runs(rows: Sequence[Sequence[float]], each: int = 5) -> list[Answer]:
    """Differences of seeds x questions, `each` about one object."""
    return answers(np.array(rows, dtype=float), each)


def test_several_seeds_are_one_comparison_of_their_means() -> None:
    rng = np.random.default_rng(5)
    table = rng.integers(-1, 2, (4, 35)).astype(float)
    several, means = paired_over_seeds(over_runs(table)), paired(outcomes_of(table.mean(axis=0)))
    assert several.value == pytest.approx(table.mean(), abs=1e-12)
    assert (several.p, several.least) == (means.p, means.least), "signs are those of objects, whatever the seeds"
    alone = [mcnemar(row.tolist()) for row in table]
    assert several.mcnemar == min(1, 4 * min(p for p in alone if p is not None))
    assert means.mcnemar is None, "means over seeds are no counts"
    one = paired_over_seeds(over_runs(table[:1]))
    assert one == paired(outcomes_of(table[0]))
    halves = paired_over_seeds(over_runs(table / 2))
    assert halves.mcnemar is None


def test_mcnemar_over_seeds_by_hand() -> None:
    """Five to none under one seed, two to one under the other: 2 / 2^5 and 1."""
    rows = [[1, 1, 1, 1, 1, 0, 0, 0, 0, 0], [1, 1, -1, 0, 0, 0, 0, 0, 0, 0]]
    assert paired_over_seeds(over_runs(rows)).mcnemar == 2 * (2 / 2**5)
    assert paired_over_seeds(over_runs(rows[1:])).mcnemar == 1


def test_runs_that_differ_widen_the_comparison() -> None:
    """The same question means; under seeds that agree, and under seeds of which one is far better."""
    agree = np.tile([1.0, 0, 0, 1, 0], (4, 14)).reshape(4, 70)
    differ = agree.copy()
    differ[0], differ[1:] = 1.0, np.where(agree[1:] > 0, 1.0, -1 / 3)
    assert differ.mean(axis=0) == pytest.approx(agree.mean(axis=0))
    same, apart = paired_over_seeds(over_runs(agree)), paired_over_seeds(over_runs(differ))
    assert same.interval is not None
    assert apart.interval is not None
    assert same.interval == paired(outcomes_of(agree.mean(axis=0))).interval, "the same answers again add nothing"
    assert apart.interval.low < same.interval.low < same.interval.high < apart.interval.high
    assert same.p == apart.p
    assert same.detectable is not None
    assert apart.detectable is not None
    assert apart.detectable > same.detectable


def test_the_comparison_over_seeds_covers_new_seeds() -> None:
    """Two equally good settings whose runs deviate by ten points: what leaves the seeds out covers less."""
    rng, objects, seeds, covered, without = np.random.default_rng(2), 20, 5, 0, 0
    sets = [rng.choice(objects, 2, replace=False) for _ in range(100)]
    names = [tuple(f"{o:02}" for o in sorted(s)) for s in sets]
    for _ in range(200):
        rates = 0.5 + rng.normal(0, 0.1, (2, seeds, 1)) + rng.normal(0, 0.05, (2, 1, objects))[:, :, sets].mean(axis=-1)
        one, other = rng.random((2, seeds, 100)) < rates
        table = one.astype(float) - other
        gap = paired_over_seeds(
            [Answer(f"{q:03}", s, float(table[s, q]), names[q]) for s in range(seeds) for q in range(100)]
        )
        alone = paired([Outcome(float(v), names[q]) for q, v in enumerate(table.mean(axis=0))])
        for found in (gap, alone):
            assert found.interval is not None
        covered += gap.interval.low <= 0 <= gap.interval.high  # type: ignore[union-attr]
        without += alone.interval.low <= 0 <= alone.interval.high  # type: ignore[union-attr]
    assert covered / 200 >= 0.93
    assert without / 200 <= 0.85


# What a design can find


def test_smallest_effect_of_known_designs() -> None:
    """Bloom 1995: 2.8 standard errors; Cohen 1988: 34 pairs for a medium effect, 15 for a large one."""
    assert smallest_effect(1, 100_000) == pytest.approx(1.959964 + 0.841621, abs=1e-3)
    for effect, pairs in ((0.5, 34), (0.8, 15)):
        assert (
            smallest_effect(1 / math.sqrt(pairs), pairs)
            <= effect
            < smallest_effect(1 / math.sqrt(pairs - 1), pairs - 1)
        )


@pytest.mark.parametrize("objects", [3, 7, 20])
def test_the_smallest_effect_is_found_in_four_of_five_repetitions(objects: int) -> None:
    error = planned_error(objects, 5, 0.2, 0.7)
    assert error == pytest.approx(math.sqrt((0.04 + 0.49 / 5) / objects))
    rng, repetitions = np.random.default_rng(objects), 20_000
    effect = smallest_effect(error, objects)
    own = rng.normal(effect, 0.2, (repetitions, objects))
    means = own + rng.normal(0, 0.7, (5, repetitions, objects)).mean(axis=0)
    assert (stats.ttest_1samp(means, 0, axis=1).pvalue < 0.05).mean() == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize(
    ("objects", "power", "alpha"), [(2, 0.8, 0.05), (7, 0.8, 0.01), (7, 0.95, 0.05), (60, 0.9, 0.05)]
)
def test_the_smallest_effect_has_its_power_by_quadrature(objects: int, power: float, alpha: float) -> None:
    """Over the deviation's distribution, the normal mean beyond the critical value on either side."""
    freedom = objects - 1
    shift, critical = smallest_effect(1, objects, power, alpha), stats.t.ppf(1 - alpha / 2, freedom)

    def found(s: float) -> float:
        beyond = stats.norm.sf(critical * s - shift) + stats.norm.cdf(-critical * s - shift)
        return float(beyond * stats.chi.pdf(s * math.sqrt(freedom), freedom) * math.sqrt(freedom))

    assert quad(found, 0, 10, limit=200, points=[1])[0] == pytest.approx(power, abs=1e-8)


def test_deviations_of_one_comparison_plan_the_next() -> None:
    rng, found = np.random.default_rng(6), []
    for _ in range(300):
        values = np.repeat(rng.normal(0, 0.3, 12), 5) + rng.normal(0, 0.5, 60)
        seen = deviations([Outcome(float(v), (f"{i // 5}",)) for i, v in enumerate(values)])
        assert seen is not None
        found.append((seen.between**2, seen.within**2))
    assert np.mean(found, axis=0) == pytest.approx([0.09, 0.25], rel=0.06)
    alike = deviations([Outcome(float(i % 2), (f"{i // 2}",)) for i in range(8)])
    assert alike is not None
    assert (alike.between, alike.within) == (0, pytest.approx(math.sqrt(0.5), rel=0.3))
    each = deviations([Outcome(x, (o,)) for x, o in ((0.0, "a"), (1.0, "b"))])
    assert each is not None
    assert (each.between, each.within) == (pytest.approx(math.sqrt(0.5)), 0)
    assert deviations([]) is None
    assert deviations([Outcome(1.0, ("a",)), Outcome(0.0, ("a",))]) is None


def test_smaller_sizes_and_more_power_need_larger_effects() -> None:
    assert smallest_effect(0.1, 7) < smallest_effect(0.1, 7, power=0.9) < smallest_effect(0.1, 7, 0.9, alpha=0.01)
    for wrong in ({"objects": 1}, {"power": 0.01}, {"power": 1.0}, {"alpha": 0.0}):
        with pytest.raises(ValueError, match="needs at least two|is needed"):
            smallest_effect(**{"error": 0.1, "objects": 7, **wrong})  # type: ignore[arg-type]
    for objects, questions in ((0, 5), (5, 0)):
        with pytest.raises(ValueError, match="objects and questions"):
            planned_error(objects, questions, 0.1, 0.1)


def test_the_smallest_effect_of_an_error_that_knows_its_freedom() -> None:
    assert smallest_effect(0.1, 7, freedom=6) == smallest_effect(0.1, 7)
    assert smallest_effect(0.1, 7, freedom=2.5) > smallest_effect(0.1, 7)
    # Any number of objects may stand beside it.
    assert smallest_effect(0.1, 60, freedom=2.5) == smallest_effect(0.1, 7, freedom=2.5)


# Seeds


def outcomes_of(row: np.ndarray, each: int = 5) -> list[Outcome]:
    """One run, as `answers`."""
    return [Outcome(float(value), (f"{q // each:02}",)) for q, value in enumerate(row)]


def answers(table: np.ndarray, each: int = 5, levels: tuple[str, ...] = ()) -> list[Answer]:
    """Of seeds x questions, `each` about one object."""
    return [
        Answer(f"q{q:02}", seed, float(value), (f"{q // each:02}",), levels)
        for seed, row in enumerate(table)
        for q, value in enumerate(row)
    ]


def test_one_seed_is_the_clustered_interval() -> None:
    table = (np.random.default_rng(0).random((1, 35)) < 0.6).astype(float)
    found = over_seeds(answers(table))
    assert found.interval == clustered([Outcome(a.correct, a.objects) for a in answers(table)])
    assert (found.parts, found.expected, found.questions, found.seeds) == (None, None, 35, (0,))
    share = table.mean()
    assert found.most == pytest.approx(math.sqrt(share * (1 - share) / 35), abs=1e-12)


def test_answers_alone_make_no_more_than_if_questions_were_alike() -> None:
    """The deviation over 4000 runs of questions that are not equally hard, against its bound."""
    rng = np.random.default_rng(8)
    rates = rng.random(40)
    table = (rng.random((4000, 40)) < rates).astype(float)
    found = over_seeds(answers(table))
    assert found.expected == pytest.approx(math.sqrt((rates * (1 - rates)).sum()) / 40, rel=0.02)
    assert found.expected is not None
    assert found.spread.deviation == pytest.approx(found.expected, rel=0.05)
    assert found.most == pytest.approx(math.sqrt(rates.mean() * (1 - rates.mean()) / 40), rel=0.02)
    assert found.expected < found.most


def test_runs_that_agree_add_nothing() -> None:
    row = (np.random.default_rng(1).random(35) < 0.6).astype(float)
    found, one = over_seeds(answers(np.stack([row] * 4))), over_seeds(answers(row[None]))
    assert found.parts is not None
    assert (found.parts.seeds, found.parts.answers, found.expected) == (0, 0, 0)
    assert found.interval == one.interval, "the same answers again are no further evidence"


def test_parts_are_found_on_average() -> None:
    """Normal answers with known deviations: seeds 1, objects 2, questions 1.5, single answers 1."""
    rng, found = np.random.default_rng(2), []
    for _ in range(300):
        table = rng.normal(0, 1, (5, 1)) + np.repeat(rng.normal(0, 2, 12), 5) + rng.normal(0, 1.5, 60)
        parts = over_seeds(answers(table + rng.normal(0, 1, (5, 60)))).parts
        assert parts is not None
        found.append((parts.seeds, parts.objects, parts.questions, parts.answers))
    assert np.mean(found, axis=0) == pytest.approx([1, 4, 2.25, 1], rel=0.15)


def test_runs_that_differ_widen_the_interval() -> None:
    rng = np.random.default_rng(3)
    rates = np.array([[0.2], [0.5], [0.8]])
    table = (rng.random((3, 100)) < rates).astype(float)
    found, alone = (
        over_seeds(answers(table)),
        clustered([Outcome(x, (f"{i // 5}",)) for i, x in enumerate(table.mean(0))]),
    )
    assert found.interval is not None
    assert alone is not None
    assert found.interval.low < alone.low < alone.high < found.interval.high
    assert found.spread.deviation is not None
    assert found.expected is not None
    assert found.spread.deviation > 3 * found.expected


def test_every_question_needs_one_answer_a_seed() -> None:
    some = answers(np.ones((2, 10)))
    for wrong, message in (([], "at least one"), (some[:-1], "q09 has no answer under seed 1"), (some * 2, "several")):
        with pytest.raises(ValueError, match=message):
            over_seeds(wrong)


# Factorial effects

FACTORS = (
    Factor("encoder", ("base", "finetuned")),
    Factor("LoRA", ("without", "with")),
    Factor("OPD", ("none", "all")),
)


def grid(seeds: int = 2, seed: int = 0) -> list[Answer]:
    rng = np.random.default_rng(seed)
    found = []
    for levels in itertools.product(*(f.levels for f in FACTORS)):
        rate = 0.3 + 0.3 * (levels[0] == "finetuned") + 0.1 * (levels[1] == "with")
        found += answers((rng.random((seeds, 35)) < rate).astype(float), levels=levels)
    return found


def test_effects_are_those_of_least_squares() -> None:
    """Cells coded 1 and -1: a main effect is twice its coefficient, an interaction of two four times."""
    given_ = grid()
    coded = np.array([[1 if v == f.levels[1] else -1 for v, f in zip(a.levels, FACTORS, strict=True)] for a in given_])
    pairs = list(itertools.combinations(range(3), 2))
    columns = [np.ones(len(given_)), *coded.T, *(coded[:, i] * coded[:, j] for i, j in pairs), coded.prod(axis=1)]
    fitted = np.linalg.lstsq(np.stack(columns, axis=1), np.array([a.correct for a in given_]), rcond=None)[0]
    effects = factorial_effects(given_, FACTORS)
    assert [e.factors for e in effects] == [
        ("encoder",),
        ("LoRA",),
        ("OPD",),
        ("encoder", "LoRA"),
        ("encoder", "OPD"),
        ("LoRA", "OPD"),
    ]
    assert [e.value for e in effects] == pytest.approx([*(2 * fitted[1:4]), *(4 * fitted[4:7])], abs=1e-12)
    for effect in effects:
        assert effect.interval is not None
        assert effect.interval.low <= effect.value <= effect.interval.high
        assert effect.p is not None
        assert 2 / 128 <= effect.p <= 1
        assert effect.detectable is not None
        assert effect.detectable > 0
        assert (effect.questions, effect.seeds, effect.cells) == (35, 2, 8)
    assert effects[0].changes == ("finetuned minus base",)
    assert effects[3].changes == ("finetuned minus base", "with minus without")


def test_one_pair_of_cells_is_the_paired_difference() -> None:
    some = [a for a in grid(seeds=1) if a.levels[1:] == ("with", "all")]
    effects = factorial_effects(some, FACTORS)
    assert [(e.factors, e.cells) for e in effects] == [(("encoder",), 2)], "nothing else was varied"
    cells = {v: {a.question: a for a in some if a.levels[0] == v} for v in FACTORS[0].levels}
    gap = paired([Outcome(a.correct - cells["base"][q].correct, a.objects) for q, a in cells["finetuned"].items()])
    assert effects[0].value == pytest.approx(gap.value, abs=1e-12)
    assert effects[0].interval is not None
    assert gap.interval is not None
    assert effects[0].interval.low == pytest.approx(gap.interval.low, abs=1e-12)
    assert effects[0].p == gap.p
    assert effects[0].detectable == pytest.approx(gap.detectable, abs=1e-12)


def test_three_levels_and_missing_cells() -> None:
    factors = (Factor("LoRA", ("without", "with")), Factor("OPD", ("none", "needed", "all")))
    cells = [c for c in itertools.product(*(f.levels for f in factors)) if c != ("without", "needed")]
    effects = factorial_effects([a for c in cells for a in answers(np.ones((2, 10)), levels=c)], factors)
    assert {(e.factors, e.changes): e.cells for e in effects} == {
        (("LoRA",), ("with minus without",)): 4,
        (("OPD",), ("needed minus none",)): 2,
        (("OPD",), ("all minus none",)): 4,
        (("OPD",), ("all minus needed",)): 2,
        (("LoRA", "OPD"), ("with minus without", "all minus none")): 4,
    }
    assert {e.value for e in effects} == {0}


def test_only_seeds_and_questions_that_all_cells_share_are_compared() -> None:
    factors = (Factor("LoRA", ("without", "with")),)
    one = answers(np.zeros((3, 10)), levels=("without",))
    other = [a for a in answers(np.ones((2, 10)), levels=("with",)) if a.question != "q03"]
    (effect,) = factorial_effects([*one, *other], factors)
    assert (effect.value, effect.seeds, effect.questions) == (1, 2, 9)
    later = [Answer(a.question, 7, a.correct, a.objects, a.levels) for a in other if a.seed == 0]
    assert factorial_effects([*one, *later], factors) == []
    assert factorial_effects([], factors) == []


def test_wrong_levels_and_repeated_answers_are_named() -> None:
    good = answers(np.ones((1, 5)), levels=("with",))
    factors = (Factor("LoRA", ("without", "with")),)
    for wrong, message in ((answers(np.ones((1, 5)), levels=("maybe",)), "no levels"), (good * 2, "several answers")):
        with pytest.raises(ValueError, match=message):
            factorial_effects(wrong, factors)
