"""The rows of scores.csv and effects.csv, from made-up answers that are counted by hand."""

from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import recall_score

from pipeline.core.io import read_csv, write_csv
from pipeline.core.records import Part
from pipeline.encoder.records import Classification
from pipeline.evaluation.intervals import accuracy_interval
from pipeline.evaluation.paired import paired
from pipeline.evaluation.records import GradedVision, Shown
from pipeline.evaluation.rows import EffectRow, ScoreRow
from pipeline.evaluation.scores import effect_rows, score_rows, with_holm
from pipeline.tasks import TASKS
from pipeline.tasks.records import Score
from tests.conftest import CATALOGUE, classified
from tests.evaluation.conftest import PAIRS, graded

RNG = np.random.default_rng(1)


def drawn(count: int = 15) -> list[bool]:
    return [bool(x) for x in RNG.random(count) < 0.5]


def row(rows: list[ScoreRow], **named: object) -> ScoreRow:
    (found,) = [r for r in rows if all(getattr(r, k) == v for k, v in named.items())]
    return found


def test_one_seed_and_all_of_them() -> None:
    first, second = drawn(), [True, False, *drawn(13)]
    rows = score_rows(graded("PC", first, unread=2) + graded("PC", second, seed=3, unread=1), CATALOGUE)
    assert [r.seed for r in rows] == ["0", "3", "all"]
    for r, right, unread in zip(rows, (first, second), (2, 1), strict=False):
        assert (r.n, r.sets, r.right, r.unread) == (15, 15, sum(right), unread)
        assert r.accuracy == pytest.approx(sum(right) / 15, abs=1e-6)
        interval = accuracy_interval(np.array(right, dtype=float), PAIRS)
        assert (r.low, r.high) == pytest.approx(interval, abs=1e-6)
        assert r.chance == pytest.approx(1 / 3, abs=1e-6)
    pooled, means = rows[-1], np.mean([first, second], axis=0)
    assert (pooled.n, pooled.unread) == (15, 1.5)
    assert (pooled.right, pooled.accuracy) == pytest.approx((means.sum(), means.mean()), abs=1e-6)
    assert (pooled.low, pooled.high) == pytest.approx(accuracy_interval(means, PAIRS), abs=1e-6)
    # Over seeds only what all of them answered.
    rows = score_rows(graded("PC", [True] * 15) + graded("PC", [False] * 10, seed=1), CATALOGUE)
    assert [(r.seed, r.n, r.accuracy) for r in rows] == [("0", 15, 1), ("1", 10, 0), ("all", 10, 0.5)]
    assert score_rows([], CATALOGUE) == []


def test_tasks_and_measures_come_from_the_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    class Later(type(TASKS["PC"])):  # type: ignore[misc]
        name, measure = "LATER", "shape"

        def chance(self, catalogue: object) -> dict[str, float]:
            return {"shape": 0.125}

    monkeypatch.setitem(TASKS, "LATER", Later())
    answers = graded("LATER", drawn(), measure="shape", objects=PAIRS) + graded("PSR", drawn()) + graded("PC", drawn())
    for measure in ("combined", "hardness"):
        answers += graded("OPD", drawn(18), measure=measure)
    rows = [r for r in score_rows(answers, CATALOGUE) if r.seed == "all"]
    assert [(r.task, r.measure, round(r.chance, 4)) for r in rows] == [
        ("OPD", "hardness", 0.3333),
        ("OPD", "combined", 0.037),
        ("PC", "choice", 0.3333),
        ("PSR", "choice", 0.5),
        ("LATER", "shape", 0.125),
    ]
    less = graded("LATER", drawn(), measure="shape", objects=PAIRS, lora="without")
    assert [(r.part, r.task, r.measure) for r in effect_rows(answers + less, CATALOGUE)] == [("lora", "LATER", "shape")]


def test_one_object_has_an_accuracy_but_no_interval(tmp_path: Path) -> None:
    alone = [("object0",)] * 4
    answers = graded("OPD", [True, False, True, True], measure="combined", objects=alone)
    answers += graded("OPD", [True, False, False, True], measure="combined", objects=alone, lora="without")
    rows, effects = score_rows(answers, CATALOGUE), effect_rows(answers, CATALOGUE)
    assert {(r.lora, r.sets, r.accuracy, r.low) for r in rows} == {("with", 1, 0.75, None), ("without", 1, 0.5, None)}
    (effect,) = effects
    assert effect.difference == 0.25
    assert {effect.low, effect.high, effect.p, effect.p_holm, effect.smallest_effect} == {None}
    write_csv(tmp_path / "scores.csv", ScoreRow, rows)
    write_csv(tmp_path / "effects.csv", EffectRow, effects)
    assert read_csv(tmp_path / "scores.csv", ScoreRow) == rows
    assert read_csv(tmp_path / "effects.csv", EffectRow) == effects


def test_effects_are_the_full_system_less_one_part() -> None:
    full = {0: drawn(), 1: drawn()}
    changes = {
        ("encoder", "finetuned - base"): {"encoder": "base"},
        ("lora", "with - without"): {"lora": "without"},
        ("opd", "all - none"): {"opd": "none"},
        ("opd", "all - needed"): {"opd": "needed"},
        ("touch", "real - removed"): {"touch": "removed"},
        ("touch", "real - swapped"): {"touch": "swapped"},
    }
    less = {change: {seed: drawn() for seed in full} for change in changes}
    answers = [a for seed, right in full.items() for a in graded("PC", right, seed=seed)]
    for change, named in changes.items():
        answers += [a for s, right in less[change].items() for a in graded("PC", right, seed=s, **named)]  # type: ignore[arg-type]
    # Neither a system that lacks two parts nor a seed that one side lacks is compared.
    answers += graded("PC", drawn(), lora="without", encoder="base") + graded("PC", drawn(), seed=9)
    rows = effect_rows(answers[::-1], CATALOGUE)
    assert [(r.part, r.change) for r in rows] == list(changes)
    for r in rows:
        gains = np.array([np.subtract(full[s], less[r.part, r.change][s], dtype=float) for s in full])
        gap = paired(gains, PAIRS)
        assert (r.n, r.objects, r.seeds, r.task, r.measure) == (15, 6, 2, "PC", "choice")
        expected = (gap.difference, gap.low, gap.high, gap.p, gap.smallest_effect)
        assert (r.difference, r.low, r.high, r.p, r.smallest_effect) == pytest.approx(expected, abs=1e-6)
    least = min(r.p for r in rows if r.p is not None)
    assert min(r.p_holm for r in rows if r.p_holm is not None) == pytest.approx(min(1, 6 * least), abs=1e-5)
    assert effect_rows(graded("PC", full[0]), CATALOGUE) == [], "nothing to compare with"


def test_training_is_compared_with_the_most_ratings() -> None:
    full, few, most, rules = drawn(), drawn(), drawn(), drawn()
    own = set(Score.model_fields)
    ways = ((few, 3, Shown.TOUCH), (most, 20, Shown.TOUCH), (rules, 20, Shown.CLASSES))
    others = [
        GradedVision(model=f"m, adapted by {count}", shown=shown, seed=0, **Score.model_dump(g, include=own))
        for right, count, shown in ways
        for g in graded("PC", right)
    ]
    (row,) = effect_rows(graded("PC", full), CATALOGUE, vision=others)
    assert (row.part, row.change, row.n) == ("training", "full system - m, adapted by 20 rated objects", 15)
    assert row.difference == pytest.approx(np.mean(full) - np.mean(most), abs=1e-6)
    # A question that has the number of another, as matching has it under other names, is no pair.
    others = [o.model_copy(update={"objects": o.objects[::-1]}) if n % 15 > 9 else o for n, o in enumerate(others)]
    (row,) = effect_rows(graded("PC", full), CATALOGUE, vision=others)
    assert (row.n, row.difference) == (10, pytest.approx(np.mean(full[:10]) - np.mean(most[:10]), abs=1e-6))


Classes = tuple[int, int, int]


def heads(part: Part, predicted: dict[str, Classes], expected: Classes) -> list[Classification]:
    return [
        classified(video, name, e, p, part=part)
        for video, classes in predicted.items()
        for name, e, p in zip(CATALOGUE.property_names, expected, classes, strict=True)
    ]


def test_property_heads_on_test_and_on_validation_videos() -> None:
    said = heads(Part.TEST, {"a_0": (0, 1, 2), "a_1": (0, 0, 2), "b_0": (1, 0, 2), "c_0": (0, 1, 2)}, (0, 1, 2))
    said += heads(Part.VALIDATION, {"d_0": (0, 1, 2)}, (0, 1, 2)) + heads(Part.TRAIN, {"e_0": (1, 1, 1)}, (0, 1, 2))
    rows = score_rows([], CATALOGUE, {0: said})
    names = (*CATALOGUE.property_names, "combined")
    found = {name: row(rows, task="heads", measure=name, seed="0") for name in names}
    assert [found[name].accuracy for name in names] == [0.75, 0.5, 1, 0.5]
    assert {(r.n, r.encoder, r.lora, r.opd, r.touch) for r in found.values()} == {(4, "finetuned", "", "", "real")}
    assert found["combined"].chance == pytest.approx(1 / 27, abs=1e-6)
    interval = accuracy_interval(np.array([1.0, 0, 0, 1]), [("a",), ("a",), ("b",), ("c",)])
    assert (found["combined"].low, found["combined"].high) == pytest.approx(interval, abs=1e-6)
    assert row(rows, task="heads_validation", measure="combined", seed="all").n == 1


def test_recall_of_each_class_is_scikit_learns() -> None:
    rng = np.random.default_rng(0)
    said = []
    for number in range(60):
        labels, taken = ((int(a), int(b), 2) for a, b in rng.integers(0, 3, (2, 2)))
        said += heads(Part.TEST, {f"{number % 20:02}_{number // 20}": taken}, labels)
    rows = score_rows([], CATALOGUE, {0: said})
    for p in CATALOGUE.properties:
        own = [c for c in said if c.property == p.name]
        true, taken = [c.expected for c in own], [c.predicted for c in own]
        known = recall_score(true, taken, labels=sorted(set(true)), average=None)
        for level, recall in zip(sorted(set(true)), known, strict=True):
            found = row(rows, task="heads_recall", seed="all", measure=f"{p.name}: {p.levels[level]}")
            assert (found.accuracy, found.n) == (pytest.approx(recall, abs=1e-6), true.count(level))
    assert {r.measure for r in rows if r.task == "heads_recall" and "bump" in r.measure} == {"bumpiness: big bumps"}


def test_holm_over_effects_some_of_which_have_no_p() -> None:
    named = {"part": "lora", "change": "x", "task": "PC", "measure": "choice", "n": 9, "objects": 9, "seeds": 1}
    rows = [EffectRow(difference=0.1, p=p, **named) for p in (0.01, None, 0.04, 0.03, 0.005)]
    assert [r.p_holm for r in with_holm(rows)] == pytest.approx([0.03, None, 0.06, 0.06, 0.02])
    assert [r.p_holm for r in with_holm(rows[1:2])] == [None]
