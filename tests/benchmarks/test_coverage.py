"""The simulation that intervals and tests are held against: its truth is true, and it runs what the reports run."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from pipeline.benchmarks.coverage import measure
from pipeline.benchmarks.coverage_methods import adjusted, effective, flipped, independent, mcnemar, resampled
from pipeline.benchmarks.coverage_table import CoverageRow, table, verdict
from pipeline.benchmarks.simulation import Design
from pipeline.statistics import Answer, Outcome, clustered, paired, paired_over_seeds, wilson
from pipeline.statistics import mcnemar as exact_mcnemar
from pipeline.statistics.bounds import difference_bounds
from pipeline.statistics.seeds import crossed

DESIGNS = [Design(7, 1, 0.3), Design(7, 2, 0.7), Design(20, 3, 0.3)]


def outcomes(values: np.ndarray, design: Design) -> list[Outcome]:
    return [Outcome(float(v), tuple(f"{o:02}" for o in s)) for v, s in zip(values, design.questions(), strict=True)]


@pytest.mark.parametrize("design", DESIGNS, ids=str)
def test_the_truth_is_true(design: Design) -> None:
    truths = (0.05, 0.5, 0.97)
    for truth, values in zip(truths, design.answers(truths, 6000), strict=True):
        assert values.shape == (6000, len(design.questions()))
        assert values.mean() == pytest.approx(truth, abs=0.012)
    for gap, values in zip((0.0, 0.3), design.differences(((0.8, 0.8), (0.8, 0.5)), 6000), strict=True):
        assert values.mean() == pytest.approx(gap, abs=0.015)
        assert set(np.unique(values)) <= {-1, 0, 1}
    (runs,) = design.runs((0.8,), 2, 3000)
    assert runs.shape == (3000, 2, len(design.questions()))
    assert runs.mean() == pytest.approx(0.8, abs=0.015)
    for gap, values in zip((0.0, 0.3), design.run_differences(((0.8, 0.8), (0.8, 0.5)), 3, 3000), strict=True):
        assert values.shape == (3000, 3, len(design.questions()))
        assert values.mean() == pytest.approx(gap, abs=0.015)
        assert set(np.unique(values)) <= {-1, 0, 1}


def test_settings_have_runs_of_their_own_and_questions_in_common() -> None:
    """Equally good settings: their differences vary less than if nothing were common, and over seeds."""
    design = DESIGNS[0]
    (gains,) = design.run_differences(((0.5, 0.5),), 4, 3000)
    assert 0.3 < gains.var() < 0.5
    means = gains.mean(axis=2)
    alone = gains.var(axis=2, ddof=1).mean() / gains.shape[2]
    assert means.var(axis=1, ddof=1).mean() > 1.2 * alone


@pytest.mark.parametrize("design", DESIGNS, ids=str)
def test_what_is_simulated_over_seeds_is_what_reports_use(design: Design) -> None:
    (gains,) = design.run_differences(((0.7, 0.6),), 3, 2)
    low, high = difference_bounds(crossed(gains, design.clusters()), design.clusters())
    for i in range(2):
        answers = [
            Answer(f"{q:03}", seed, outcome.correct, outcome.objects)
            for seed in range(3)
            for q, outcome in enumerate(outcomes(gains[i, seed], design))
        ]
        found = paired_over_seeds(answers).interval
        assert found is not None
        assert (low[i], high[i]) == pytest.approx((found.low, found.high), abs=1e-9)


def test_answers_about_one_object_are_correlated_as_said() -> None:
    latent = Design(7, 1, 0.3).latent(np.random.default_rng(0), 20_000)
    found = np.corrcoef(latent, rowvar=False)
    assert (found[0, 1], found[0, 5]) == (pytest.approx(0.3, abs=0.03), pytest.approx(0, abs=0.03))
    pairs = Design(7, 2, 0.6)
    found = np.corrcoef(pairs.latent(np.random.default_rng(0), 20_000), rowvar=False)
    first = pairs.questions()[0]
    for i, other in enumerate(pairs.questions()[1:30], 1):
        assert found[0, i] == pytest.approx(0.3 * len(set(first) & set(other)), abs=0.03)


@pytest.mark.parametrize("design", DESIGNS, ids=str)
def test_what_is_simulated_is_what_reports_use(design: Design) -> None:
    (values,) = design.answers((0.6,), 4)
    (gains,) = design.differences(((0.7, 0.6),), 4)
    low, high = effective(values, design)
    plain_low, _ = independent(values, design)
    gain_low, gain_high = adjusted(gains, design)
    ps, counted = flipped(gains, design), mcnemar(gains, design)
    for i in range(4):
        found = clustered(outcomes(values[i], design))
        assert found is not None
        assert (low[i], high[i]) == pytest.approx((found.low, found.high), abs=1e-9)
        assert plain_low[i] == pytest.approx(wilson(values[i].sum(), len(values[i])).low)
        gap = paired(outcomes(gains[i], design))
        assert gap.interval is not None
        assert (gain_low[i], gain_high[i]) == pytest.approx((gap.interval.low, gap.interval.high), abs=1e-9)
        assert counted[i] == pytest.approx(exact_mcnemar(gains[i].tolist()), abs=1e-12)
        # Beyond a few objects the simulation draws fewer signs.
        assert ps[i] == pytest.approx(gap.p, abs=1e-12 if design.objects == 7 else 0.06)


def test_intervals_cover_where_they_say_and_the_bootstrap_does_not() -> None:
    truths, design = (0.3, 0.8), Design(7, 1, 0.7)
    for truth, values in zip(truths, design.answers(truths, 2000), strict=True):
        covered = [
            float(((low <= truth) & (high >= truth)).mean())
            for low, high in (effective(values, design), resampled(values, design), independent(values, design))
        ]
        assert 0.93 <= covered[0] <= 0.975
        assert covered[1] < 0.9
        assert covered[2] < 0.8


def test_tests_keep_their_size() -> None:
    for design in (Design(7, 1, 0.3), Design(7, 2, 0.7)):
        (gains,) = design.differences(((0.5, 0.5),), 2000)
        assert (flipped(gains, design) <= 0.05).mean() <= 0.05
        assert (mcnemar(gains, design) <= 0.05).mean() > 0.05


def test_simpler_flips_of_questions_about_several_objects_find_what_is_not_there() -> None:
    """Why differences are split by least squares first: with sums over an object's questions, or products of signs, a
    test that means 5 % rejects three times as often and more."""
    for design in (Design(7, 2, 0.3), Design(7, 3, 0.7)):
        (gains,) = design.differences(((0.5, 0.5),), 1000)
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=7)))
        membership = design.clusters().membership
        products = np.stack([signs[:, list(s)].prod(axis=1) for s in design.questions()], axis=1)
        measured = np.abs(gains.sum(axis=1, keepdims=True)) - 1e-9
        for flipped_sums in (gains @ membership @ signs.T / design.about, gains @ products.T):
            p = (np.abs(flipped_sums) >= measured).mean(axis=1)
            assert (p <= 0.05).mean() > 0.15
        assert (flipped(gains, design) <= 0.05).mean() <= 0.05


def test_verdicts_allow_for_the_monte_carlo_error() -> None:
    assert [verdict(s, 1000, 0.93, 0.97) for s in (0.9, 0.925, 0.95, 0.975, 0.99)] == [
        "liberal",
        "holds",
        "holds",
        "holds",
        "conservative",
    ]
    assert verdict(0.925, 100_000, 0.93, 0.97) == "liberal"


def test_all_designs_are_measured_and_written(tmp_path: Path) -> None:
    rows = measure(tmp_path, repetitions=20, objects=(7,))
    assert len({row.case for row in rows}) == len(rows)
    kinds = {"accuracy", "difference", "seeds", "difference over seeds", "size", "power", "smallest effect"}
    assert {row.kind for row in rows} == kinds
    assert {(row.about, row.correlation) for row in rows} == {(a, r) for a in (1, 2, 3) for r in (0, 0.3, 0.7)}
    for row in rows:
        assert row.baseline in {other.case for other in rows}
        assert len(row.truths) == len(row.shares) == len(row.verdict)
        assert row.error is not None
        assert row.low <= row.error <= row.high
    text = (tmp_path / "reports" / "bench" / "coverage.md").read_text()
    assert text == table(rows)
    # A table row each, and what does not hold once more above.
    named = [(r.case, v) for r in rows if r.reported for v in ("liberal", "conservative") if v in r.verdict]
    assert sum(line.startswith("| ") for line in text.splitlines()) == len(rows) + len(kinds)
    assert sum(line.startswith("- ") for line in text.splitlines()) == len(named)


def test_what_falls_short_is_named_first() -> None:
    row = CoverageRow(
        case="accuracy, best, 7 objects",
        cost=0.3,
        unit="mean width",
        baseline="accuracy, best, 7 objects",
        ratio=1,
        error=0.2,
        low=0.18,
        high=0.22,
        kind="accuracy",
        method="best",
        reported=True,
        objects=7,
        about=1,
        correlation=0.3,
        seeds=1,
        truths=("0.5", "0.8"),
        shares=(0.95, 0.8),
        verdict=("holds", "liberal"),
        repetitions=1000,
    )
    text = table([row])
    assert "- accuracy, best, 7 objects: 80.0 % at 0.8\n" in text
    assert "| best (reported) | 7 | 1 | 0.3 | 95.0 | **80.0** | 0.30 |" in text
    assert text.count("Nowhere.") == 1
    assert table([row.model_copy(update={"verdict": ("holds", "holds")})]).count("Nowhere.") == 2
