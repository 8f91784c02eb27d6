"""What the audit finds that parts share: objects, copies, sessions, and pictures that tell the label."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.records import Part, Probe, Severity, Video
from pipeline.videos.audit import leakage
from pipeline.videos.audit.leakage import evidence, predictability, sessions
from pipeline.videos.catalogue import Catalogue
from tests.audit_records import (
    ERROR,
    GOOD_SPLIT,
    INFO,
    OBJECTS,
    OTHER,
    PHYSICLEAR,
    WARNING,
    assigned,
    leaks,
    look_at,
    of,
    probe,
    probes,
    recorded,
    relabelled,
)
from tests.conftest import encode, write_video


@pytest.mark.usefixtures("few_permutations")
def test_a_clean_split_leaks_nothing() -> None:
    findings = leaks(probes(), GOOD_SPLIT, OTHER)
    assert not [f for f in findings if f.severity is ERROR]
    assert [f.measured for f in of(findings, "object in two parts")] == ["0 of 8 objects"]
    assert [f.measured for f in of(findings, "same content")] == ["0 of 24 files"]
    assert [f.item for f in of(findings, "near-duplicate")] == ["all"]


@pytest.mark.usefixtures("few_permutations")
def test_an_object_in_two_parts_is_an_error() -> None:
    errors = [f for f in leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.TEST}, OTHER) if f.severity is ERROR]
    assert [(f.check, f.item, f.measured) for f in errors] == [("object in two parts", "rug", "test, validation")]
    spare = leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.UNUSED}, OTHER)
    assert not [f for f in spare if f.severity is ERROR], "an unused video is in no part"


@pytest.mark.usefixtures("few_permutations")
def test_without_a_split_nothing_is_said_of_parts() -> None:
    assert of(leaks(probes(), {}, OTHER), "session in two parts") == []
    assert not [f for f in leaks(probes(), {}, OTHER) if f.severity is ERROR]


@pytest.mark.usefixtures("few_permutations")
@pytest.mark.parametrize(
    ("twin", "severity"), [("potato_1", ERROR), ("rug_2", WARNING), ("cotton_ball_0", WARNING), ("lemon_0", WARNING)]
)
def test_equal_bytes(twin: str, severity: Severity) -> None:
    """In another part, of the same object, of another object in the same part, and of an unused one."""
    parts = {**GOOD_SPLIT, "lemon": Part.UNUSED}
    found = [f for f in of(leaks(probes(), parts, OTHER, rug_0="x", **{twin: "x"}), "same content") if f.item != "all"]
    assert [f.severity for f in found] == [severity]
    assert {found[0].item, found[0].measured.split(" with ")[1].split(",")[0]} == {"rug_0.mov", f"{twin}.mov"}


@pytest.mark.usefixtures("few_permutations")
def test_an_unused_copy_does_not_hide_a_copy_in_two_parts() -> None:
    parts = {"baseball": Part.UNUSED, "cotton_ball": Part.TRAIN, "pillow": Part.TEST}
    found = leaks(probes(), parts, OTHER, baseball_0="x", cotton_ball_0="x", pillow_0="x")
    errors = [f for f in found if f.severity is ERROR]
    assert [(f.check, f.item) for f in errors] == [("same content", "pillow_0.mov")]
    assert "cotton_ball_0.mov" in errors[0].measured


@pytest.mark.usefixtures("few_permutations")
def test_videos_without_any_contact_are_not_compared() -> None:
    still = [probe(p.video_id, contact=0.1, signature=(0.0,) * 432) for p in probes()]
    found = of(leaks(still, GOOD_SPLIT, OTHER), "near-duplicate")
    assert [(f.item, f.severity) for f in found] == [("all", INFO)]


@pytest.fixture(scope="module")
def presses(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Probe, Video]]:
    """Thirty synthetic presses of fifteen objects."""
    folder = tmp_path_factory.mktemp("presses")
    names = [f"{o}_{i}" for o in sorted(PHYSICLEAR.objects)[::5] for i in range(2)]
    return [
        look_at(write_video(folder / f"{name}.avi", recorded(name[:-2], seed)), name) for seed, name in enumerate(names)
    ]


def test_thirty_different_presses_have_no_near_duplicates(presses: list[tuple[Probe, Video]]) -> None:
    assert len(presses) == 30
    found = evidence([p for p, _ in presses], [v for _, v in presses], [])
    touched = [f for f in leakage._near_copies(found) if f.item == "all"]
    assert int(re.findall(r"of (\d+) videos", touched[0].measured)[0]) >= 20, "most show contact, so most are compared"
    assert {f.severity for f in leakage._near_copies(found)} == {INFO}, "an object pressed twice alike is no warning"


def recoded(path: Path, frames: Sequence[np.ndarray]) -> Path:
    return encode(path, frames, "mpeg4", "yuv420p", bits=400_000)


def brighter(frames: Sequence[np.ndarray], steps: int) -> list[np.ndarray]:
    return [cv2.add(frame, np.full_like(frame, steps)) for frame in frames]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("another codec", lambda frames: frames),
        ("brighter", lambda frames: brighter(frames, 12)),
        ("shortened", lambda frames: frames[3:]),
        ("all of it", lambda frames: brighter(frames, 12)[3:]),
    ],
)
def test_a_changed_copy_is_found(tmp_path: Path, presses: list[tuple[Probe, Video]], name: str, change: object) -> None:
    frames = recorded("baseball", 5)
    assert callable(change)
    original = look_at(write_video(tmp_path / "baseball_0.avi", frames), "baseball_0")
    copy = look_at(recoded(tmp_path / "potato_0.mp4", change(frames)), "potato_0")
    twice = look_at(recoded(tmp_path / "baseball_1.mp4", change(frames)), "baseball_1")
    for others, one, two, severity in (
        (copy, Part.TRAIN, Part.TEST, ERROR),
        (copy, Part.TRAIN, Part.TRAIN, WARNING),
        (copy, Part.UNUSED, Part.TEST, WARNING),
        (twice, Part.TRAIN, Part.TRAIN, INFO),
    ):
        pairs = [*presses, original, others]
        parts = {original[0].video_id: one, others[0].video_id: two}
        found = evidence([p for p, _ in pairs], [v for _, v in pairs], assigned([p for p, _ in pairs], parts))
        known = {p.path for p, _ in presses} | {"all"}
        near = [f for f in leakage._near_copies(found) if f.item not in known]
        assert [(f.item, f.severity) for f in near] == [(others[0].path, severity)], name
        assert "baseball_0.avi" in near[0].measured


def three_sensors(noise: float = 1.0, videos: int = 12) -> tuple[list[Probe], list[int]]:
    rng = np.random.default_rng(5)
    looks = rng.normal(90, 8, (3, 144))
    made, truth = [], []
    for number in range(videos):
        own = number % 3 if number < videos - 1 else 0
        drift = rng.normal(0, 6)
        picture = looks[own] + rng.normal(0, noise, 144) + drift
        made.append(probe(f"{OBJECTS[number % 8]}_{number}", thumbnail=tuple(picture), brightness=90 + drift))
        truth.append(own)
    return made, truth


@pytest.mark.parametrize("seed", range(5))
def test_sessions_are_told_apart_by_the_untouched_picture(seed: int) -> None:
    made, truth = three_sensors()
    names = dict(zip((p.video_id for p in made), sessions(made), strict=True))
    assert len(set(names.values())) == 3
    assert len({(own, names[p.video_id]) for own, p in zip(truth, made, strict=True)}) == 3
    shuffled = random.Random(seed).sample(made, len(made))
    assert dict(zip((p.video_id for p in shuffled), sessions(shuffled), strict=True)) == names


def test_drifting_brightness_is_one_session() -> None:
    rng = np.random.default_rng(2)
    look = rng.normal(90, 8, 144)
    made = [probe(f"rug_{i}", thumbnail=tuple(look + 2.0 * i + rng.normal(0, 0.5, 144))) for i in range(15)]
    assert set(sessions(made)) == {"25 frames/s, 320x240, look 1"}
    assert set(sessions([probe(f"rug_{i}", thumbnail=(90.0,) * 144) for i in range(5)])) == {
        "25 frames/s, 320x240, look 1"
    }, "equal to the last bit"


def test_formats_and_names_are_sessions_of_their_own() -> None:
    look = tuple(np.linspace(50, 130, 144))
    made = [
        *(probe(f"rug_{i}", thumbnail=look) for i in range(3)),
        *(probe(f"potato_{i}", thumbnail=look, fps=10.0) for i in range(2)),
        probe("lemon_0", thumbnail=look, session="monday"),
        probe("lemon_1", thumbnail=look, session="tuesday", fps=10.0),
    ]
    fast, slow = "25 frames/s, 320x240, look 1", "10 frames/s, 320x240, look 1"
    assert sessions(made) == [fast, fast, fast, slow, slow, "monday", "tuesday"]


@pytest.mark.usefixtures("few_permutations")
def test_a_session_in_training_and_test_is_a_warning() -> None:
    def named(session: dict[str, str]) -> list[tuple[str, str, Severity]]:
        made = [probe(p.video_id, session=session.get(p.object_id, "monday")) for p in probes()]
        return [(f.item, f.measured, f.severity) for f in of(leaks(made, parts, OTHER), "session in two parts")]

    parts = dict.fromkeys(OBJECTS[:5], Part.TRAIN) | {"millet": Part.VALIDATION, "lemon": Part.TEST}
    assert named({}) == [("monday", "15 train, 3 validation, 3 test", WARNING)]
    assert named({"lemon": "tuesday"}) == []
    assert named({"lemon": "tuesday", "orange": "tuesday"}) == [], "an unused video shares nothing"
    assert named({"lemon": "tuesday", "rug": "tuesday"}) == [("tuesday", "3 train, 3 test", WARNING)]


@pytest.mark.usefixtures("few_permutations")
def test_what_a_session_holds() -> None:
    made = [probe(p.video_id, session="a" if p.object_id == "rug" else "b", brightness=80.0) for p in probes()]
    first, second = of(leaks(made, {}, OTHER), "session")
    assert (first.item, second.item) == ("a", "b")
    assert first.measured.startswith("3 videos of 1 objects, brightness 80.0; hardness ")
    assert sum(map(int, re.search(r"hardness ([\d/]+) %", first.measured)[1].split("/"))) == 100  # type: ignore[index]
    assert first.expected == second.expected


# What the untouched picture tells


@dataclass(frozen=True)
class Planted:
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


@pytest.mark.parametrize("seed", range(4))
def test_predictability_is_ridge_regression_fold_by_fold(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(leakage, "PERMUTATIONS", 5)
    data = planted(seed, leak=0.7, dims=(4, 40, 90, 144)[seed])
    share, null = predictability(data.features, data.labels, data.objects, seed)
    assert [share, *null] == pytest.approx(slow_shares(data, seed, 5), abs=1e-12)


def test_a_planted_leak_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leakage, "PERMUTATIONS", 400)
    for seed in range(3):
        data = planted(seed, leak=1.5)
        share, null = predictability(data.features, data.labels, data.objects, seed)
        assert p_value(share, null) < 0.01
        assert share > 0.6 > float(np.mean(null)) + 0.1


@pytest.mark.parametrize("own", [0.0, 3.0])
def test_noise_gives_uniform_p_values(monkeypatch: pytest.MonkeyPatch, own: float) -> None:
    """Also where videos of one object look alike: labels are permuted among objects, not among videos."""
    monkeypatch.setattr(leakage, "PERMUTATIONS", 79)
    values = []
    for seed in range(100):
        data = planted(seed, leak=0.0, own=own)
        values.append(p_value(*predictability(data.features, data.labels, data.objects, seed)))
    assert 0.01 <= np.mean(np.array(values) <= 0.05) <= 0.12
    assert 0.35 <= np.mean(np.array(values) <= 0.5) <= 0.65
    assert 0.4 < np.mean(values) < 0.6


def test_predictability_follows_from_its_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leakage, "PERMUTATIONS", 20)
    data = planted(1, leak=0.5)
    first = predictability(data.features, data.labels, data.objects, 3)
    assert first == predictability(data.features, data.labels, data.objects, 3)
    assert first != predictability(data.features, data.labels, data.objects, 4)


@pytest.mark.parametrize("seed", range(3))
def test_classes_that_are_equally_likely_are_not_told_apart_by_rounding(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Sessions with as many objects of each class: every score is a tie, and each processor rounds in its own way."""
    monkeypatch.setattr(leakage, "PERMUTATIONS", 200)
    rng = np.random.default_rng(seed)
    objects = [f"object_{i:02d}" for i in range(36)]
    labels = [i % 3 for i in range(36)]
    session = np.eye(4)[[i // 9 for i in range(36)]]
    exact = predictability(session, labels, objects, seed)
    for _ in range(5):
        assert predictability(session + rng.normal(scale=1e-14, size=session.shape), labels, objects, seed) == exact


def test_fewer_objects_than_folds_and_constant_features(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leakage, "PERMUTATIONS", 10)
    few = planted(0, leak=1.0, objects=3)
    share, null = predictability(few.features, few.labels, few.objects, 0)
    assert 0 <= share <= 1
    assert len(null) == 10
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


def test_a_picture_that_tells_the_label_is_a_warning(catalogue: Catalogue) -> None:
    check = "predicted from the no-contact reference alone"
    hardness, *others = of(leaks(coloured(catalogue, 1.0), {}, catalogue), check)
    assert (hardness.item, hardness.severity) == ("hardness", WARNING)
    assert float(hardness.measured.rpartition("p = ")[2]) < 0.01
    assert re.fullmatch(r"\d+\.\d \+- \d+\.\d % if it told nothing", hardness.expected)
    assert [f.item for f in others] == ["roughness", "bumpiness"]
    quiet = of(leaks(coloured(catalogue, 0.0), {}, catalogue), check)
    assert [f.severity for f in quiet] == [INFO] * 3
    assert quiet == of(leaks(coloured(catalogue, 0.0), {}, catalogue), check)


def test_what_cannot_be_predicted_is_undefined() -> None:
    alike = "undefined: too few objects, classes or sessions"
    few = [f for f in leaks(probes(2, OBJECTS[:4]), {}, OTHER) if f.check.startswith("predicted")]
    assert [(f.measured, f.severity) for f in few] == [(alike, INFO)] * 6
    one_class = relabelled(OTHER, ratings=((0, 0), (1, 1), (2, 2)))
    same = [f for f in leaks(probes(), {}, one_class) if f.check.startswith("predicted")]
    assert [(f.measured, f.severity) for f in same] == [(alike, INFO)] * 6
