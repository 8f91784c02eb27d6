"""What the audit finds in the measurements of single videos and in the labels, and what it leaves in peace."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from pingouin import intraclass_corr
from scipy.special import betaincinv

from pipeline.core.records import Part
from pipeline.videos.audit.files import by_rate, check_files
from pipeline.videos.audit.labels import check_labels, icc3k
from pipeline.videos.audit.leakage import check_leakage, sessions
from pipeline.videos.catalogue import Catalogue
from tests import audit_records as made
from tests.audit_records import ERROR, INFO, OBJECTS, OTHER, WARNING, leaks, odd, of, probe, probes


def test_flawless_videos_no_videos_and_a_single_one_give_no_warning() -> None:
    assert odd(check_files(probes(), OTHER)) == []
    assert [*check_files([], OTHER), *check_leakage([], [], OTHER)] == []
    alone = Catalogue(language=OTHER.language, objects={"rug": OTHER.objects["rug"]})
    assert odd(check_files([probe()], alone)) == odd(leaks([probe()], {}, alone)) == []


@pytest.mark.parametrize(
    ("check", "beyond", "within"),
    [
        ("length", {"frames": 62, "header_frames": 62}, {"frames": 63, "header_frames": 63}),
        ("frames that decode", {"header_frames": 130}, {"header_frames": 0}),
        ("brightness", {"brightness": 83.0}, {"brightness": 84.0}),
        ("brightness", {"brightness_step": 4.1}, {"brightness_step": 4.0}),
        ("saturation", {"saturated": 0.06}, {"saturated": 0.05}),
        ("colours", {"hdr": True}, {}),
        ("rotation", {"rotation": 90}, {}),
        ("frame rate", {"irregular": 1.6}, {"irregular": 1.5}),
        ("frames kept", {"kept": 0}, {"kept": 1}),
        ("contact", {"contact": 0.49}, {"contact": 0.51}),
        ("contact at the end", {"contact_end": 0.71}, {"contact_end": 0.7}),
        ("contact at the end", {"contact": 0.6, "contact_end": 0.51}, {"contact": 0.6, "contact_end": 0.5}),
        ("light at the start", {"unsteady": 8}, {}),
        ("contact at the start", {"starts_touching": True}, {}),
    ],
)
def test_one_odd_video_is_one_warning(check: str, beyond: dict[str, object], within: dict[str, object]) -> None:
    """And within the limit none: containers may promise no number of frames (0)."""
    for changes, expected in ((beyond, [(check, "rug_1.mov", WARNING)]), (within, [])):
        found = [p if p.video_id != "rug_1" else probe("rug_1", **changes) for p in probes()]
        assert [(f.check, f.item, f.severity) for f in odd(check_files(found, OTHER))] == expected


def test_mixed_frame_rates_and_sizes_name_the_rarer() -> None:
    """Fifty frames at ten a second are not short: lengths are compared at one rate."""
    found = [probe(p.video_id, fps=10.0, frames=50, header_frames=50) if p.object_id == "rug" else p for p in probes()]
    found[0] = probe(found[0].video_id, width=640, height=480)
    assert [(f.check, f.item, f.measured, f.expected) for f in odd(check_files(found, OTHER))] == [
        ("frame rate", "10 frames/s", "3 videos", "25 frames/s"),
        ("resolution", "640x480", "1 videos", "320x240"),
    ]


@pytest.mark.parametrize("seed", range(3))
def test_time_stamps_that_jitter_are_one_rate_and_hide_nothing(seed: int) -> None:
    """Twelve videos of a camera at 30 frames a second whose time stamps jitter; one is dark and one is cut short."""
    rates = 30 * (1 + np.random.default_rng(seed).uniform(-0.012, 0.012, 12))
    names = [f"{OBJECTS[i % 8]}_{i}" for i in range(12)]
    changes = {"potato_3": {"brightness": 40.0}, "orange_7": {"frames": 20, "header_frames": 20}}
    found = [
        probe(name, fps=rate, thumbnail=(90.0,) * 144, **changes.get(name, {}))
        for name, rate in zip(names, rates, strict=True)
    ]
    findings = sorted((f.check, f.item) for f in odd(check_files(found, OTHER)))
    assert findings == [("brightness", "potato_3.mov"), ("length", "orange_7.mov")]
    assert len(set(sessions(found))) == 1


def test_rates_that_cameras_have_stay_apart() -> None:
    """None is taken for its neighbour, among them what a container without a rate is given."""
    cameras = [0.0, 5.0, 10.0, 12.5, 15.0, 20.0, 24.0, 25.0, 29.97, 48.0, 50.0, 60.0, 90.0, 120.0]
    groups = by_rate([probe(f"rug_{i}", fps=rate) for i, rate in enumerate(cameras * 2)])
    assert {rate: len(group) for rate, group in groups.items()} == dict.fromkeys(cameras, 2)


def test_brightness_is_judged_by_the_spread_at_the_same_rate() -> None:
    slow = [probe(p.video_id, fps=10.0, brightness=120.0) if p.object_id in ("rug", "millet") else p for p in probes()]
    spread = [probe(p.video_id, brightness=90.0 + 5 * (i % 5)) for i, p in enumerate(probes())]
    assert [of(odd(check_files(found, OTHER)), "brightness") for found in (slow, spread)] == [[], []]
    spread[3] = probe(spread[3].video_id, brightness=200.0)
    assert [f.item for f in of(odd(check_files(spread, OTHER)), "brightness")] == [spread[3].path]


def test_videos_an_object_and_objects_without() -> None:
    findings = list(check_files([*probes(2, OBJECTS[:5]), *probes(4, OBJECTS[5:7])], OTHER))
    assert [f.measured for f in of(findings, "videos per object")] == ["5 objects with 2, 2 objects with 4"]
    assert [(f.item, f.measured, f.severity) for f in of(findings, "videos")] == [
        ("all", "18 videos of 7 objects", INFO),
        ("orange", "no video", WARNING),
    ]


SHROUT_FLEISS = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
"""The example of Shrout and Fleiss 1979: six targets, four judges."""
RNG = np.random.default_rng(0)
DRAWN = [(RNG.normal(size=(n, 1)) + RNG.normal(size=(n, k))).tolist() for n, k in ((3, 2), (8, 4), (30, 3))]


@pytest.mark.parametrize("ratings", [SHROUT_FLEISS, *DRAWN])
def test_agreement_is_pingouins(ratings: list[list[float]]) -> None:
    """Pingouin rounds the interval to two places, so its ends follow from pingouin's F (Shrout and Fleiss 1979)."""
    rows = [(i, j, value) for i, row in enumerate(ratings) for j, value in enumerate(row)]
    table = intraclass_corr(pd.DataFrame(rows, columns=["target", "rater", "value"]), "target", "rater", "value")
    expected = table[table["Type"].isin(("ICC3k", "ICC(C,k)"))].iloc[0]
    free, error = len(ratings) - 1, (len(ratings) - 1) * (len(ratings[0]) - 1)
    # The F distribution's quantile, by the inverse of the incomplete beta function.
    beta = betaincinv(free / 2, error / 2, np.array([0.975, 0.025]))
    low, high = 1 - error * beta / (free * (1 - beta)) / float(expected["F"])
    assert icc3k(ratings) == pytest.approx((float(expected["ICC"]), low, high), abs=1e-9)


def test_the_catalogues_labels_agreement_descriptions_and_splits(catalogue: Catalogue) -> None:
    findings = list(check_labels(catalogue))
    assert not any(f.severity is ERROR for f in findings)
    assert [int(f.measured) for f in of(findings, "objects of a class")] == [11, 31, 32, 28, 23, 23, 25, 38, 11]
    agreement = [(f.item, f.measured.split()[0]) for f in of(findings, "agreement, ICC(3,k)")]
    assert agreement == [("hardness", "0.893"), ("roughness", "0.979"), ("bumpiness", "0.773")]
    assert [(f.item, f.measured, f.expected, f.severity) for f in of(findings, "stated label")] == [
        ("gauze_pad: hardness", "hard (mean rating 1.67)", "moderately hard", WARNING)
    ]
    differing = {f.item for f in of(findings, "splits differ")}
    assert differing == {"bubble_wrap", "clothes_peg", "eraser", "ice_block", "lemon", "orange"}
    described = [f for f in of(findings, "description") if f.item.endswith(": roughness")]
    assert {(f.expected, f.severity) for f in described} == {("described as smooth", WARNING)}
    assert {f.item.removesuffix(": roughness") for f in described} == {
        *("rubber_bands", "clothes_peg", "aluminium_foil", "controller_keypad"),
        *("controller_buttons", "nylon_shirt", "cotton_ball", "pen_pad"),
    }


@pytest.mark.parametrize(
    ("text", "told"),
    [("It is soft.", 1), ("It is hard.", 0), ("It is soft on a hard core.", 0), ("It is red.", 0), ("", 0)],
)
def test_a_description_is_named_that_has_another_class_alone(text: str, told: int) -> None:
    rug = Catalogue(language=OTHER.language, objects={"rug": OTHER.objects["rug"]})
    found = check_labels(made.relabelled(rug, ratings=((2,), (0,), (0,)), description=text))
    assert [f.item for f in of(found, "description")] == ["rug: hardness"] * told


def test_agreement_is_undefined_without_variance_with_one_rating_or_unequal_numbers() -> None:
    rug = OTHER.objects["rug"]
    fewer = rug.model_copy(update={"ratings": (rug.ratings[0][:2], *rug.ratings[1:])})
    for catalogue, undefined in (
        (made.relabelled(OTHER, ratings=((1,), (0,), (2,))), [True] * 3),
        (made.relabelled(OTHER, ratings=((1, 1, 1),) * 3), [True] * 3),
        (Catalogue(language=OTHER.language, objects={**OTHER.objects, "rug": fewer}), [True, False, False]),
    ):
        found = of(check_labels(catalogue), "agreement, ICC(3,k)")
        assert [f.measured.startswith("undefined") for f in found] == undefined


def test_classes_that_nobody_chose_and_stated_labels() -> None:
    found = list(check_labels(made.relabelled(OTHER, ratings=((0, 0),) * 3, splits={"mine": Part.TEST})))
    assert [f.severity for f in of(found, "objects of a class")] == [INFO, WARNING, WARNING] * 3
    lacking = of(found, "classes of a part")
    assert [f.item for f in lacking] == [f"mine, test: {p}" for p in ("hardness", "roughness", "bumpiness")]
    assert lacking[0].measured == "no moderately hard or hard"
    right = {o: e.model_copy(update={"stated": e.labels}) for o, e in OTHER.objects.items()}
    for silent in (made.relabelled(OTHER, stated=(None,) * 3), Catalogue(language=OTHER.language, objects=right)):
        assert of(check_labels(silent), "stated label") == []
