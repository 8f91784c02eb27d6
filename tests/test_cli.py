"""The command `octopi`: what a person sees, and the exit status."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.config import load_params
from pipeline.errors import UserError
from tests.closure import ROOT
from tests.conftest import moving_square, write_video

RUNNER = CliRunner()


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that sees the project's inputs, but has params.yaml, data/ and runs/ of its own."""
    for name in ("conf", "pipeline", "standins"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_scale_writes_what_it_says_and_forgets_old_costs(project: Path) -> None:
    (project / "runs").mkdir()
    (project / "runs" / "split.json").write_text("{}")
    result = RUNNER.invoke(app, ["scale", "smoke", "ablation.seeds=[3]"])
    assert result.exit_code == 0, result.output
    assert "reports/smoke-scenes/" in result.output
    assert load_params().plan.encoder_seeds == (3,)
    assert not list((project / "runs").iterdir())
    assert "unchanged" in RUNNER.invoke(app, ["scale", "smoke", "ablation.seeds=[3]"]).output


def test_refused_scale_leaves_the_old_params(project: Path) -> None:
    RUNNER.invoke(app, ["scale", "smoke"])
    before = Path("params.yaml").read_bytes()
    result = RUNNER.invoke(app, ["scale", "small", "data.source=videos", "data.dir=nowhere"])
    assert isinstance(result.exception, UserError)
    assert Path("params.yaml").read_bytes() == before


def test_bad_input_is_one_line_on_stderr_with_status_1(project: Path) -> None:
    done = subprocess.run(
        [Path(sys.executable).parent / "octopi", "scale", "smoke", "frames.sise=3"],
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "did you mean size" in done.stderr


def test_data_check_lists_everything(project: Path, tmp_path: Path) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    write_video(folder / "baseball_0.avi", moving_square(8))
    good = RUNNER.invoke(app, ["data", "check", str(folder)])
    assert good.exit_code == 0, good.output
    (folder / "potato_0.avi").write_bytes(b"")
    write_video(folder / "baseball_0.mp4", moving_square(8))
    bad = RUNNER.invoke(app, ["data", "check", str(folder)])
    assert bad.exit_code == 1
    assert "potato_0.avi" in bad.output
    assert "baseball_0.mp4" in bad.output


@pytest.mark.real
def test_data_check_passes_the_public_videos(real_data: Path) -> None:
    result = RUNNER.invoke(app, ["data", "check", str(real_data), "--catalogue", str(ROOT / "pipeline/physiclear")])
    assert result.exit_code == 0, result.output
    assert "hairbrush_bristles_side_4" in result.output, "three frames are worth a warning"
