"""What the audit finds in the measurements of single videos and in the labels, and what it leaves in peace."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.records import Finding, Part, Probe
from pipeline.videos.audit.files import FOUND, by_rate, check_files
from pipeline.videos.audit.labels import check_labels
from pipeline.videos.audit.leakage import check_leakage, sessions
from pipeline.videos.catalogue import Catalogue
from tests.audit_records import ERROR, INFO, OBJECTS, OTHER, PHYSICLEAR, WARNING, leaks, odd, of, probe, probes
from tests.audit_records import relabelled as relabel


def with_one(**changes: object) -> list[Finding]:
    """Findings about flawless videos of which one is changed."""
    found = [p if p.video_id != "rug_1" else probe("rug_1", **changes) for p in probes()]
    return odd(check_files(found, OTHER))


def test_flawless_videos_no_videos_and_a_single_one_give_no_warning(catalogue: Catalogue) -> None:
    assert odd(check_files(probes(), OTHER)) == []
    assert list(check_files([], OTHER)) == []
    assert list(check_leakage([], [], OTHER)) == []
    alone = Catalogue(language=catalogue.language, objects={"rug": catalogue.objects["rug"]})
    assert odd(check_files([probe()], alone)) == odd(leaks([probe()], {}, alone)) == []


@pytest.mark.parametrize(
    ("changes", "check", "measured", "expected"),
    [
        ({"frames": 62, "header_frames": 62}, "length", "62 frames", "about 126, as others at 25 frames/s"),
        ({"header_frames": 130}, "frames that decode", "126", "130, by the header"),
        ({"brightness": 60.0}, "brightness", "60.0 of 255", "90.0 +- 1.0, as others at 25 frames/s"),
        ({"brightness": 97.0}, "brightness", "97.0 of 255", "90.0 +- 1.0, as others at 25 frames/s"),
        ({"brightness_step": 9.0}, "brightness", "a step of 9.0 of 255", "at most 4"),
        ({"saturated": 0.2}, "saturation", "20 % of values at 0 or 255", "at most 5 %"),
        ({"hdr": True}, "colours", "HDR, which looks flat beside other videos", "SDR; record or export it as such"),
        ({"rotation": 90}, "rotation", "90 degrees in the metadata, applied", "0"),
        ({"irregular": 2.0}, "frame rate", "varies by a factor of 2.0", "even"),
        ({"kept": 0}, "frames kept", "0", "5 or more, by frames.selection"),
        ({"contact": 0.4}, "contact", "not found: strength 0.40", "over 0.50"),
        ({"contact_end": 1.0}, "contact at the end", "still 1.00 of 1.40", "under 0.70"),
        (
            {"unsteady": 8},
            "light at the start",
            "not steady in the first 8 frames, which are left out",
            "steady",
        ),
        ({"unsteady": 126}, "light at the start", "never steady: contact may be light", "steady"),
        (
            {"starts_touching": True},
            "contact at the start",
            "touched from the first frame: the reference comes from the end",
            "untouched",
        ),
    ],
)
def test_one_odd_video_is_one_warning(changes: dict[str, object], check: str, measured: str, expected: str) -> None:
    assert with_one(**changes) == [
        Finding(check=check, item="rug_1.mov", measured=measured, expected=expected, severity=WARNING)
    ]


def test_just_within_the_limit_is_no_warning() -> None:
    """Among them a container that promises no number of frames, and one without time stamps."""
    for changes in (
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
    ):
        assert with_one(**changes) == [], changes


def test_mixed_frame_rates_and_sizes_name_the_rarer() -> None:
    found = [probe(p.video_id, fps=10.0, frames=50, header_frames=50) if p.object_id == "rug" else p for p in probes()]
    found[0] = probe(found[0].video_id, width=640, height=480)
    findings = list(check_files(found, OTHER))
    assert [(f.check, f.item, f.measured, f.expected) for f in odd(findings)] == [
        ("frame rate", "10 frames/s", "3 videos", "25 frames/s"),
        ("resolution", "640x480", "1 videos", "320x240"),
    ], "fifty frames at ten a second are not short: lengths are compared at one rate"
    assert ("frame rate", "25 frames/s", "21 videos") in [(f.check, f.item, f.measured) for f in findings]


def jittered(seed: int) -> list[Probe]:
    """Twelve videos of a camera at 30 frames a second whose time stamps jitter; one is dark and one is cut short."""
    rates = 30 * (1 + np.random.default_rng(seed).uniform(-0.012, 0.012, 12))
    found = [probe(f"{OBJECTS[i % 8]}_{i}", fps=rate, thumbnail=(90.0,) * 144) for i, rate in enumerate(rates)]
    found[3] = probe("potato_3", fps=rates[3], thumbnail=(90.0,) * 144, brightness=40.0)
    found[7] = probe("orange_7", fps=rates[7], thumbnail=(90.0,) * 144, frames=20, header_frames=20)
    return found


@pytest.mark.parametrize("seed", range(3))
def test_time_stamps_that_jitter_are_one_rate_and_hide_nothing(seed: int) -> None:
    findings = odd(check_files(jittered(seed), OTHER))
    assert {(f.check, f.item) for f in findings} == {("length", "orange_7.mov"), ("brightness", "potato_3.mov")}
    assert len(findings) == 2
    assert len(set(sessions(jittered(seed)))) == 1


def test_rates_that_cameras_have_stay_apart() -> None:
    """None is taken for its neighbour, among them what a container without a rate is given."""
    cameras = [0.0, 5.0, 10.0, 12.5, 15.0, 20.0, 24.0, 25.0, 29.97, 48.0, 50.0, 60.0, 90.0, 120.0]
    groups = by_rate([probe(f"rug_{i}", fps=rate) for i, rate in enumerate(cameras * 2)])
    assert list(groups) == cameras
    assert [len(group) for group in groups.values()] == [2] * len(cameras)


def test_brightness_is_judged_by_the_spread_at_the_same_rate() -> None:
    slow = [probe(p.video_id, fps=10.0, brightness=120.0) if p.object_id in ("rug", "millet") else p for p in probes()]
    spread = [probe(p.video_id, brightness=90.0 + 5 * (i % 5)) for i, p in enumerate(probes())]
    assert [of(odd(check_files(found, OTHER)), "brightness") for found in (slow, spread)] == [[], []]
    spread[3] = probe(spread[3].video_id, brightness=200.0)
    assert [f.item for f in of(odd(check_files(spread, OTHER)), "brightness")] == [spread[3].path]


def test_videos_an_object_and_objects_without() -> None:
    findings = list(check_files([*probes(2, OBJECTS[:5]), *probes(4, OBJECTS[5:7])], OTHER))
    assert [f.measured for f in of(findings, "videos per object")] == ["5 objects with 2, 2 objects with 4"]
    total, absent = of(findings, "videos")
    assert (total.measured, total.expected, total.severity) == ("18 videos of 7 objects", "", INFO)
    assert (absent.item, absent.measured, absent.severity) == ("orange", "no video", WARNING)


@settings(max_examples=30)
@given(st.lists(st.floats(0, 5), min_size=3, max_size=12), st.floats(1.1, 50))
def test_contact_is_relative_to_the_noise_of_the_data(strengths: list[float], louder: float) -> None:
    """All strengths times a factor: the same videos lack contact, however sensitive the camera is."""

    def named(factor: float) -> set[str]:
        found = [
            probe(f"rug_{i}", contact=factor * (0.01 + s), quiet=factor * 0.3, contact_end=0.0)
            for i, s in enumerate(strengths)
        ]
        return {f.item for f in of(odd(check_files(found, PHYSICLEAR)), "contact")}

    if min(abs(0.01 + s - FOUND * 0.3) for s in strengths) > 1e-6:
        assert named(louder) == named(1.0)


# Labels


def labels(catalogue: Catalogue, check: str) -> list[Finding]:
    return of(check_labels(catalogue), check)


def test_counts_and_agreement_follow_from_the_ratings(catalogue: Catalogue) -> None:
    counts = labels(catalogue, "objects of a class")
    assert [int(f.measured) for f in counts] == [11, 31, 32, 28, 23, 23, 25, 38, 11]
    assert counts[1].item == "hardness: moderately hard"
    agreement = labels(catalogue, "agreement, ICC(3,k)")
    assert [(f.item, f.measured.split()[0]) for f in agreement] == [
        *(("hardness", "0.893"), ("roughness", "0.979"), ("bumpiness", "0.773")),
    ]
    for f in agreement:
        value, low, high = map(float, re.findall(r"0\.\d{3}", f.measured))
        assert low < value < high
    assert {(f.expected, f.severity) for f in (*counts, *agreement)} == {("", INFO)}, (
        "no published figure is known here"
    )


def test_the_catalogues_stated_labels_descriptions_and_splits(catalogue: Catalogue) -> None:
    assert [(f.item, f.measured, f.expected, f.severity) for f in labels(catalogue, "stated label")] == [
        ("gauze_pad: hardness", "hard (mean rating 1.67)", "moderately hard", WARNING)
    ]
    differing = {f.item for f in labels(catalogue, "splits differ")}
    assert differing == {"bubble_wrap", "clothes_peg", "eraser", "ice_block", "lemon", "orange"}
    described = [f for f in labels(catalogue, "description") if f.item.endswith(": roughness")]
    assert {f.item.removesuffix(": roughness") for f in described} == {
        *("rubber_bands", "clothes_peg", "aluminium_foil", "controller_keypad"),
        *("controller_buttons", "nylon_shirt", "cotton_ball", "pen_pad"),
    }
    for f in described:
        assert f.measured.startswith("rated slightly rough (")
        assert (f.expected, f.severity) == ("described as smooth", WARNING)
    assert not any(f.severity is ERROR for f in check_labels(catalogue))


def test_agreement_is_undefined_without_variance_with_one_rating_or_unequal_numbers() -> None:
    for ratings in (((1,), (0,), (2,)), ((1, 1, 1),) * 3):
        found = labels(relabel(OTHER, ratings=ratings), "agreement, ICC(3,k)")
        assert [(f.measured, f.severity) for f in found] == [("undefined: one rating, or no variance", INFO)] * 3
    rug = OTHER.objects["rug"]
    fewer = rug.model_copy(update={"ratings": (rug.ratings[0][:2], *rug.ratings[1:])})
    other = Catalogue(language=OTHER.language, objects={**OTHER.objects, "rug": fewer})
    first, *rest = labels(other, "agreement, ICC(3,k)")
    assert first.measured == "undefined: objects have different numbers of ratings"
    assert all(re.match(r"-?\d\.\d{3} \(", f.measured) for f in rest)


def test_classes_that_nobody_chose_and_stated_labels() -> None:
    same = relabel(OTHER, ratings=((0, 0),) * 3, splits={"mine": Part.TEST})
    assert [f.severity for f in labels(same, "objects of a class")] == [INFO, WARNING, WARNING] * 3
    lacking = labels(same, "classes of a part")
    assert [f.item for f in lacking] == [f"mine, test: {p}" for p in ("hardness", "roughness", "bumpiness")]
    assert lacking[0].measured == "no moderately hard or hard"
    right = {o: e.model_copy(update={"stated": e.labels}) for o, e in OTHER.objects.items()}
    for silent in (relabel(OTHER, stated=(None,) * 3), Catalogue(language=OTHER.language, objects=right)):
        assert labels(silent, "stated label") == []
