"""What the audit finds in the measurements of single videos, and what it leaves in peace."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.records import Finding
from pipeline.videos.audit.files import FOUND, check_files
from pipeline.videos.audit.leakage import check_leakage, evidence
from pipeline.videos.catalogue import Catalogue
from tests.audit_records import INFO, OBJECTS, OTHER, PHYSICLEAR, WARNING, leaks, odd, of, probe, probes


def test_flawless_videos_give_no_warning() -> None:
    assert odd(check_files(probes(), OTHER)) == []


def test_nothing_to_check() -> None:
    assert list(check_files([], OTHER)) == []
    assert list(check_leakage(evidence([], [], []), OTHER)) == []


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
def test_one_odd_video_is_one_warning(changes: dict[str, object], check: str, measured: str, expected: str) -> None:
    found = [p if p.video_id != "rug_1" else probe("rug_1", **changes) for p in probes()]
    assert odd(check_files(found, OTHER)) == [
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
def test_just_within_the_limit_is_no_warning(changes: dict[str, object]) -> None:
    """Among them a container that promises no number of frames, and one without time stamps."""
    found = [p if p.video_id != "rug_1" else probe("rug_1", **changes) for p in probes()]
    assert odd(check_files(found, OTHER)) == []


def test_mixed_frame_rates_and_sizes_name_the_rarer() -> None:
    found = [probe(p.video_id, fps=10.0, frames=50, header_frames=50) if p.object_id == "rug" else p for p in probes()]
    found[0] = probe(found[0].video_id, width=640, height=480)
    warnings = odd(check_files(found, OTHER))
    assert [(f.check, f.item, f.measured, f.expected) for f in warnings] == [
        ("frame rate", "10 frames/s", "3 videos", "25 frames/s"),
        ("resolution", "640x480", "1 videos", "320x240"),
    ], "fifty frames at ten a second are not short: lengths are compared at one rate"
    assert ("frame rate", "25 frames/s", "21 videos") in [
        (f.check, f.item, f.measured) for f in check_files(found, OTHER)
    ]


def test_brightness_is_held_against_videos_of_the_same_rate() -> None:
    found = [probe(p.video_id, fps=10.0, brightness=120.0) if p.object_id in ("rug", "millet") else p for p in probes()]
    assert of(odd(check_files(found, OTHER)), "brightness") == []


def test_an_outlier_is_judged_by_the_usual_spread() -> None:
    found = [probe(p.video_id, brightness=90.0 + 5 * (i % 5)) for i, p in enumerate(probes())]
    assert of(odd(check_files(found, OTHER)), "brightness") == []
    found[3] = probe(found[3].video_id, brightness=200.0)
    assert [f.item for f in of(odd(check_files(found, OTHER)), "brightness")] == [found[3].path]


def test_videos_an_object_and_objects_without() -> None:
    found = [*probes(2, OBJECTS[:5]), *probes(4, OBJECTS[5:7])]
    findings = list(check_files(found, OTHER))
    assert [f.measured for f in of(findings, "videos per object")] == ["5 objects with 2, 2 objects with 4"]
    total, absent = of(findings, "videos")
    assert (total.measured, total.expected, total.severity) == ("18 videos of 7 objects", "", INFO)
    assert (absent.item, absent.measured, absent.severity) == ("orange", "no video", WARNING)


def test_the_papers_lengths_stand_beside_its_own_data_only(catalogue: Catalogue) -> None:
    theirs = [f for f in check_files(probes(), catalogue) if f.item == "all" and f.severity is WARNING]
    assert [(f.check, f.expected) for f in theirs] == [
        ("videos", "408 videos of 74 objects"),
        ("length", "50 to 126 frames, mean 112.3"),
    ]
    assert {f.expected for f in check_files(probes(), OTHER) if f.check in ("videos", "length")} == {""}


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
