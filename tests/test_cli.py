"""The command `octopi`: what a person sees, and the exit status."""

from pathlib import Path
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.cli.reproduce import right_answers
from pipeline.config.params import load_params
from pipeline.report.load import load_report
from pipeline.scales import compose, write_params
from pipeline.tasks import TASKS
from tests.conftest import ROOT, moving_square, octopi, write_video
from tests.report.conftest import rows_of


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that sees the project's inputs, but has params.yaml, data/ and runs/ of its own."""
    for name in ("conf", "pipeline"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_scale_writes_what_it_says(project: Path) -> None:
    assert "reports/smoke-scenes/" in octopi("scale", "smoke", "ablation.seeds=[3]")
    assert load_params().ablation.seeds == (3,)
    assert "unchanged" in octopi("scale", "smoke", "ablation.seeds=[3]")


def test_scale_names_the_objects_that_nothing_can_be_asked_about(project: Path) -> None:
    learnt = "baseball,pillow,rug,potato,rice"
    checked = "bubble_wrap,denim,feather_duster_handle,millet,nylon_shirt,steel_wool,tsa_lock_numbers"
    asked = "bath_towel,clothes_peg,hairbrush_bristles,hairbrush_handle,ice_block,microfiber_cloth"
    lacking = "1 of 7 test objects have no videos (toilet_brush_bristles); 6 of 7 validation objects have no videos ("
    for objects, override, count in (
        (f"{learnt},denim,{asked}", "seed=0", 1),
        (f"{learnt},{checked},{asked},toilet_brush_bristles", "seed=0", 0),
        (f"{learnt},{checked}", "split.name=kfold", 0),
    ):
        said = octopi("scale", "smoke", f"scenes.objects=[{objects}]", "ablation.touch=[]", override)
        assert said.count(lacking) == said.count("have no videos (") / 2 == count


INNER = {
    "repro": "pipeline.cli.reproduce.outdated",
    "data audit .": "pipeline.videos.audit.run.audit_folder",
    "describe . --csv a --model .": "pipeline.use.model.Octopi.from_pretrained",
}


def test_ctrl_c_is_one_line(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_params(compose("smoke"))
    for command, inner in INNER.items():
        monkeypatch.setattr(inner, Mock(side_effect=KeyboardInterrupt))
        result = CliRunner().invoke(app, command.split())
        assert (result.exit_code, result.stdout) == (130, "")
        assert result.stderr == "octopi: stopped; what is finished stays, call it again to go on\n"


def test_a_clone_whose_chain_is_up_to_date_is_published_once(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_params(compose("smoke"))
    calls: list[object] = []
    monkeypatch.setattr("pipeline.cli.reproduce.outdated", lambda _: ({}, 16, True))
    monkeypatch.setattr("dvc.cli.main", lambda _: 0)
    monkeypatch.setattr("pipeline.tracking.publish.publish", calls.append)
    for arguments, published in ((["--dry"], 0), ([], 1)):
        octopi("repro", *arguments)
        assert len(calls) == published
    (project / "mlruns").mkdir()
    (project / "mlruns" / "mlflow.db").touch()
    octopi("repro")
    assert len(calls) == 1


def test_a_dry_run_lists_what_waits_where_outputs_are_missing(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_params(compose("smoke"))
    monkeypatch.setattr("dvc.cli.main", lambda _: pytest.fail("it ends where a file is missing"))
    monkeypatch.setattr("pipeline.cli.reproduce.outdated", lambda _: (["split", "grade"], 16, False))
    assert octopi("repro", "--dry").splitlines()[1:] == ["split", "grade"]


def test_the_last_lines_are_those_of_the_reports_tables() -> None:
    """The full system, not one that describes less; a model that was asked stands beside it; of random models none."""
    file = ROOT / "reports" / "small-videos" / "scores.csv"
    scores = load_report(file.parent).scores.query(
        "seed == 'all' and measure in ['choice', 'combined'] and opd == 'all'"
    )
    said = "\n".join(right_answers(file, at_random=False))
    for title, whose in (
        ("octopi-small", "encoder == 'octopi-small' and touch == 'touch'"),
        ("The full system", "encoder == 'finetuned' and lora == 'with' and touch == 'real'"),
    ):
        own = said.partition(f"{title}, with 95 % intervals:\n")[2]
        for row, line in zip(
            scores.query(whose).set_index("task").loc[[*TASKS][:5]].itertuples(), own.split("\n"), strict=False
        ):
            assert line.startswith(
                f"  {TASKS[row.Index].title}: {100 * row.accuracy:.0f} % right [{100 * row.low:.0f}, "
            )
    assert "The full system" not in "\n".join(right_answers(file, at_random=True))


def lines(output: str, severity: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith(f"{severity} ")]


@pytest.fixture
def folder(project: Path, few_permutations: None) -> Path:
    for seed, name in enumerate(("baseball_0", "potato_0")):
        write_video(project / "videos" / f"{name}.avi", moving_square(8, seed))
    return project / "videos"


def test_data_check_lists_every_error_first(folder: Path) -> None:
    good = octopi("data", "check", folder)
    assert lines(good, "error") == []
    assert "resolution: 48x36: 2 videos" in good
    assert "agreement" not in good, "labels and leaks are the audit's"
    (folder / "rug_0.avi").write_bytes(b"")
    (folder / "nameless.avi").write_bytes(b"x")
    bad = octopi("data", "check", folder, status=1)
    errors = lines(bad, "error")
    assert bad.splitlines()[: len(errors)] == errors
    assert [line.split(": ")[1] for line in errors] == ["nameless.avi", "rug_0.avi"]


def test_data_audit_writes_all_it_shows_and_ends_with_status_1_where_parts_share_a_video(folder: Path) -> None:
    for status, severities in ((0, {"warning", "info"}), (1, {"error", "warning", "info"})):
        said = octopi("data", "audit", "videos", "--split", "paper", "--out", "found/audit.csv", status=status)
        rows = rows_of(Path("found/audit.csv"))
        assert list(rows[0]) == ["check", "item", "measured", "expected", "severity"]
        assert {row["severity"] for row in rows} == severities
        first, *shown = said.splitlines()
        assert first == f"{len(rows)} findings in found/audit.csv"
        for row, line in zip(rows, shown, strict=True):
            expected = f" (expected: {row['expected']})" if row["expected"] else ""
            assert line == f"{row['severity']:8} {row['check']}: {row['item']}: {row['measured']}{expected}"
        # A test object's video with the bytes of a training object's.
        (folder / "bath_towel_0.avi").write_bytes((folder / "baseball_0.avi").read_bytes())
    assert len(lines(said, "error")) == 1
    octopi("data", "audit", "videos")  # Without a split it is a warning.
    assert "allowed: paper, release" in octopi("data", "audit", "videos", "--split", "Not a name!", status=1)
