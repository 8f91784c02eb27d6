"""The benchmarks, on toys, and their command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.encoder.baseline.features import video_features
from pipeline.benchmarks import BenchRow, frames, selection
from pipeline.benchmarks.__main__ import SECTIONS, main
from pipeline.benchmarks.startup import BASELINE, measure, top_imports
from pipeline.videos.decoding import decode
from pipeline.errors import UserError
from pipeline.videos.frames.selection import uniform_indices
from pipeline.videos.files import VideoFile
from tests.closure import ROOT
from tests.conftest import moving_square, write_video


def write_stage(root: Path, text: str) -> Path:
    script = root / "stages" / "toy.py"
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(text)
    return script


def test_only_imports_are_run(tmp_path: Path) -> None:
    script = write_stage(tmp_path, '"""Doc."""\nimport json\nfrom os import path\n\nopen("ran", "w")\n')
    assert top_imports(script) == "import json\nfrom os import path"
    rows = measure(tmp_path, repeats=2, everything="import json")
    assert [row.case for row in rows] == [BASELINE, "starting Python", "stages/toy.py"]
    assert rows[0].ratio == 1
    assert all(row.low <= row.cost <= row.high and row.unit == "s" and row.baseline == BASELINE for row in rows)
    assert not (tmp_path / "ran").exists()


def test_problems_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no script"):
        measure(tmp_path)
    write_stage(tmp_path, "import nothing_of_the_kind")
    with pytest.raises(UserError, match="No module named 'nothing_of_the_kind'"):
        measure(tmp_path, repeats=1, everything="pass")


def test_command_writes_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = BenchRow(case="a", cost=1, unit="s", baseline="a", ratio=1, low=1, high=1)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(SECTIONS, "startup", lambda root: [row])
    main(["startup"])
    written = json.loads((tmp_path / "reports" / "bench" / "startup.json").read_text())
    assert list(written[0]) == ["case", "cost", "unit", "baseline", "ratio", "error", "low", "high"]


@pytest.mark.parametrize("arguments", [[], ["nonsense"], ["startup", "more"]])
def test_unknown_section_names_the_allowed(arguments: list[str]) -> None:
    with pytest.raises(SystemExit, match="allowed sections: frames, realism, scenes, selection, startup"):
        main(arguments)


def test_frames_are_timed_on_any_videos(tiny_videos: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("OCTOPI_DATA_DIR", str(tiny_videos))
    monkeypatch.setattr(frames, "REPEATS", 1)
    rows = frames.measure(ROOT)
    assert {r.baseline for r in rows} == {frames.BARE, frames.PUBLISHED, "peak memory, 1 videos"}
    for r in rows:
        if r.case.split(",")[0] == r.baseline:
            assert r.ratio == 1
    frames._publish_one(tiny_videos / "rug_0.avi", tmp_path / "published")
    assert len(list((tmp_path / "published").iterdir())) == int(0.3 * 31)


def test_a_setting_sees_the_frames_that_the_pipeline_draws(tmp_path: Path) -> None:
    path = write_video(tmp_path / "rug_0.avi", moving_square(24, width=64, height=48))
    sample = selection._look(VideoFile(path, path.name, "rug", "rug_0"))
    assert sample is not None
    pictures = list(decode(path))
    cases = [s.case for s in selection.settings()]
    reference = np.mean(pictures[:2], axis=0, dtype=np.float32)
    kept = uniform_indices(24, 8)
    for name, positions in (("uniform, 1 frame", [0]), ("uniform, 3 frames", [0, 2, 5])):
        expected = video_features([pictures[kept[p]] for p in positions], reference)
        np.testing.assert_array_equal(sample.features[cases.index(name)], expected)
    assert sample.frames[cases.index("salient, 5 frames")] == 5
