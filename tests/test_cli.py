"""The command `octopi`: what a person sees, and the exit status."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.config.params import load_params
from pipeline.scales import compose, write_params
from tests.closure import ROOT
from tests.conftest import moving_square, not_utf8, write_video

RUNNER = CliRunner()


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that sees the project's inputs, but has params.yaml, data/ and runs/ of its own."""
    for name in ("conf", "pipeline"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_scale_writes_what_it_says(project: Path) -> None:
    result = RUNNER.invoke(app, ["scale", "smoke", "ablation.seeds=[3]"])
    assert result.exit_code == 0, result.output
    assert "reports/smoke-scenes/" in result.output
    assert load_params().ablation.seeds == (3,)
    assert "unchanged" in RUNNER.invoke(app, ["scale", "smoke", "ablation.seeds=[3]"]).output


def test_scale_names_the_objects_that_nothing_can_be_asked_about(project: Path) -> None:
    learnt = "baseball,pillow,rug,potato,rice"
    checked = "bubble_wrap,denim,feather_duster_handle,millet,nylon_shirt,steel_wool,tsa_lock_numbers"
    asked = "bath_towel,clothes_peg,hairbrush_bristles,hairbrush_handle,ice_block,microfiber_cloth"
    lacking = (
        "split.name=paper: 1 of 7 test objects have no videos (toilet_brush_bristles); 6 of 7 validation objects have "
        "no videos (bubble_wrap, feather_duster_handle, millet, nylon_shirt, steel_wool, tsa_lock_numbers)"
    )
    for objects, override, words in (
        (f"{learnt},denim,{asked}", "seed=0", [lacking]),
        (f"{learnt},{checked},{asked},toilet_brush_bristles", "seed=0", []),
        (f"{learnt},{checked}", "split.name=kfold", []),
    ):
        result = RUNNER.invoke(app, ["scale", "smoke", f"scenes.objects=[{objects}]", "ablation.touch=[]", override])
        assert result.exit_code == 0, result.output
        assert [line for line in result.output.splitlines() if "have no videos" in line] == words


@pytest.mark.parametrize(
    ("command", "inner"),
    [
        ("repro", "pipeline.cli.reproduce.outdated"),
        ("data audit .", "pipeline.videos.audit.run.audit_folder"),
        ("describe . --csv a --model .", "pipeline.use.model.Octopi.from_pretrained"),
    ],
)
def test_ctrl_c_is_one_line(project: Path, monkeypatch: pytest.MonkeyPatch, command: str, inner: str) -> None:
    write_params(compose("smoke"))

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(inner, stopped)
    result = RUNNER.invoke(app, command.split())
    assert (result.exit_code, result.stdout) == (130, "")
    assert result.stderr == "octopi: stopped; what is finished stays, call it again to go on\n"


@pytest.mark.parametrize(("arguments", "there", "published"), [([], False, 1), (["--dry"], False, 0), ([], True, 0)])
def test_a_clone_whose_chain_is_up_to_date_is_published_once(
    project: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], there: bool, published: int
) -> None:
    write_params(compose("smoke"))
    calls: list[object] = []
    monkeypatch.setattr("pipeline.cli.reproduce.outdated", lambda _: (0, 16))
    monkeypatch.setattr("dvc.cli.main", lambda _: 0)
    monkeypatch.setattr("pipeline.tracking.publish.publish", calls.append)
    if there:
        (project / "mlruns").mkdir()
        (project / "mlruns" / "mlflow.db").touch()
    assert RUNNER.invoke(app, ["repro", *arguments]).exit_code == 0
    assert len(calls) == published


def lines(output: str, severity: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith(f"{severity} ")]


@pytest.fixture
def folder(project: Path, few_permutations: None) -> Path:
    """Two videos that decode."""
    for seed, name in enumerate(("baseball_0", "potato_0")):
        write_video(project / "videos" / f"{name}.avi", moving_square(8, seed))
    return project / "videos"


def test_data_check_passes_what_decodes(folder: Path) -> None:
    result = RUNNER.invoke(app, ["data", "check", str(folder)])
    assert result.exit_code == 0, result.output
    assert lines(result.output, "error") == []
    assert "resolution: 48x36: 2 videos" in result.output
    assert "agreement" not in result.output, "labels and leaks are the audit's"
    assert not Path("audit.csv").exists()


def test_data_check_lists_every_error_first(folder: Path) -> None:
    (folder / "rug_0.avi").write_bytes(b"")
    (folder / "rug_1.mov").write_bytes(b"no video")
    (folder / "nameless.avi").write_bytes(b"x")
    write_video(folder / "baseball_0.mp4.avi", moving_square(8)).rename(folder / "baseball_0.mkv")
    result = RUNNER.invoke(app, ["data", "check", str(folder)])
    assert result.exit_code == 1
    errors = lines(result.output, "error")
    assert result.output.splitlines()[: len(errors)] == errors
    assert [line.split(": ")[1] for line in errors] == ["nameless.avi", "baseball_0.avi", "rug_0.avi", "rug_1.mov"]
    assert "decodes: rug_0.avi: empty (0 bytes); copy it again, or remove it" in errors[2]


def audited(*arguments: str) -> tuple[int, str, list[dict[str, str]]]:
    """Status, what was printed, and audit.csv."""
    result = RUNNER.invoke(app, ["data", "audit", "videos", *arguments, "--out", "found/audit.csv"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.output
    with Path("found/audit.csv").open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        rows = list(reader)
        assert reader.fieldnames == ["check", "item", "measured", "expected", "severity"]
    return result.exit_code, result.output, rows


def test_data_audit_writes_all_it_shows(folder: Path) -> None:
    status, output, rows = audited("--split", "paper")
    assert status == 0
    assert output.startswith(f"{len(rows)} findings in found/audit.csv")
    assert len(output.splitlines()) == len(rows) + 1
    assert {row["severity"] for row in rows} == {"warning", "info"}
    for check in ("videos per object", "agreement, ICC(3,k)", "same content", "object in two parts", "session"):
        assert check in {row["check"] for row in rows}
    for row, line in zip(rows, output.splitlines()[1:], strict=True):
        assert line.startswith(f"{row['severity']:8} {row['check']}: {row['item']}: {row['measured']}")
        assert line.endswith(f"(expected: {row['expected']})" if row["expected"] else row["measured"])


def test_data_audit_names_what_is_no_text(folder: Path) -> None:
    (odd := not_utf8(folder, "sub?")).mkdir()
    shutil.copy(folder / "potato_0.avi", odd / "rug_0.avi")
    (folder / "potato_0.avi").rename(not_utf8(folder, "rug?_0.avi"))
    status, output, rows = audited()
    assert status == 1
    told = {row["item"]: row["measured"] for row in rows if row["severity"] == "error"}
    rename = "its name is no text in UTF-8; rename it"
    assert told == {r"rug\udcff_0.avi": rename, r"sub\udcff/rug_0.avi": rename}
    assert [line for item in told for line in lines(output, "error") if item in line] == lines(output, "error")


def test_data_audit_ends_with_status_1_where_parts_share_a_video(folder: Path) -> None:
    (folder / "bath_towel_0.avi").write_bytes((folder / "baseball_0.avi").read_bytes())
    status, output, rows = audited("--split", "paper")
    assert status == 1
    assert [(row["check"], row["severity"]) for row in rows[:2]] == [
        ("same content", "error"),
        ("stated label", "warning"),
    ]
    assert len(lines(output, "error")) == 1
    assert audited()[0] == 0, "without a split it is a warning"
