"""What the audit finds that parts share: objects, copies and recording sessions."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipeline.core.records import Part, Probe, Severity
from pipeline.videos.audit import leakage
from pipeline.videos.audit.leakage import sessions
from tests import audit_records as made
from tests.audit_records import ERROR, GOOD_SPLIT, INFO, OBJECTS, OTHER, WARNING, leaks, look_at, of, probe, probes
from tests.conftest import encode, write_video

pytestmark = pytest.mark.usefixtures("few_permutations")


def test_objects_stand_in_one_part() -> None:
    clean = leaks(probes(), GOOD_SPLIT, OTHER)
    assert [f.measured for f in of(clean, "object in two parts")] == ["0 of 8 objects"]
    assert [f.measured for f in of(clean, "same content")] == ["0 of 24 files"]
    assert [f.item for f in of(clean, "near-duplicate")] == ["all"]
    crossing = [f for f in leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.TEST}, OTHER) if f.severity is ERROR]
    assert [(f.check, f.item, f.measured) for f in crossing] == [("object in two parts", "rug", "test, validation")]
    spare = leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.UNUSED}, OTHER)
    without = leaks(probes(), {}, OTHER)
    assert not [f for f in (*clean, *spare, *without) if f.severity is ERROR], "an unused video is in no part"
    assert of(without, "session in two parts") == []


@pytest.mark.parametrize(
    ("twin", "severity"), [("potato_1", ERROR), ("rug_2", WARNING), ("cotton_ball_0", WARNING), ("lemon_0", WARNING)]
)
def test_equal_bytes(twin: str, severity: Severity) -> None:
    """In another part, of the same object, of another object in the same part, and of an unused one."""
    parts = {**GOOD_SPLIT, "lemon": Part.UNUSED}
    found = [f for f in of(leaks(probes(), parts, OTHER, rug_0="x", **{twin: "x"}), "same content") if f.item != "all"]
    assert [f.severity for f in found] == [severity]
    assert {found[0].item, found[0].measured.split(" with ")[1].split(",")[0]} == {"rug_0.mov", f"{twin}.mov"}


def test_an_unused_copy_does_not_hide_a_copy_in_two_parts() -> None:
    parts = {"baseball": Part.UNUSED, "cotton_ball": Part.TRAIN, "pillow": Part.TEST}
    found = leaks(probes(), parts, OTHER, baseball_0="x", cotton_ball_0="x", pillow_0="x")
    errors = [f for f in found if f.severity is ERROR]
    assert [(f.check, f.item) for f in errors] == [("same content", "pillow_0.mov")]
    assert "cotton_ball_0.mov" in errors[0].measured


def test_videos_without_any_contact_are_not_compared() -> None:
    still = [probe(p.video_id, contact=0.1, signature=(0.0,) * 432) for p in probes()]
    found = of(leaks(still, GOOD_SPLIT, OTHER), "near-duplicate")
    assert [(f.item, f.severity) for f in found] == [("all", INFO)]


@pytest.fixture(scope="module")
def presses(tmp_path_factory: pytest.TempPathFactory) -> list[Probe]:
    """Eight synthetic presses of four objects."""
    folder = tmp_path_factory.mktemp("presses")
    names = [f"{o}_{i}" for o in sorted(made.PHYSICLEAR.objects)[::20] for i in range(2)]
    return [
        look_at(write_video(folder / f"{name}.avi", made.recorded(name[:-2], seed)), name)
        for seed, name in enumerate(names)
    ]


@pytest.mark.parametrize(("start", "steps"), [(0, 0), (2, 12)], ids=["recoded", "shortened and brighter"])
def test_a_changed_copy_is_found(tmp_path: Path, presses: list[Probe], start: int, steps: int) -> None:
    frames = made.recorded("baseball", 5)
    changed = [cv2.add(frame, np.full_like(frame, steps)) for frame in frames[start:]]
    original = look_at(write_video(tmp_path / "baseball_0.avi", frames), "baseball_0")
    copy, twice = (
        look_at(encode(tmp_path / f"{name}.mp4", changed, "mpeg4", "yuv420p", bits=400_000), name)
        for name in ("potato_0", "baseball_1")
    )
    for others, one, two, severity in (
        (copy, Part.TRAIN, Part.TEST, ERROR),
        (copy, Part.TRAIN, Part.TRAIN, WARNING),
        (copy, Part.UNUSED, Part.TEST, WARNING),
        (twice, Part.TRAIN, Part.TRAIN, INFO),  # One object pressed twice alike is no warning.
    ):
        parts = {original.video_id: one, others.video_id: two}
        *near, _ = leakage.near_copies([*presses, original, others], parts)
        found = [f for f in near if f.item not in {p.path for p in presses}]
        assert [(f.item, f.severity) for f in found] == [(others.path, severity)]
        assert "baseball_0.avi" in found[0].measured
        assert {f.severity for f in near if f not in found} <= {INFO}, "different presses are no copies"
    many = [p.model_copy(update={"contact": copy.contact, "quiet": copy.quiet}) for p in drawn_contacts(500, 7)]
    assert named([*many, *presses, original, copy])[0] == [copy.path], "nor does a crowd hide it"


def drawn_contacts(videos: int, seed: int) -> list[Probe]:
    """Contacts of videos of as many objects: blobs somewhere, smooth or with texture, as `synthesize` makes them."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:18, :24]
    found = []
    for number in range(videos):
        middle, radius = rng.normal((9, 12), (1.2, 1.6)), np.exp(rng.normal(np.log(5), 0.35))
        blob = np.exp(-((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / (2 * radius**2))
        texture = gaussian_filter(rng.normal(size=(18, 24)), np.exp(rng.uniform(-0.5, 1.5)))
        texture *= np.exp(rng.normal(-1.5, 1)) / texture.std()
        # Lit from one side: brighter here, darker there.
        press = np.gradient(blob * (1 + texture))[1] + rng.normal(0, 0.004, (18, 24))
        press -= press.mean()
        found.append(probe(f"thing{number}_0", signature=tuple((press / np.linalg.norm(press)).ravel())))
    return found


def named(found: list[Probe]) -> tuple[list[str], float]:
    """The videos that are called near-duplicates, and the bound."""
    *near, summary = leakage.near_copies(found, {})
    return [f.item for f in near], float(summary.expected.split()[-1])


def test_smooth_blobs_are_no_copies_however_many_there_are() -> None:
    """Of 20 sets without copies hardly one may have any by chance, though their plain correlations reach .99."""
    sets = [drawn_contacts(120, seed) for seed in range(20)]
    assert max(float(np.triu(s @ s.T, 1).max()) for s in (np.array([p.signature for p in f]) for f in sets)) > 0.99
    assert sum(bool(named(found)[0]) for found in sets) <= 1
    many = [p for found in sets[:5] for p in found]
    many = [p.model_copy(update={"video_id": f"t{i}_0", "object_id": f"t{i}"}) for i, p in enumerate(many)]
    assert named(many)[0] == []
    assert named(many[:12]) == ([], leakage.DUPLICATE)


@pytest.mark.parametrize("pairs", [30, 10_000, 200_000, 10_000_000])
def test_the_bound_is_that_of_an_exponential_tail(pairs: int) -> None:
    """Against its quantiles: P(z > t) = exp(-(t - 0.2) / rate), of which one in so many pairs is `CHANCE` likely."""
    rate, m = 0.1, math.isqrt(pairs)
    largest = np.tanh(0.2 + rate * np.log(pairs / np.arange(1, m + 2)))
    expected = np.tanh(0.2 + rate * np.log(pairs / leakage.CHANCE)) if m >= leakage.FEWEST else 0.0
    found = leakage.likeness_bound(largest, pairs)
    assert found == pytest.approx(max(leakage.DUPLICATE, expected), rel=0.02)
    copies = np.concatenate([np.full(m // 20, 0.9999), largest])[: m + 1]
    assert leakage.likeness_bound(copies, pairs) - found < 0.03, "copies among them hardly move it"


def test_likeness_divides_out_what_is_shared() -> None:
    """Against the definition, by inverting the covariance. Equal ones are wholly alike; nothing is like nothing."""
    signatures = np.random.default_rng(0).normal(size=(30, 12)) + 3 * np.linspace(-1, 1, 12)
    signatures = np.vstack([signatures, signatures[:1], np.zeros(12)])
    inverse = np.linalg.inv(signatures.T @ signatures + np.eye(12))
    product = signatures @ inverse @ signatures.T
    length = np.sqrt(np.diag(product))
    length[-1] = 1
    own = leakage.likeness_vectors(signatures)
    np.testing.assert_allclose(own @ own.T, product / length / length[:, None], atol=1e-12)
    assert own[0] @ own[30] == pytest.approx(1)


def three_sensors(videos: int) -> tuple[list[Probe], list[int]]:
    rng = np.random.default_rng(5)
    looks = rng.normal(90, 8, (3, 144))
    found_videos, truth = [], []
    for number in range(videos):
        own = number % 3 if number < videos - 1 else 0
        drift = rng.normal(0, 6)
        picture = looks[own] + rng.normal(0, 1, 144) + drift
        found_videos.append(probe(f"{OBJECTS[number % 8]}_{number}", thumbnail=tuple(picture), brightness=90 + drift))
        truth.append(own)
    return found_videos, truth


def test_sessions_are_told_apart_by_the_untouched_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """In whatever order the videos come, and where most of them only go with the nearest of a sample."""
    found, truth = three_sensors(videos=60)
    names = sessions(found)
    assert len(set(names)) == len(set(zip(truth, names, strict=True))) == 3
    order = np.random.default_rng(0).permutation(60)
    assert sessions([found[i] for i in order]) == [names[i] for i in order]
    monkeypatch.setattr(leakage, "SAMPLE", 20)
    assert sessions(found) == names


def test_formats_and_names_are_sessions_of_their_own() -> None:
    look = tuple(np.linspace(50, 130, 144))
    found_videos = [
        *(probe(f"rug_{i}", thumbnail=look) for i in range(3)),
        *(probe(f"potato_{i}", thumbnail=look, fps=10.0) for i in range(2)),
        probe("lemon_0", thumbnail=look, session="monday"),
        probe("lemon_1", thumbnail=look, session="tuesday", fps=10.0),
    ]
    fast, slow = "25 frames/s, 320x240, look 1", "10 frames/s, 320x240, look 1"
    assert sessions(found_videos) == [fast, fast, fast, slow, slow, "monday", "tuesday"]


def test_a_session_in_training_and_test_is_a_warning() -> None:
    def named(session: dict[str, str]) -> list[tuple[str, str, Severity]]:
        found_videos = [probe(p.video_id, session=session.get(p.object_id, "monday")) for p in probes()]
        return [(f.item, f.measured, f.severity) for f in of(leaks(found_videos, parts, OTHER), "session in two parts")]

    parts = dict.fromkeys(OBJECTS[:5], Part.TRAIN) | {"millet": Part.VALIDATION, "lemon": Part.TEST}
    assert named({}) == [("monday", "15 train, 3 validation, 3 test", WARNING)]
    assert named({"lemon": "tuesday"}) == []
    assert named({"lemon": "tuesday", "orange": "tuesday"}) == [], "an unused video shares nothing"
    assert named({"lemon": "tuesday", "rug": "tuesday"}) == [("tuesday", "3 train, 3 test", WARNING)]


def test_what_a_session_holds() -> None:
    found_videos = [probe(p.video_id, session="a" if p.object_id == "rug" else "b", brightness=80.0) for p in probes()]
    first, second = of(leaks(found_videos, {}, OTHER), "session")
    assert (first.item, second.item) == ("a", "b")
    assert first.measured.startswith("3 videos of 1 objects, brightness 80.0; hardness ")
    assert sum(map(int, re.search(r"hardness ([\d/]+) %", first.measured)[1].split("/"))) == 100  # type: ignore[index]
    assert first.expected == second.expected
