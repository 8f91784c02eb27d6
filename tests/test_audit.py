"""The data audit: what it finds in made-up measurements and in real files, and what it leaves in peace."""

from __future__ import annotations

import csv
import os
import random
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pipeline.artifacts import read_csv, write_csv, write_table
from pipeline.audit import leakage
from pipeline.audit.files import FOUND, check_files
from pipeline.audit.labels import check_labels, similar_names
from pipeline.audit.leakage import check_leakage, evidence, predictability, sessions
from pipeline.audit.run import audit_chain, audit_folder, by_severity, check_folder, stop_on_errors, summary
from pipeline.errors import UserError
from pipeline.frames.scan import Scan, scan
from pipeline.physiclear.catalogue import Catalogue, load_catalogue
from pipeline.records import Assignment, Finding, Part, Probe, Severity, Video
from pipeline.runtime import derive_seed
from pipeline.scenes.light import make_sensor
from pipeline.scenes.recipe import recipe_of
from pipeline.scenes.video import render
from pipeline.sections import FramesConfig, ScenesConfig, SplitConfig
from pipeline.videos import VideoFile
from tests.closure import ROOT
from tests.conftest import moving_square, write_video
from tests.fake_chain import fake_params

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO
PHYSICLEAR = load_catalogue(ROOT / "pipeline" / "physiclear")
OBJECTS = ("baseball", "cotton_ball", "pillow", "potato", "rug", "millet", "lemon", "orange")
GOOD_SPLIT = {o: (Part.TRAIN, Part.VALIDATION, Part.TEST)[i % 3] for i, o in enumerate(OBJECTS)}


def probe(video_id: str = "rug_0", **changes: object) -> Probe:
    """What a flawless video measures; its contact and its untouched picture are its own."""
    rng = np.random.default_rng(derive_seed(video_id))
    contact = rng.normal(size=24 * 18)
    good: dict[str, object] = {
        "video_id": video_id,
        "object_id": video_id.rpartition("_")[0],
        "path": f"{video_id}.mov",
        "session": "",
        "header_frames": 126,
        "frames": 126,
        "fps": 25.0,
        "width": 320,
        "height": 240,
        "rotation": 0,
        "irregular": 1.0,
        "kept": 37,
        "brightness": 90.0,
        "brightness_step": 0.4,
        "saturated": 0.0,
        "contact": 1.4,
        "quiet": 0.25,
        "contact_end": 0.3,
        "starts_touching": False,
        "texture_start": 2.0,
        "texture_end": 2.0,
        "thumbnail": tuple(rng.normal(90, 1, 6 * 8 * 3)),
        "signature": tuple(contact / np.linalg.norm(contact)),
    }
    return Probe.model_validate({**good, **changes})


def probes(videos: int = 3, objects: Sequence[str] = OBJECTS) -> list[Probe]:
    return [probe(f"{o}_{i}") for o in objects for i in range(videos)]


def video(of: Probe, sha256: str = "") -> Video:
    return Video(
        video_id=of.video_id,
        object_id=of.object_id,
        path=of.path,
        sha256=sha256 or f"sha of {of.path}",
        frames=of.frames,
        fps=of.fps,
        width=of.width,
        height=of.height,
    )


def assigned(found: Sequence[Probe], parts: dict[str, Part]) -> list[Assignment]:
    """Parts by video id, else by object."""
    return [
        Assignment(
            video_id=p.video_id,
            object_id=p.object_id,
            part=parts.get(p.video_id, parts.get(p.object_id, Part.UNUSED)),
        )
        for p in found
    ]


def odd(findings: Sequence[Finding] | Iterator[Finding]) -> list[Finding]:
    return [f for f in findings if f.severity is not INFO]


def of(findings: Sequence[Finding] | Iterator[Finding], check: str) -> list[Finding]:
    return [f for f in findings if f.check == check]


def leaks(found: Sequence[Probe], parts: dict[str, Part], catalogue: Catalogue, **sha256: str) -> list[Finding]:
    videos = [video(p, sha256.get(p.video_id, "")) for p in found]
    return list(check_leakage(evidence(found, videos, assigned(found, parts)), catalogue))


@pytest.fixture(scope="module")
def other(catalogue: Catalogue) -> Catalogue:
    """Eight objects of a data set that the paper says nothing about."""
    language = catalogue.language.model_copy(update={"dataset": ""})
    return Catalogue(language=language, objects={o: catalogue.objects[o] for o in OBJECTS})


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few permutations, where they are not what is tested."""
    monkeypatch.setattr(leakage, "PERMUTATIONS", 50)


# Files


def test_flawless_videos_give_no_warning(other: Catalogue) -> None:
    assert odd(check_files(probes(), other)) == []


def test_nothing_to_check(other: Catalogue) -> None:
    assert list(check_files([], other)) == []
    assert list(check_leakage(evidence([], [], []), other)) == []


def test_a_single_video_has_nothing_to_differ_from(catalogue: Catalogue) -> None:
    language = catalogue.language.model_copy(update={"dataset": ""})
    alone = Catalogue(language=language, objects={"rug": catalogue.objects["rug"]})
    assert odd(check_files([probe()], alone)) == []
    assert odd(leaks([probe()], {}, alone)) == []


@pytest.mark.parametrize(
    ("changes", "check", "measured", "expected"),
    [
        ({"frames": 62, "header_frames": 62}, "length", "62 frames", "about 126, as others at 25 frames/s"),
        ({"header_frames": 130}, "frames that decode", "126", "130, by the header"),
        ({"brightness": 60.0}, "brightness", "60.0 of 255", "90.0 +- 1.0, as others at 25 frames/s"),
        ({"brightness": 97.0}, "brightness", "97.0 of 255", "90.0 +- 1.0, as others at 25 frames/s"),
        ({"brightness_step": 9.0}, "brightness", "a step of 9.0 of 255", "at most 4"),
        ({"saturated": 0.2}, "saturation", "20 % of values at 0 or 255", "at most 5 %"),
        ({"rotation": 90}, "rotation", "90 degrees in the metadata, applied", "0"),
        ({"irregular": 2.0}, "frame rate", "varies by a factor of 2.0", "even"),
        ({"kept": 0}, "frames kept", "0", "5 or more, by frames.selection"),
        ({"contact": 0.4}, "contact", "not found: strength 0.40", "over 0.50"),
        ({"contact_end": 1.0}, "contact at the end", "still 1.00 of 1.40", "under 0.70"),
        (
            {"starts_touching": True},
            "contact at the start",
            "touched from the first frame: the reference comes from the end",
            "untouched",
        ),
    ],
)
def test_one_odd_video_is_one_warning(
    other: Catalogue, changes: dict[str, object], check: str, measured: str, expected: str
) -> None:
    found = [p if p.video_id != "rug_1" else probe("rug_1", **changes) for p in probes()]
    assert odd(check_files(found, other)) == [
        Finding(check=check, item="rug_1.mov", measured=measured, expected=expected, severity=WARNING)
    ]


@pytest.mark.parametrize(
    "changes",
    [
        {"frames": 63, "header_frames": 63},
        {"header_frames": 0},
        {"brightness": 96.0},
        {"brightness_step": 4.0},
        {"saturated": 0.05},
        {"irregular": 0.0},
        {"irregular": 1.5},
        {"contact": 0.51},
        {"contact_end": 0.7},
        {"contact": 0.6, "contact_end": 0.5},
    ],
)
def test_just_within_the_limit_is_no_warning(other: Catalogue, changes: dict[str, object]) -> None:
    """Among them a container that promises no number of frames, and one without time stamps."""
    found = [p if p.video_id != "rug_1" else probe("rug_1", **changes) for p in probes()]
    assert odd(check_files(found, other)) == []


def test_mixed_frame_rates_and_sizes_name_the_rarer(other: Catalogue) -> None:
    found = [probe(p.video_id, fps=10.0, frames=50, header_frames=50) if p.object_id == "rug" else p for p in probes()]
    found[0] = probe(found[0].video_id, width=640, height=480)
    warnings = odd(check_files(found, other))
    assert [(f.check, f.item, f.measured, f.expected) for f in warnings] == [
        ("frame rate", "10 frames/s", "3 videos", "25 frames/s"),
        ("resolution", "640x480", "1 videos", "320x240"),
    ], "fifty frames at ten a second are not short: lengths are compared at one rate"
    assert ("frame rate", "25 frames/s", "21 videos") in [
        (f.check, f.item, f.measured) for f in check_files(found, other)
    ]


def test_brightness_is_held_against_videos_of_the_same_rate(other: Catalogue) -> None:
    found = [probe(p.video_id, fps=10.0, brightness=120.0) if p.object_id in ("rug", "millet") else p for p in probes()]
    assert of(odd(check_files(found, other)), "brightness") == []


def test_an_outlier_is_judged_by_the_usual_spread(other: Catalogue) -> None:
    found = [probe(p.video_id, brightness=90.0 + 5 * (i % 5)) for i, p in enumerate(probes())]
    assert of(odd(check_files(found, other)), "brightness") == []
    found[3] = probe(found[3].video_id, brightness=200.0)
    assert [f.item for f in of(odd(check_files(found, other)), "brightness")] == [found[3].path]


def test_videos_an_object_and_objects_without(other: Catalogue) -> None:
    found = [*probes(2, OBJECTS[:5]), *probes(4, OBJECTS[5:7])]
    findings = list(check_files(found, other))
    assert [f.measured for f in of(findings, "videos per object")] == ["5 objects with 2, 2 objects with 4"]
    total, absent = of(findings, "videos")
    assert (total.measured, total.expected, total.severity) == ("18 videos of 7 objects", "", INFO)
    assert (absent.item, absent.measured, absent.severity) == ("orange", "no video", WARNING)


def test_the_papers_lengths_stand_beside_its_own_data_only(catalogue: Catalogue, other: Catalogue) -> None:
    theirs = [f for f in check_files(probes(), catalogue) if f.item == "all" and f.severity is WARNING]
    assert [(f.check, f.expected) for f in theirs] == [
        ("videos", "408 videos of 74 objects"),
        ("length", "50 to 126 frames, mean 112.3"),
    ]
    assert {f.expected for f in check_files(probes(), other) if f.check in ("videos", "length")} == {""}


@given(st.lists(st.floats(0, 5), min_size=3, max_size=12), st.floats(1.1, 50))
def test_contact_is_relative_to_the_noise_of_the_data(strengths: list[float], louder: float) -> None:
    """All strengths times a factor: the same videos lack contact, however sensitive the camera is."""

    def named(factor: float) -> set[str]:
        found = [
            probe(f"rug_{i}", contact=factor * (0.01 + s), quiet=factor * 0.3, contact_end=0.0)
            for i, s in enumerate(strengths)
        ]
        return {f.item for f in of(odd(check_files(found, PHYSICLEAR)), "contact")}

    margins = [abs(0.01 + s - FOUND * 0.3) for s in strengths]
    if min(margins) > 1e-6:
        assert named(louder) == named(1.0)


# Labels


def test_the_papers_counts_and_agreement_beside_the_recomputed(catalogue: Catalogue) -> None:
    findings = list(check_labels(catalogue))
    counts = [(f.item, f.measured, f.expected, f.severity) for f in of(findings, "objects of a class")]
    assert counts == [
        ("hardness: soft", "11", "26", WARNING),
        ("hardness: moderately hard", "31", "14", WARNING),
        ("hardness: hard", "32", "34", WARNING),
        ("roughness: smooth", "28", "36", WARNING),
        ("roughness: slightly rough", "23", "16", WARNING),
        ("roughness: rough", "23", "22", WARNING),
        ("bumpiness: no bumps", "25", "26", WARNING),
        ("bumpiness: small bumps", "38", "34", WARNING),
        ("bumpiness: big bumps", "11", "14", WARNING),
    ]
    agreement = of(findings, "agreement, ICC(3,k)")
    assert [(f.item, f.measured.split()[0], f.expected, f.severity) for f in agreement] == [
        ("hardness", "0.893", "0.894", WARNING),
        ("roughness", "0.979", "0.979", INFO),
        ("bumpiness", "0.773", "0.792", WARNING),
    ]
    for f in agreement:
        value, low, high = map(float, re.findall(r"0\.\d{3}", f.measured))
        assert low < value < high


def test_the_catalogues_stated_labels_and_splits(catalogue: Catalogue) -> None:
    findings = list(check_labels(catalogue))
    stated = of(findings, "stated label")
    assert [(f.item, f.measured, f.expected, f.severity) for f in stated] == [
        ("gauze_pad: hardness", "hard (mean rating 1.67)", "moderately hard", WARNING)
    ]
    differing = {f.item for f in of(findings, "splits differ")}
    assert differing == {"bubble_wrap", "clothes_peg", "eraser", "ice_block", "lemon", "orange"}
    assert not any(f.severity is ERROR for f in findings)


def test_descriptions_that_contradict_the_roughness(catalogue: Catalogue) -> None:
    found = [f for f in of(list(check_labels(catalogue)), "description") if f.item.endswith(": roughness")]
    assert {f.item.removesuffix(": roughness") for f in found} == {
        *("rubber_bands", "clothes_peg", "aluminium_foil", "controller_keypad"),
        *("controller_buttons", "nylon_shirt", "cotton_ball", "pen_pad"),
    }
    for f in found:
        assert f.measured.startswith("rated slightly rough (")
        assert (f.expected, f.severity) == ("described as smooth", WARNING)


def relabelled(catalogue: Catalogue, **changes: object) -> Catalogue:
    """Objects of `catalogue` that all have the same changes."""
    objects = {o: entry.model_copy(update=changes) for o, entry in catalogue.objects.items()}
    return Catalogue(language=catalogue.language, objects=objects)


def test_labels_of_other_data_are_not_held_against_the_paper(other: Catalogue) -> None:
    for check in ("objects of a class", "agreement, ICC(3,k)"):
        assert {f.expected for f in of(list(check_labels(other)), check)} == {""}


def test_agreement_is_undefined_without_variance_or_with_one_rating(other: Catalogue) -> None:
    for ratings in (((1,), (0,), (2,)), ((1, 1, 1),) * 3):
        same = relabelled(other, ratings=ratings)
        found = of(list(check_labels(same)), "agreement, ICC(3,k)")
        assert [f.measured for f in found] == ["undefined: one rating, or no variance"] * 3
        assert {f.severity for f in found} == {INFO}


def test_agreement_is_undefined_where_numbers_of_ratings_differ(other: Catalogue) -> None:
    objects = dict(other.objects)
    rug = objects["rug"]
    objects["rug"] = rug.model_copy(update={"ratings": (rug.ratings[0][:2], *rug.ratings[1:])})
    found = of(list(check_labels(Catalogue(language=other.language, objects=objects))), "agreement, ICC(3,k)")
    assert found[0].measured == "undefined: objects have different numbers of ratings"
    assert all(re.match(r"-?\d\.\d{3} \(", f.measured) for f in found[1:])


def test_a_class_that_nobody_chose_is_a_warning(other: Catalogue) -> None:
    same = relabelled(other, ratings=((0, 0),) * 3)
    found = of(list(check_labels(same)), "objects of a class")
    assert [f.severity for f in found] == [INFO, WARNING, WARNING] * 3


def test_stated_labels_are_compared_where_there_are_any(other: Catalogue) -> None:
    assert of(list(check_labels(relabelled(other, stated=(None, None, None)))), "stated label") == []
    right = {o: e.model_copy(update={"stated": e.labels}) for o, e in other.objects.items()}
    assert of(list(check_labels(Catalogue(language=other.language, objects=right))), "stated label") == []


def test_a_part_that_lacks_a_class(other: Catalogue) -> None:
    same = relabelled(other, ratings=((0, 0),) * 3, splits={"mine": Part.TEST})
    found = of(list(check_labels(same)), "classes of a part")
    assert [f.item for f in found] == [f"mine, test: {p}" for p in ("hardness", "roughness", "bumpiness")]
    assert found[0].measured == "no moderately hard or hard"


def test_a_name_that_is_nearly_in_the_catalogue(catalogue: Catalogue) -> None:
    found = list(similar_names(["cotton_bal", "yoyo", "hairbrush_handles"], catalogue))
    assert [(f.item, f.expected, f.severity) for f in found] == [
        ("cotton_bal", "cotton_ball?", WARNING),
        ("hairbrush_handles", "hairbrush_handle?", WARNING),
    ]


# Leakage


@pytest.mark.usefixtures("quick")
def test_a_clean_split_leaks_nothing(other: Catalogue) -> None:
    findings = leaks(probes(), GOOD_SPLIT, other)
    assert not [f for f in findings if f.severity is ERROR]
    assert [f.measured for f in of(findings, "object in two parts")] == ["0 of 8 objects"]
    assert [f.measured for f in of(findings, "same content")] == ["0 of 24 files"]
    assert [f.item for f in of(findings, "near-duplicate")] == ["all"]


@pytest.mark.usefixtures("quick")
def test_an_object_in_two_parts_is_an_error(other: Catalogue) -> None:
    errors = [f for f in leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.TEST}, other) if f.severity is ERROR]
    assert [(f.check, f.item, f.measured) for f in errors] == [("object in two parts", "rug", "test, validation")]
    spare = leaks(probes(), {**GOOD_SPLIT, "rug_1": Part.UNUSED}, other)
    assert not [f for f in spare if f.severity is ERROR], "an unused video is in no part"


@pytest.mark.usefixtures("quick")
def test_without_a_split_nothing_is_said_of_parts(other: Catalogue) -> None:
    assert of(leaks(probes(), {}, other), "session in two parts") == []
    assert not [f for f in leaks(probes(), {}, other) if f.severity is ERROR]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("twin", "severity"), [("potato_1", ERROR), ("rug_2", WARNING), ("cotton_ball_0", WARNING), ("lemon_0", WARNING)]
)
def test_equal_bytes(other: Catalogue, twin: str, severity: Severity) -> None:
    """In another part, of the same object, of another object in the same part, and of an unused one."""
    parts = {**GOOD_SPLIT, "lemon": Part.UNUSED}
    found = [f for f in of(leaks(probes(), parts, other, rug_0="x", **{twin: "x"}), "same content") if f.item != "all"]
    assert [f.severity for f in found] == [severity]
    assert {found[0].item, found[0].measured.split(" with ")[1].split(",")[0]} == {"rug_0.mov", f"{twin}.mov"}


@pytest.mark.usefixtures("quick")
def test_an_unused_copy_does_not_hide_a_copy_in_two_parts(other: Catalogue) -> None:
    parts = {"baseball": Part.UNUSED, "cotton_ball": Part.TRAIN, "pillow": Part.TEST}
    found = leaks(probes(), parts, other, baseball_0="x", cotton_ball_0="x", pillow_0="x")
    errors = [f for f in found if f.severity is ERROR]
    assert [(f.check, f.item) for f in errors] == [("same content", "pillow_0.mov")]
    assert "cotton_ball_0.mov" in errors[0].measured


@pytest.mark.usefixtures("quick")
def test_videos_without_any_contact_are_not_compared(other: Catalogue) -> None:
    still = [probe(p.video_id, contact=0.1, signature=(0.0,) * 432) for p in probes()]
    found = of(leaks(still, GOOD_SPLIT, other), "near-duplicate")
    assert [(f.item, f.severity) for f in found] == [("all", INFO)]


SCENE = ScenesConfig(frames=40, width=160, height=120)


def recorded(object_id: str, seed: int, sensor: int = 0) -> list[np.ndarray]:
    """A synthetic press of an object."""
    look = make_sensor(SCENE.width, SCENE.height, sensor)
    return list(render(recipe_of(object_id, PHYSICLEAR, 0), SCENE, look, seed))


def encode(path: Path, frames: Sequence[np.ndarray], codec: str = "mpeg4", bits: int = 400_000) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = bits
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
        container.mux(stream.encode(None))
    return path


def look_at(path: Path, video_id: str) -> tuple[Probe, Video]:
    found = scan(VideoFile(path, path.name, video_id.rpartition("_")[0], video_id), FramesConfig(size=16))
    assert isinstance(found, Scan)
    return found.probe, found.video


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
    copy = look_at(encode(tmp_path / "potato_0.mp4", change(frames)), "potato_0")
    twice = look_at(encode(tmp_path / "baseball_1.mp4", change(frames)), "baseball_1")
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


@pytest.mark.usefixtures("quick")
def test_a_session_in_training_and_test_is_a_warning(other: Catalogue) -> None:
    def named(session: dict[str, str]) -> list[tuple[str, str, Severity]]:
        made = [probe(p.video_id, session=session.get(p.object_id, "monday")) for p in probes()]
        return [(f.item, f.measured, f.severity) for f in of(leaks(made, parts, other), "session in two parts")]

    parts = dict.fromkeys(OBJECTS[:5], Part.TRAIN) | {"millet": Part.VALIDATION, "lemon": Part.TEST}
    assert named({}) == [("monday", "15 train, 3 validation, 3 test", WARNING)]
    assert named({"lemon": "tuesday"}) == []
    assert named({"lemon": "tuesday", "orange": "tuesday"}) == [], "an unused video shares nothing"
    assert named({"lemon": "tuesday", "rug": "tuesday"}) == [("tuesday", "3 train, 3 test", WARNING)]


@pytest.mark.usefixtures("quick")
def test_what_a_session_holds(other: Catalogue) -> None:
    made = [probe(p.video_id, session="a" if p.object_id == "rug" else "b", brightness=80.0) for p in probes()]
    first, second = of(leaks(made, {}, other), "session")
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


def test_what_cannot_be_predicted_is_undefined(other: Catalogue) -> None:
    alike = "undefined: too few objects, classes or sessions"
    few = [f for f in leaks(probes(2, OBJECTS[:4]), {}, other) if f.check.startswith("predicted")]
    assert [(f.measured, f.severity) for f in few] == [(alike, INFO)] * 6
    one_class = relabelled(other, ratings=((0, 0), (1, 1), (2, 2)))
    same = [f for f in leaks(probes(), {}, one_class) if f.check.startswith("predicted")]
    assert [(f.measured, f.severity) for f in same] == [(alike, INFO)] * 6


# The whole audit


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A folder with a file of every kind that can be wrong beside some that are right."""
    folder = tmp_path / "videos with é"
    for seed, name in enumerate(("baseball_0", "potato_0", "rug_0", "rug_1", "lemon_0")):
        write_video(folder / f"{name}.avi", moving_square(16, seed))
    good = (folder / "rug_0.avi").read_bytes()
    (folder / "rug_2.avi").write_bytes(b"")
    (folder / "rug_3.mov").write_bytes(b"not a video at all " * 400)
    (folder / "rug_4.avi").write_bytes(good[:300])
    (folder / "rug_5.avi").write_bytes(good[: len(good) * 2 // 3])
    (folder / "rug_6.avi").write_bytes(good)
    (folder / "rug_7.mkv").symlink_to(folder / "nowhere.mkv")
    (folder / "rug_8.mov").mkdir()
    (folder / "rug_01.avi").write_bytes((folder / "rug_1.avi").read_bytes())
    (folder / "nameless.avi").write_bytes(good)
    (folder / "cotton_bal_0.avi").write_bytes(good)
    (folder / "pillow_0.mp4").write_bytes(os.urandom(500))
    write_video(folder / "sub" / "millet_0.avi", moving_square(1, 9))
    (folder / "sub" / "orange_0.avi").write_bytes(good)
    (folder / "notes.txt").write_text("no video")
    return folder


@pytest.mark.parametrize("split", ["", "paper", "kfold", "development", "nonsense"])
def test_every_broken_file_is_found_and_raises_nothing(broken: Path, catalogue: Catalogue, split: str) -> None:
    findings = audit_folder(broken, catalogue, SplitConfig(name=split) if split else None)
    severities = [f.severity for f in findings]
    assert severities == sorted(severities, key=[ERROR, WARNING, INFO].index)
    errors = {(f.check, f.item) for f in findings if f.severity is ERROR}
    assert errors >= {
        *(("decodes", n) for n in ("rug_2.avi", "rug_3.mov", "rug_4.avi", "rug_7.mkv", "pillow_0.mp4")),
        *(("name", n) for n in ("nameless.avi", "rug_01.avi")),
    }
    warned = {(f.check, f.item) for f in findings if f.severity is WARNING}
    assert ("spelling", "cotton_bal") in warned
    assert ("frames that decode", "rug_5.avi") in warned
    assert {"rug_6.avi", "sub/orange_0.avi"} & {f.item for f in of(findings, "same content")}
    assert (("split", split) in errors) == (split in ("development", "nonsense"))
    named = {(f.check, f.item) for f in check_folder(broken, catalogue)}
    assert {e for e in errors if e[0] in ("name", "decodes")} <= named


def test_a_copy_in_two_parts_of_real_files_is_an_error(tmp_path: Path, catalogue: Catalogue) -> None:
    trained, tested = (
        next(o for o, e in sorted(catalogue.objects.items()) if e.splits["paper"] == part)
        for part in (Part.TRAIN, Part.TEST)
    )
    source = write_video(tmp_path / f"{trained}_0.avi", moving_square(12))
    (tmp_path / f"{tested}_0.avi").write_bytes(source.read_bytes())
    with_split = audit_folder(tmp_path, catalogue, SplitConfig(name="paper"))
    assert [f.check for f in with_split if f.severity is ERROR] == ["same content"]
    without = audit_folder(tmp_path, catalogue)
    assert [f.severity for f in of(without, "same content")] == [WARNING, INFO]


def test_sessions_of_a_list_are_taken_as_they_are_named(tmp_path: Path, catalogue: Catalogue) -> None:
    listed = [("x.avi", "baseball", "monday"), ("y.avi", "potato", "tuesday"), ("z.avi", "bath_towel", "monday")]
    for seed, (name, _, _) in enumerate(listed):
        write_video(tmp_path / name, moving_square(12, seed))
    lines = ["file,object_id,session", *(",".join(line) for line in listed)]
    (tmp_path / "videos.csv").write_text("\n".join(lines) + "\n")
    findings = audit_folder(tmp_path, catalogue, SplitConfig(name="paper"))
    assert [f.item for f in of(findings, "session")] == ["monday", "tuesday"]
    shared = of(findings, "session in two parts")
    assert [(f.item, f.measured, f.severity) for f in shared] == [("monday", "1 train, 1 test", WARNING)]


@pytest.mark.parametrize("make", [lambda folder: folder.mkdir(), lambda folder: None])
def test_no_folder_or_an_empty_one_is_an_error_beside_the_labels(
    tmp_path: Path, catalogue: Catalogue, make: object
) -> None:
    assert callable(make)
    make(tmp_path / "videos")
    findings = audit_folder(tmp_path / "videos", catalogue, SplitConfig(name="paper"))
    assert [f.check for f in findings if f.severity is ERROR] == ["name"]
    assert of(findings, "stated label"), "labels need no video"
    assert [f.severity for f in check_folder(tmp_path / "videos", catalogue)] == [ERROR]


def test_videos_without_motion_do_not_stop_the_audit(tmp_path: Path, catalogue: Catalogue) -> None:
    for name, shade in (("rug_0", 90), ("potato_0", 91), ("lemon_0", 92)):
        write_video(tmp_path / f"{name}.avi", [np.full((36, 48, 3), shade, np.uint8)] * 8)
    findings = audit_folder(tmp_path, catalogue, SplitConfig(name="paper"))
    assert not [f for f in findings if f.severity is ERROR]
    assert len([f for f in of(findings, "contact") if f.severity is WARNING]) == 3


def pressed(kind: str) -> list[np.ndarray]:
    """Twenty-four frames in which something textured is pressed against a plain sensor at some time."""
    ground = np.full((60, 80, 3), 100, np.uint8)
    rng = np.random.default_rng(3)
    grain = cv2.GaussianBlur(rng.normal(size=(60, 80)), (0, 0), 1.2)
    grain = 60 * grain / np.abs(grain).max()
    times = {"middle": range(8, 18), "end": range(8, 24), "start": range(14), "never": range(0)}[kind]
    noise = rng.normal(0, 6, (24, 60, 80, 3))
    return [
        np.clip(ground + noise[t] + (grain[..., None] if t in times else 0), 0, 255).astype(np.uint8) for t in range(24)
    ]


def test_real_files_show_when_they_are_touched(tmp_path: Path, catalogue: Catalogue) -> None:
    for number in range(4):
        write_video(tmp_path / f"pillow_{number}.avi", pressed("middle"))
    for name, kind in (("rug_0", "never"), ("rug_1", "end"), ("rug_2", "start")):
        write_video(tmp_path / f"{name}.avi", pressed(kind))
    found = {(f.check, f.item) for f in check_folder(tmp_path, catalogue) if f.check.startswith("contact")}
    assert found == {
        ("contact", "all"),
        ("contact", "rug_0.avi"),
        ("contact at the end", "rug_1.avi"),
        ("contact at the start", "rug_2.avi"),
    }


def test_real_files_of_other_sizes_lengths_and_light(tmp_path: Path, catalogue: Catalogue) -> None:
    for number in range(6):
        write_video(tmp_path / f"pillow_{number}.avi", pressed("middle"))
    write_video(tmp_path / "rug_0.avi", [f // 3 for f in pressed("middle")])
    write_video(tmp_path / "rug_1.avi", pressed("middle")[:10])
    write_video(tmp_path / "rug_2.avi", [cv2.resize(f, (160, 120)) for f in pressed("middle")])
    frames = pressed("middle")
    write_video(tmp_path / "rug_3.avi", [*frames[:12], *(f + np.uint8(40) for f in frames[12:])])
    write_video(tmp_path / "rug_4.mkv", pressed("middle"))
    write_video(tmp_path / "rug_5.avi", [np.where(np.arange(80)[:, None] < 20, 255, f) for f in frames])
    found = {(f.check, f.item) for f in odd(check_folder(tmp_path, catalogue)) if f.item not in ("all",)}
    assert found >= {
        ("brightness", "rug_0.avi"),
        ("length", "rug_1.avi"),
        ("resolution", "160x120"),
        ("brightness", "rug_3.avi"),
        ("saturation", "rug_5.avi"),
    }
    assert not {item for check, item in found if check == "frames that decode"}, "Matroska promises no number of frames"


def test_the_first_error_is_one_line() -> None:
    def error(item: str) -> Finding:
        return Finding(check="same content", item=item, measured="equal bytes with x", severity=ERROR)

    mild = Finding(check="length", item="y", measured="3 frames", severity=WARNING)
    stop_on_errors([mild], Path("data/audit/audit.csv"))
    with pytest.raises(UserError) as one:
        stop_on_errors([mild, error("a")], Path("data/audit/audit.csv"))
    assert str(one.value) == "same content: a: equal bytes with x; all findings stand in data/audit/audit.csv"
    with pytest.raises(UserError, match=r"^same content: a: .*2 more.*audit\.csv$") as several:
        stop_on_errors([error("a"), error("b"), error("c")], Path("data/audit/audit.csv"))
    assert "\n" not in str(several.value)
    assert summary([mild, error("a"), error("b")]) == {"errors": 2, "warnings": 1}
    assert [f.item for f in by_severity([mild, error("b"), error("a")])] == ["b", "a", "y"], "otherwise as found"


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the stage reads: parameters, measurements, a split, and files that only have to have names."""
    params = fake_params("data.source=videos", f"data.dir='{tmp_path / 'videos'}'")
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(params.model_dump(mode="json"), sort_keys=False))
    (tmp_path / "videos").mkdir()
    monkeypatch.chdir(tmp_path)
    fill(tmp_path, probes(2), GOOD_SPLIT)
    return tmp_path


def fill(root: Path, found: Sequence[Probe], parts: dict[str, Part]) -> None:
    for p in found:
        (root / "videos" / p.path).touch()
    write_table(root / "data" / "frames" / "probes.parquet", Probe, found)
    write_table(root / "data" / "videos.parquet", Video, [video(p) for p in found])
    write_table(root / "data" / "splits.parquet", Assignment, assigned(found, parts))


def run_stage() -> None:
    runpy.run_path(str(ROOT / "stages" / "audit.py"), run_name="__main__")


@pytest.mark.usefixtures("quick")
def test_the_gate_has_the_same_bytes_whatever_the_warnings(workplace: Path) -> None:
    run_stage()
    gate, table = workplace / "data" / "audit" / "passed", workplace / "data" / "audit" / "audit.csv"
    before, findings = gate.read_bytes(), read_csv(table, Finding)
    odd_ones = [probe(p.video_id, contact=0.1) if p.object_id == "rug" else p for p in probes(2)]
    fill(workplace, odd_ones, GOOD_SPLIT)
    run_stage()
    assert gate.read_bytes() == before
    assert len(odd(read_csv(table, Finding))) == len(odd(findings)) + 2
    metrics = (workplace / "data" / "metrics" / "audit.json").read_text()
    assert yaml.safe_load(metrics) == {"errors": 0, "warnings": len(odd(findings)) + 2}


def test_an_error_stops_the_chain_in_one_line(workplace: Path) -> None:
    fill(workplace, probes(2), {**GOOD_SPLIT, "rug_1": Part.TEST, "baseball_0": Part.TEST})
    done = subprocess.run(
        [sys.executable, ROOT / "stages" / "audit.py"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "audit: object in two parts: baseball: test, train (and 1 more); all findings stand in data/audit/audit.csv"
    ]
    assert not (workplace / "data" / "audit" / "passed").exists()
    assert not (workplace / "data" / "metrics").exists()
    with (workplace / "data" / "audit" / "audit.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert [line["item"] for line in lines if line["severity"] == "error"] == ["baseball", "rug"]


@pytest.mark.usefixtures("quick")
def test_the_chains_audit_and_the_folders_agree(tmp_path: Path, catalogue: Catalogue) -> None:
    names = ("baseball", "potato", "rug")
    for seed, name in enumerate(names):
        write_video(tmp_path / f"{name}_0.avi", moving_square(20, seed))
    both = [look_at(tmp_path / f"{n}_0.avi", f"{n}_0") for n in names]
    parts = assigned([p for p, _ in both], {o: catalogue.objects[o].splits["paper"] for o in names})
    chained = audit_chain(tmp_path, [p for p, _ in both], [v for _, v in both], parts, catalogue)
    assert chained == audit_folder(tmp_path, catalogue, SplitConfig(name="paper"))


def test_findings_survive_the_csv(tmp_path: Path) -> None:
    findings = [Finding(check="a, b", item='c "d"', measured="e\tf|g", expected="", severity=WARNING)]
    write_csv(tmp_path / "audit.csv", Finding, findings)
    assert (tmp_path / "audit.csv").read_text().splitlines()[0] == "check,item,measured,expected,severity"
    assert read_csv(tmp_path / "audit.csv", Finding) == findings


# The public videos


@pytest.fixture(scope="module")
def public(real_data: Path, catalogue: Catalogue) -> list[Finding]:
    return audit_folder(real_data, catalogue, SplitConfig(name="development"))


@pytest.mark.real
def test_the_public_videos_decode_and_none_is_a_copy(public: list[Finding]) -> None:
    assert [f for f in public if f.severity is ERROR] == []
    assert [f.measured for f in of(public, "frames that decode")] == ["0 of 370 videos differ from their header"]
    assert [f.item for f in of(public, "same content")] == ["all"]
    near = [f for f in of(public, "near-duplicate") if f.item != "all"]
    assert odd(near) == []
    assert all("the same object" in f.measured for f in near)


@pytest.mark.real
def test_odd_public_videos_are_found_without_being_told(public: list[Finding]) -> None:
    short = {f.item: f.measured for f in of(odd(public), "length")}
    assert short["hairbrush_bristles_side_4.mov"] == "3 frames"
    assert short["tv_remote_back_3.mov"] == "7 frames"
    assert set(short) == {"all", "hairbrush_bristles_side_4.mov", "tv_remote_back_3.mov"}
    assert [(f.item, f.measured) for f in of(odd(public), "frame rate")] == [("10 frames/s", "66 videos")]
    still = {f.item for f in of(public, "contact at the end")}
    assert still >= {"scissor_handle_1.mov", "gauze_pad_0.mov"}
    assert len(still) <= 15
    unclear = {f.item.rpartition("_")[0] for f in of(odd(public), "contact")}
    assert unclear >= {"cotton_ball", "sponge_soft"}
    assert len(of(odd(public), "contact")) <= 25


@pytest.mark.real
def test_public_sessions_stand_in_two_parts_and_tell_the_hardness(public: list[Finding]) -> None:
    shared = of(public, "session in two parts")
    assert shared
    assert {f.severity for f in shared} == {WARNING}
    assert len(of(public, "session")) >= len(shared)
    hardness = of(public, "predicted from the no-contact reference alone")[0]
    assert hardness.item == "hardness"
    assert hardness.severity is WARNING
    share, p = map(float, re.findall(r"[\d.]+", hardness.measured))
    mean, deviation = map(float, re.findall(r"\d+\.\d", hardness.expected))
    assert share > mean + deviation
    assert share == pytest.approx(52, abs=6)
    assert mean == pytest.approx(40, abs=4)
    assert p < leakage.ALPHA
