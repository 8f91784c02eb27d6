"""The whole audit of a folder and of the chain, on files good and bad, and on the public videos."""

from __future__ import annotations

import json
import runpy
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import SplitConfig
from pipeline.core.io import read_csv, write_table
from pipeline.core.records import Part
from pipeline.scales import compose, write_params
from pipeline.videos.audit import leakage
from pipeline.videos.audit.run import audit_chain, audit_folder, check_folder
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Finding, Probe, Video
from tests.audit_records import ERROR, GOOD_SPLIT, INFO, WARNING, assigned, odd, of, probe, probes
from tests.closure import ROOT
from tests.conftest import moving_square, write_video

pytestmark = pytest.mark.usefixtures("few_permutations")
PAPER = SplitConfig(name="paper")


def test_every_broken_file_is_found_and_raises_nothing(tmp_path: Path, catalogue: Catalogue) -> None:
    folder = tmp_path / "videos with é"
    for seed, name in enumerate(("baseball_0", "potato_0", "rug_0", "rug_1", "sub/lemon_0")):
        write_video(folder / f"{name}.avi", moving_square(16, seed))
    good = (folder / "rug_0.avi").read_bytes()
    for name, content in (
        *(("rug_2.avi", b""), ("rug_3.mov", b"not a video at all " * 400), ("rug_4.avi", good[:300])),
        *(("rug_5.avi", good[: len(good) * 2 // 3]), ("pillow_0.mp4", np.random.default_rng(0).bytes(500))),
        *((name, good) for name in ("rug_6.avi", "nameless.avi", "cotton_bal_0.avi", "sub/orange_0.avi")),
        *(("rug_01.avi", (folder / "rug_1.avi").read_bytes()), ("notes.txt", b"no video")),
    ):
        (folder / name).write_bytes(content)
    (folder / "rug_7.mkv").symlink_to(folder / "nowhere.mkv")
    (folder / "rug_8.mov").mkdir()
    write_video(folder / "sub" / "millet_0.avi", moving_square(1, 9))
    findings = audit_folder(folder, catalogue, PAPER)
    severities = [f.severity for f in findings]
    assert severities == sorted(severities, key=[ERROR, WARNING, INFO].index)
    errors = {(f.check, f.item) for f in findings if f.severity is ERROR}
    assert errors >= {
        *(("decodes", n) for n in ("rug_2.avi", "rug_3.mov", "rug_4.avi", "rug_7.mkv", "pillow_0.mp4")),
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
    overrides = [
        "kernels=machine",
        "data.source=videos",
        "data.dir=videos",
        f"data.catalogue='{ROOT / 'pipeline/physiclear'}'",
    ]
    write_params(compose("smoke", overrides, ROOT / "conf"), tmp_path / "params.yaml")
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
