"""What the audit finds that parts share, and what tells a label without touch."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from sklearn.linear_model import Ridge
from sklearn.preprocessing import StandardScaler

from pipeline.core.records import Part
from pipeline.videos.audit import leakage
from pipeline.videos.audit.leakage import predictability, sessions
from pipeline.videos.records import Probe, Severity
from tests import audit_records as made
from tests.audit_records import ERROR, GOOD_SPLIT, INFO, OBJECTS, OTHER, WARNING, leaks, look_at, of, probe, probes
from tests.conftest import encode, write_video

pytestmark = pytest.mark.usefixtures("few_permutations")


def test_objects_stand_in_one_part() -> None:
    clean = leaks(probes(), GOOD_SPLIT, OTHER)
    assert [f.measured for f in of(clean, "object in two parts")] == ["0 of 8 objects"]
    assert [f.measured for f in of(clean, "same content")] == ["0 of 24 files"]
    assert [f.item for f in of(clean, "near-duplicate")] == ["all"]
    spare, without = leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.UNUSED}, OTHER), leaks(probes(), {}, OTHER)
    assert of(without, "session in two parts") == []
    crossing = leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.TEST}, OTHER)
    errors = [(f.check, f.item, f.measured) for f in (*clean, *spare, *without, *crossing) if f.severity is ERROR]
    assert errors == [("object in two parts", "rug", "test, validation")]


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
    (error,) = (f for f in found if f.severity is ERROR)
    assert (error.check, error.item) == ("same content", "pillow_0.mov")
    assert "cotton_ball_0.mov" in error.measured


def test_videos_without_any_contact_are_not_compared() -> None:
    still = [probe(p.video_id, contact=0.1, signature=(0.0,) * 432) for p in probes()]
    found = of(leaks(still, GOOD_SPLIT, OTHER), "near-duplicate")
    assert [(f.item, f.severity) for f in found] == [("all", INFO)]


@pytest.fixture(scope="module")
def presses(tmp_path_factory: pytest.TempPathFactory) -> list[Probe]:
    folder, objects = tmp_path_factory.mktemp("presses"), sorted(made.PHYSICLEAR.objects)[::20]
    return [
        look_at(write_video(folder / f"{o}.avi", made.recorded(o, seed)), f"{o}_0") for seed, o in enumerate(objects)
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
        parts = {v.video_id: part for v, part in ((original, one), (others, two)) if part != Part.UNUSED}
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


def test_sessions_are_told_apart_by_the_untouched_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """In whatever order the videos come, and where most of them only go with the nearest of a sample."""
    rng = np.random.default_rng(5)
    looks, truth = rng.normal(90, 8, (3, 144)), [number % 3 for number in range(59)] + [0]
    found = []
    for number, own in enumerate(truth):
        picture = looks[own] + rng.normal(0, 1, 144) + (drift := rng.normal(0, 6))
        found.append(probe(f"{OBJECTS[number % 8]}_{number}", thumbnail=tuple(picture), brightness=90 + drift))
    names = sessions(found)
    assert len(set(names)) == len(set(zip(truth, names, strict=True))) == 3
    order = rng.permutation(60)
    assert sessions([found[i] for i in order]) == [names[i] for i in order]
    monkeypatch.setattr(leakage, "SAMPLE", 20)
    assert sessions(found) == names


def test_formats_and_names_are_sessions_of_their_own() -> None:
    look = {"thumbnail": tuple(np.linspace(50, 130, 144))}
    found = [
        *(probe(f"rug_{i}", **look) for i in range(3)),
        *(probe(f"potato_{i}", **look, fps=10.0) for i in range(2)),
        probe("lemon_0", **look, session="monday"),
        probe("lemon_1", **look, session="tuesday", fps=10.0),
    ]
    fast, slow = "25 frames/s, 320x240, look 1", "10 frames/s, 320x240, look 1"
    assert sessions(found) == [fast, fast, fast, slow, slow, "monday", "tuesday"]


def test_a_session_in_training_and_test_is_a_warning() -> None:
    parts = dict.fromkeys(OBJECTS[:5], Part.TRAIN) | {"millet": Part.VALIDATION, "lemon": Part.TEST}
    for others, expected in (
        ({}, [("monday", "15 train, 3 validation, 3 test", WARNING)]),
        ({"lemon"}, []),
        ({"lemon", "orange"}, []),  # An unused video shares nothing.
        ({"lemon", "rug"}, [("tuesday", "3 train, 3 test", WARNING)]),
    ):
        found = [probe(p.video_id, session="tuesday" if p.object_id in others else "monday") for p in probes()]
        shared = of(leaks(found, parts, OTHER), "session in two parts")
        assert [(f.item, f.measured, f.severity) for f in shared] == expected


# Whether the untouched sensor tells the label: against scikit-learn, planted leaks and pure noise


def planted(
    seed: int, *, leak: float, objects: int = 24, dims: int = 6, own: float = 0.0
) -> tuple[np.ndarray, list[int], list[str]]:
    """Features, labels and objects of unequal numbers of videos; `leak` moves features with the label, `own` with the
    object."""
    rng = np.random.default_rng(seed)
    label = rng.integers(0, 3, objects)
    member = rng.permutation(np.repeat(np.arange(objects), rng.integers(1, 6, objects)))
    centres, looks = rng.normal(size=(3, dims)), rng.normal(size=(objects, dims))
    features = leak * centres[label[member]] + own * looks[member] + rng.normal(size=(len(member), dims))
    return features, label[member].tolist(), [f"object {m:02}" for m in member]


@pytest.mark.parametrize("seed", range(3))
def test_predictability_is_ridge_regression_fold_by_fold(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(leakage, "PERMUTATIONS", 5)
    features, labels, objects = planted(seed, leak=0.7, dims=(4, 40, 144)[seed])
    found, null = predictability(features, labels, objects, seed)
    rng = np.random.default_rng(seed)
    names, place = np.unique(objects, return_inverse=True)
    fold = (rng.permutation(len(names)) % min(leakage.FOLDS, len(names)))[place]
    own = np.array([labels[objects.index(name)] for name in names])
    scaled = StandardScaler().fit_transform(features) / np.sqrt(features.shape[1])
    shares = []
    for order in [own, *(rng.permutation(own) for _ in range(5))]:
        truth, said = order[place], np.empty(len(place), int)
        for test in (fold == number for number in set(fold.tolist())):
            model = Ridge(alpha=leakage.RIDGE).fit(scaled[~test], np.eye(3)[truth[~test]])
            said[test] = model.predict(scaled[test]).argmax(1)
        shares.append(np.mean(said == truth))
    assert [found, *null] == pytest.approx(shares, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_classes_that_are_equally_likely_are_not_told_apart_by_rounding(seed: int) -> None:
    """Sessions with as many objects of each class: every score is a tie, and each processor rounds in its own way."""
    rng = np.random.default_rng(seed)
    rest = [i % 3 for i in range(36)], [f"object_{i:02d}" for i in range(36)], seed
    session = np.repeat(np.eye(4), 9, axis=0)
    exact = predictability(session, *rest)
    for _ in range(5):
        assert predictability(session + rng.normal(scale=1e-14, size=session.shape), *rest) == exact


def test_constant_features_are_no_division_by_zero() -> None:
    features, labels, objects = planted(0, leak=0.0)
    share, null = predictability(np.ones_like(features), labels, objects, 0)
    assert np.isfinite([share, *null]).all()


@pytest.mark.parametrize(("sample", "leak"), [(leakage.SAMPLE, 1.0), (leakage.SAMPLE, 0.0), (50, 1.0)])
def test_a_picture_that_tells_the_label_is_a_warning(monkeypatch: pytest.MonkeyPatch, sample: int, leak: float) -> None:
    monkeypatch.setattr(leakage, "PERMUTATIONS", 200)
    monkeypatch.setattr(leakage, "SAMPLE", sample)
    rng = np.random.default_rng(0)
    shades = rng.normal(size=(3, 144))
    found = []
    for number, o in enumerate(sorted(made.PHYSICLEAR.objects)[:45]):
        for i in range(1 + number % 4):
            picture = 90 + leak * shades[made.PHYSICLEAR.labels(o)[0]] + rng.normal(size=144)
            found.append(probe(f"{o}_{i}", thumbnail=tuple(picture)))
    said = of(leaks(found, {}, made.PHYSICLEAR), "predicted from the no-contact reference alone")
    assert [f.item for f in said] == ["hardness", "roughness", "bumpiness"]
    if leak == 0:
        assert [f.severity for f in said] == [INFO] * 3
    else:
        assert said[0].severity == WARNING
        assert float(said[0].measured.rpartition("p = ")[2]) < 0.01
    if sample == 50:
        right = float(said[0].measured.partition(" ")[0]) / 100 * sample
        assert right == pytest.approx(round(right), abs=0.05), "a share of fifty"


def test_what_cannot_be_predicted_is_undefined() -> None:
    few = leaks(probes(2, OBJECTS[:4]), {}, OTHER)
    same = leaks(probes(), {}, made.relabelled(OTHER, ratings=((0, 0), (1, 1), (2, 2))))
    for findings in (few, same):
        found = [(f.measured.partition(":")[0], f.severity) for f in findings if f.check.startswith("predicted")]
        assert found == [("undefined", INFO)] * 6
