"""The audit of single videos, of labels, of a folder and of the chain, on files good and bad, and on public videos."""

import json
import runpy
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pingouin import intraclass_corr
from scipy.special import betaincinv

from pipeline.config import SplitConfig
from pipeline.core.io import read_csv, write_table
from pipeline.core.records import Part
from pipeline.scales import write_params
from pipeline.videos.audit import leakage
from pipeline.videos.audit.files import by_rate, check_files
from pipeline.videos.audit.labels import check_labels, icc3k
from pipeline.videos.audit.leakage import check_leakage, sessions
from pipeline.videos.audit.run import audit_chain, audit_folder, check_folder
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Finding, Probe, Video
from tests import audit_records as made
from tests.audit_records import ERROR, GOOD_SPLIT, INFO, OBJECTS, OTHER, WARNING, assigned, odd, of, probe, probes
from tests.conftest import ROOT, moving_square, write_video
from tests.fake_run import fake_params

pytestmark = pytest.mark.usefixtures("few_permutations")


def test_every_broken_file_is_found_and_raises_nothing(tmp_path: Path, catalogue: Catalogue) -> None:
    folder = tmp_path / "videos with é"
    for seed, name in enumerate(("baseball_0", "potato_0", "rug_0", "rug_1", "sub/lemon_0")):
        write_video(folder / f"{name}.avi", moving_square(16, seed))
    good = (folder / "rug_0.avi").read_bytes()
    broken = {"rug_2.avi": b"", "rug_3.mov": b"not a video at all " * 400, "rug_5.avi": good[: len(good) * 2 // 3]}
    copies = dict.fromkeys(("rug_6.avi", "rug_01.avi", "nameless.avi", "cotton_bal_0.avi", "sub/orange_0.avi"), good)
    for name, content in (broken | copies).items():
        (folder / name).write_bytes(content)
    (folder / "rug_7.mkv").symlink_to(folder / "nowhere.mkv")
    (folder / "rug_8.mov").mkdir()
    write_video(folder / "sub" / "millet_0.avi", moving_square(1, 9))
    findings = audit_folder(folder, catalogue, SplitConfig(name="paper"))
    severities = [f.severity for f in findings]
    assert severities == sorted(severities, key=[ERROR, WARNING, INFO].index)
    errors = {(f.check, f.item) for f in findings if f.severity is ERROR}
    assert errors >= {
        *(("decodes", n) for n in ("rug_2.avi", "rug_3.mov", "rug_7.mkv")),
        *(("name", n) for n in ("nameless.avi", "rug_01.avi")),
    }
    warned = {(f.check, f.item) for f in findings if f.severity is WARNING}
    assert {("spelling", "cotton_bal"), ("frames that decode", "rug_5.avi")} <= warned
    assert {"rug_6.avi", "sub/orange_0.avi"} & {f.item for f in of(findings, "same content")}
    checked = {(f.check, f.item) for f in check_folder(folder, catalogue)}
    assert {e for e in errors if e[0] in ("name", "decodes")} <= checked


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the stage reads: parameters, measurements, a split, and files that only have to have names."""
    write_params(fake_params("data.source=videos", "data.dir=videos"), tmp_path / "params.yaml")
    (tmp_path / "videos").mkdir()
    monkeypatch.chdir(tmp_path)
    fill(tmp_path, probes(2), GOOD_SPLIT)
    return tmp_path


def fill(root: Path, found: Sequence[Probe], parts: dict[str, Part]) -> None:
    for p in found:
        (root / "videos" / p.path).touch()
    write_table(root / "data" / "frames" / "probes.parquet", Probe, found)
    write_table(root / "data" / "videos.parquet", Video, found)
    write_table(root / "data" / "splits" / "0.parquet", Assignment, assigned(found, parts))


def run_stage() -> None:
    runpy.run_path(str(ROOT / "stages" / "audit.py"), run_name="__main__")


def test_the_gate_has_the_same_bytes_whatever_the_warnings(workplace: Path) -> None:
    gate, table = workplace / "data" / "audit" / "passed", workplace / "data" / "audit" / "audit.csv"
    run_stage()
    before, warnings = gate.read_bytes(), len(odd(read_csv(table, Finding)))
    fill(workplace, [probe(p.video_id, contact=0.1) if p.object_id == "rug" else p for p in probes(2)], GOOD_SPLIT)
    run_stage()
    assert gate.read_bytes() == before
    assert len(odd(read_csv(table, Finding))) == warnings + 2
    metrics = json.loads((workplace / "runs" / "audit.json").read_text())["metrics"]
    assert metrics == {"errors": 0, "warnings": warnings + 2}


def test_an_error_stops_the_chain_in_one_line(workplace: Path) -> None:
    fill(workplace, probes(2), {**GOOD_SPLIT, "rug_1": Part.TEST, "baseball_0": Part.TEST})
    with pytest.raises(SystemExit, match=r"^audit: object in two parts: baseball: .*\(and 1 more\).*audit\.csv$"):
        run_stage()
    assert not (workplace / "data" / "audit" / "passed").exists()
    assert not (workplace / "runs" / "audit.json").exists()
    findings = read_csv(workplace / "data" / "audit" / "audit.csv", Finding)
    assert [f.item for f in findings if f.severity is ERROR] == ["baseball", "rug"]


def test_every_fold_is_audited(workplace: Path, catalogue: Catalogue) -> None:
    """Two equal files of different objects leak only where a fold parts them; what folds share is said once."""
    twins = {"baseball_0", "rug_0"}
    found = [p.model_copy(update={"sha256": "same"}) if p.video_id in twins else p for p in probes(2)]
    together = assigned(found, {**GOOD_SPLIT, "baseball": Part.TRAIN, "rug": Part.TRAIN})
    apart = assigned(found, {**GOOD_SPLIT, "baseball": Part.TRAIN, "rug": Part.TEST})
    one = audit_chain(workplace / "videos", found, [together], catalogue)
    both = audit_chain(workplace / "videos", found, [together, apart], catalogue)
    assert [f.severity for f in of(one, "same content")] == [WARNING, INFO]
    assert [f.severity for f in of(both, "same content")] == [ERROR, WARNING, INFO]
    assert set(one) <= set(both)
    assert len(set(both)) == len(both)
    few = [(f.item, f.measured.split(",")[0]) for f in of(both, "objects")]
    assert few == [("split 0", "4 objects to train on"), ("split 1", "3 objects to train on")]


@pytest.fixture(scope="module")
def public(real_data: Path, catalogue: Catalogue) -> list[Finding]:
    """Of the public videos, with the audit's own number of permutations: `few_permutations` begins after it."""
    return audit_folder(real_data, catalogue, SplitConfig(name="kfold"))


@pytest.mark.slow
@pytest.mark.real
def test_odd_public_videos_are_found_without_being_told(public: list[Finding]) -> None:
    assert [f for f in public if f.severity is ERROR] == []
    assert [f.measured for f in of(public, "frames that decode")] == ["0 of 370 videos differ from their header"]
    assert [f.item for f in of(public, "same content")] == ["all"]
    near = [f for f in of(public, "near-duplicate") if f.item != "all"]
    assert odd(near) == []
    assert all("the same object" in f.measured for f in near)
    short = {f.item: f.measured for f in of(odd(public), "length")}
    assert short == {"hairbrush_bristles_side_4.mov": "3 frames", "tv_remote_back_3.mov": "7 frames"}
    assert [(f.item, f.measured) for f in of(odd(public), "frame rate")] == [("10 frames/s", "66 videos")]
    still = {f.item for f in of(public, "contact at the end")}
    assert still >= {"scissor_handle_1.mov", "gauze_pad_0.mov"}
    assert len(still) <= 15
    unclear = [f.item.rpartition("_")[0] for f in of(odd(public), "contact")]
    assert {*unclear} >= {"cotton_ball", "sponge_soft"}
    assert len(unclear) <= 25
    shared = of(public, "session in two parts")
    assert {f.severity for f in shared} == {WARNING}
    assert {f.item for f in shared} <= {f.item for f in of(public, "session")}
    hardness = of(public, "predicted from the no-contact reference alone")[0]
    assert (hardness.item, hardness.severity) == ("hardness", WARNING)
    assert float(hardness.measured.split()[0]) == pytest.approx(52, abs=6)
    assert float(hardness.expected.split()[0]) == pytest.approx(40, abs=4)
    assert float(hardness.measured.split()[-1]) < leakage.ALPHA


def test_flawless_videos_no_videos_and_a_single_one_give_no_warning() -> None:
    assert odd(check_files(probes(), OTHER)) == []
    assert [*check_files([], OTHER), *check_leakage([], [], OTHER)] == []
    alone = Catalogue(language=OTHER.language, objects={"rug": OTHER.objects["rug"]})
    assert odd(check_files([probe()], alone)) == odd(made.leaks([probe()], {}, alone)) == []


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
