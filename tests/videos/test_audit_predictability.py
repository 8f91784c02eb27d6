"""Whether the untouched sensor tells the label: against scikit-learn, planted leaks and pure noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest

from pipeline.core.records import Probe
from pipeline.videos.audit import leakage
from pipeline.videos.audit.leakage import predictability
from pipeline.videos.catalogue import Catalogue
from tests.audit_records import INFO, OBJECTS, OTHER, WARNING, leaks, of, probe, probes, relabelled

pytestmark = pytest.mark.usefixtures("few_permutations")


class Planted(NamedTuple):
    features: np.ndarray
    labels: list[int]
    objects: list[str]


def planted(seed: int, *, leak: float, objects: int = 24, dims: int = 6, own: float = 0.0) -> Planted:
    """Unequal numbers of videos; `leak` moves features with the label, `own` with the object."""
    rng = np.random.default_rng(seed)
    label = rng.integers(0, 3, objects)
    member = np.repeat(np.arange(objects), rng.integers(1, 6, objects))
    centres, looks = rng.normal(size=(3, dims)), rng.normal(size=(objects, dims))
    features = leak * centres[label[member]] + own * looks[member] + rng.normal(size=(len(member), dims))
    order = rng.permutation(len(member))
    member = member[order]
    return Planted(features[order], label[member].tolist(), [f"object {m:02}" for m in member])


def p_value(share: float, null: Sequence[float]) -> float:
    return (1 + sum(n >= share - 1e-12 for n in null)) / (1 + len(null))


def slow_shares(data: Planted, seed: int, permutations: int) -> list[float]:
    """One ridge regression a fold and an order, by scikit-learn."""
    from sklearn.linear_model import Ridge
    from sklearn.preprocessing import StandardScaler

    names = sorted(set(data.objects))
    rng = np.random.default_rng(seed)
    fold_of = dict(zip(names, rng.permutation(len(names)) % min(leakage.FOLDS, len(names)), strict=True))
    label_of = dict(zip(data.objects, data.labels, strict=True))
    own = np.array([label_of[n] for n in names])
    features = StandardScaler().fit_transform(data.features) / np.sqrt(data.features.shape[1])
    shares = []
    for order in [own, *(rng.permutation(own) for _ in range(permutations))]:
        now = dict(zip(names, order, strict=True))
        truth = np.array([now[o] for o in data.objects])
        fold = np.array([fold_of[o] for o in data.objects])
        right = 0
        for number in set(fold.tolist()):
            model = Ridge(alpha=leakage.RIDGE).fit(features[fold != number], np.eye(3)[truth[fold != number]])
            right += int((model.predict(features[fold == number]).argmax(1) == truth[fold == number]).sum())
        shares.append(right / len(truth))
    return shares


@pytest.mark.parametrize("seed", range(3))
def test_predictability_is_ridge_regression_fold_by_fold(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(leakage, "PERMUTATIONS", 5)
    data = planted(seed, leak=0.7, dims=(4, 40, 144)[seed])
    share, null = predictability(*data, seed)
    assert [share, *null] == pytest.approx(slow_shares(data, seed, 5), abs=1e-12)


@pytest.mark.parametrize("own", [0.0, 3.0])
def test_noise_gives_uniform_p_values(monkeypatch: pytest.MonkeyPatch, own: float) -> None:
    """Also where videos of one object look alike: labels are permuted among objects, not among videos."""
    monkeypatch.setattr(leakage, "PERMUTATIONS", 79)
    values = []
    for seed in range(40):
        data = planted(seed, leak=0.0, own=own)
        values.append(p_value(*predictability(*data, seed)))
    assert np.mean(np.array(values) <= 0.05) <= 0.15
    assert 0.35 <= np.mean(np.array(values) <= 0.5) <= 0.65
    assert 0.4 < np.mean(values) < 0.6


@pytest.mark.parametrize("seed", range(3))
def test_classes_that_are_equally_likely_are_not_told_apart_by_rounding(seed: int) -> None:
    """Sessions with as many objects of each class: every score is a tie, and each processor rounds in its own way."""
    rng = np.random.default_rng(seed)
    objects = [f"object_{i:02d}" for i in range(36)]
    labels = [i % 3 for i in range(36)]
    session = np.eye(4)[[i // 9 for i in range(36)]]
    exact = predictability(session, labels, objects, seed)
    for _ in range(5):
        assert predictability(session + rng.normal(scale=1e-14, size=session.shape), labels, objects, seed) == exact


def test_fewer_objects_than_folds_and_constant_features() -> None:
    few = planted(0, leak=1.0, objects=3)
    share, null = predictability(*few, 0)
    assert 0 <= share <= 1
    assert len(null) == leakage.PERMUTATIONS
    data = planted(0, leak=0.0)
    share, null = predictability(np.ones_like(data.features), data.labels, data.objects, 0)
    assert np.isfinite([share, *null]).all(), "what does not vary is no division by zero"


def coloured(catalogue: Catalogue, leak: float) -> list[Probe]:
    """Videos whose untouched picture depends on the object's hardness."""
    rng = np.random.default_rng(0)
    shades = rng.normal(size=(3, 144))
    made = []
    for number, o in enumerate(sorted(catalogue.objects)[:45]):
        for i in range(1 + number % 4):
            picture = 90 + leak * shades[catalogue.labels(o)[0]] + rng.normal(size=144)
            made.append(probe(f"{o}_{i}", thumbnail=tuple(picture)))
    return made


@pytest.mark.parametrize("sample", [leakage.SAMPLE, 50])
def test_a_picture_that_tells_the_label_is_a_warning(
    catalogue: Catalogue, sample: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a sample of the videos is predicted, as of very many."""
    monkeypatch.setattr(leakage, "PERMUTATIONS", 200)
    monkeypatch.setattr(leakage, "SAMPLE", sample)
    check = "predicted from the no-contact reference alone"
    hardness, *others = of(leaks(coloured(catalogue, 1.0), {}, catalogue), check)
    assert (hardness.item, hardness.severity) == ("hardness", WARNING)
    assert [f.item for f in others] == ["roughness", "bumpiness"]
    if sample == leakage.SAMPLE:
        assert float(hardness.measured.rpartition("p = ")[2]) < 0.01
        assert [f.severity for f in of(leaks(coloured(catalogue, 0.0), {}, catalogue), check)] == [INFO] * 3
    else:
        right = float(hardness.measured.partition(" ")[0]) / 100 * sample
        assert right == pytest.approx(round(right), abs=0.05), "a share of fifty"


def test_what_cannot_be_predicted_is_undefined() -> None:
    """Of too few objects, and where all have one class."""
    few = leaks(probes(2, OBJECTS[:4]), {}, OTHER)
    same = leaks(probes(), {}, relabelled(OTHER, ratings=((0, 0), (1, 1), (2, 2))))
    for findings in (few, same):
        found = [f for f in findings if f.check.startswith("predicted")]
        assert [(f.measured.partition(":")[0], f.severity) for f in found] == [("undefined", INFO)] * 6
