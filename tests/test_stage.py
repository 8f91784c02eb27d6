"""Around a stage: one line for bad input, one process at a time, whole files or none."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import torch
import yaml
from filelock import FileLock
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.errors import UserError
from pipeline.core.io import (
    atomic,
    atomic_folder,
    load_tensors,
    read_json,
    read_jsonl,
    read_table,
    write_json,
    write_jsonl,
    write_table,
)
from pipeline.core.parallel import _there
from pipeline.core.records import Assignment, Measurement, Part, Score, Video
from pipeline.core.stage import running_stages, stage
from pipeline.scales import compose, write_params
from tests.closure import ROOT
from tests.conftest import refused


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_params(compose("smoke", conf=ROOT / "conf"), tmp_path / "params.yaml")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_stage_says_when_it_starts_and_ends_and_what_it_cost(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "checkpoints/align@x/1").mkdir(parents=True)
    (here / "checkpoints/lora@x/1").mkdir(parents=True)
    with stage("align", "x") as run:
        run.finish_training([Measurement(step=1, name="loss", value=2.0), Measurement(step=5, name="loss", value=1.5)])
    written = json.loads((here / "runs/align@x.json").read_text())
    assert written["metrics"] == {"loss": 1.5, "steps": 5}
    assert written["started"] <= written["ended"]
    assert min(written[k] for k in ("seconds", "startup_seconds", "peak_memory_mb")) >= 0
    assert f"{len(os.sched_getaffinity(0))} cores" in written["device"]
    first, last = capsys.readouterr().out.splitlines()
    assert first == "align@x: starts (smoke-scenes)"
    assert last.startswith("align@x: done in ")
    assert "loss 1.5" in last
    assert [f.name for f in (here / "checkpoints").iterdir()] == ["lora@x"], "its own are needed no more"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (UserError("x.mov: does not decode; export it again"), "split: x.mov: does not decode"),
        (MemoryError(), "lower the batch sizes"),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate"), "lower the batch sizes"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "lower the batch sizes"),
        (OSError(errno.ENOSPC, "No space left on device", "data/frames"), "no space left on the disk (data/frames)"),
        (PermissionError(errno.EACCES, "Permission denied", "data/x"), "data/x: Permission denied; make it readable"),
        (OSError(errno.EROFS, "Read-only file system", "data/x"), "data/x: Read-only file system; make it"),
        (OSError(errno.ENOTDIR, "Not a directory", "data/x"), "data/x: Not a directory"),
        # As safetensors and torch say it.
        (RuntimeError("I/O error: No space left on device (os error 28)"), "no space left on the disk"),
        (RuntimeError("basic_ios::clear: iostream error"), "data/ or checkpoints/: Input/output error"),
    ],
)
def test_bad_end_is_one_line_and_leaves_no_metrics(here: Path, error: Exception, words: str) -> None:
    with pytest.raises(SystemExit) as caught, stage("split"):
        raise error
    assert words in str(caught.value.code)
    assert "\n" not in str(caught.value.code)
    assert not (here / "data" / "metrics").exists()


def test_a_bug_keeps_its_traceback(here: Path) -> None:
    with pytest.raises(ZeroDivisionError), stage("split"):
        _ = 1 / 0


def test_stage_runs_once_at_a_time(here: Path) -> None:
    (here / "runs/locks").mkdir(parents=True)
    with FileLock(here / "runs/locks/split.lock"):
        with pytest.raises(SystemExit, match="still running"), stage("split"):
            pass
        with stage("grade", "another"):
            pass
    with stage("split"):
        pass


CHAIN = """\
stages:
  first: {cmd: touch first.txt, outs: [first.txt]}
  slow: {cmd: python stages/slow.py, deps: [first.txt]}
"""
IMPORTING = "import pipeline\nprint('now', flush=True)\ntime.sleep(600)"
RUNNING = (
    "from pipeline.core.stage import stage\nwith stage('slow'):\n    print('now', flush=True)\n    time.sleep(600)"
)
WORKERS = "from pipeline.core.parallel import run_parallel\n"
SLEEPING = f"{WORKERS}print('now', flush=True)\nlist(run_parallel(time.sleep, [600] * 64, '', ''))"
# So much to hand over that a worker is always in the middle of it.
TELLING = (
    f"{WORKERS}for i, _ in enumerate(run_parallel(bytes, [1 << 22] * 9000, '', '')):\n    i or print('now', flush=True)"
)
STOPPED = "slow: stopped; finished stages stay, and `octopi repro` goes on from there"


def interrupted(folder: Path, *command: str) -> tuple[int, list[str]]:
    """Run a command, press Ctrl-C when `now` is printed, and give its status and the lines from there on."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "SHELL": "/bin/sh"}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    process = subprocess.Popen(
        command, cwd=folder, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        # What a script starts in the background is born deaf to Ctrl-C, as this process then is.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        assert process.stdout
        while (line := process.stdout.readline()) != "now\n":
            assert line, "it ended"
        # As a terminal does it: to every process at once.
        os.killpg(process.pid, signal.SIGINT)
        lines = process.communicate(timeout=300)[0].splitlines()
        return process.returncode, lines
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("body", [IMPORTING, RUNNING])
def test_ctrl_c_in_a_chain_is_one_line_and_what_is_finished_stays(here: Path, body: str) -> None:
    (here / "dvc.yaml").write_text(CHAIN)
    (here / "stages").mkdir()
    (here / "stages/slow.py").write_text(f"import time\n{body}\n")
    subprocess.run(f"git init -q && '{sys.executable}' -m dvc init -q", shell=True, check=True)
    assert interrupted(here, "octopi", "repro") == (130, [STOPPED])
    assert (here / "first.txt").exists()
    assert list(yaml.safe_load((here / "dvc.lock").read_text())["stages"]) == ["first"]
    _, lines = interrupted(here, "dvc", "repro")
    assert lines[0] == STOPPED
    assert [line.split(":")[0] for line in lines[1:]] == ["ERROR"], "DVC's own"


@pytest.mark.parametrize("body", [SLEEPING, *[TELLING] * 3])
def test_ctrl_c_ends_the_processes_of_a_stage(tmp_path: Path, body: str) -> None:
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages/slow.py").write_text(f"import time\n{body}\n")
    assert interrupted(tmp_path, sys.executable, "stages/slow.py") == (130, [STOPPED])


def test_parameters_that_change_while_a_stage_runs_are_no_silent_matter(here: Path) -> None:
    with pytest.raises(SystemExit, match=r"params.yaml was changed while it ran"), stage("split"):
        write_params(compose("smoke", ["seed=1"], conf=ROOT / "conf"), here / "params.yaml")
    assert not (here / "runs/split.json").exists()
    with stage("split"):
        os.utime(here / "params.yaml")  # Written anew with the same values.


@pytest.mark.parametrize("code", ["import torch; limit_threads(1)", "limit_threads(1); import torch"])
def test_threads_are_limited_before_and_after_torch_is_imported(code: str) -> None:
    """Some stages import it when they need it."""
    code = f"from pipeline.core.runtime import limit_threads; {code}; print(torch.get_num_threads())"
    environment = {**os.environ, "OMP_NUM_THREADS": "2", "PYTHONPATH": str(ROOT)}
    assert subprocess.check_output([sys.executable, "-c", code], text=True, env=environment) == "1\n"


@pytest.mark.parametrize("name", ["TORCH_ALLOW_TF32_CUBLAS_OVERRIDE", "NVIDIA_TF32_OVERRIDE"])
def test_no_variable_changes_the_format_of_numbers(here: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "1")
    with pytest.raises(SystemExit, match=f"^split: {name} is set.*unset it$"), stage("split"):
        pass


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Another clone of the project, in a path with a space, as far as a stage's start needs it."""
    folder = tmp_path / "another clone"
    for part in ("pipeline", "stages", "conf"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "dvc.yaml", folder)
    write_params(compose("smoke", conf=ROOT / "conf"), folder / "params.yaml")
    return folder


def test_a_stage_runs_the_code_beside_it_or_refuses(clone: Path) -> None:
    """Whichever environment is active, since dvc.lock records what lies in the project's folder."""
    (linked := clone.with_name("linked clone")).symlink_to(clone)

    def split(folder: Path, code: Path) -> tuple[str, str]:
        command = [sys.executable, "stages/split.py"]
        environment = {**os.environ, "PYTHONPATH": str(code)}
        done = subprocess.run(command, cwd=folder, env=environment, text=True, capture_output=True, check=False)
        assert done.returncode == 1
        return done.stdout, done.stderr

    for folder in (clone, linked):
        started, stopped = split(folder, ROOT)
        assert started == ""
        assert stopped.count("\n") == 1
        assert f"split: {ROOT / 'pipeline'} would run, but dvc.lock records {clone / 'pipeline'}" in stopped
        for code in (clone, linked):
            started, stopped = split(folder, code)
            assert started == "split: starts (smoke-scenes)\n"
            assert "data/videos.parquet: no such file" in stopped


RECORDING = ["scale smoke", "repro", "publish", "page", "diff HEAD"]
RECORDING += ["answer-with --endpoint http://a/v1 --model b --input frames"]


@pytest.mark.parametrize("command", RECORDING)
def test_commands_that_write_records_refuse_likewise(
    clone: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    before = sorted(clone.rglob("*"))
    for folder, words in (
        (clone, f"dvc.lock records {clone / 'pipeline'}"),
        (clone / "pipeline/encoder", f"go to {clone}, the project's folder"),
        (clone.parent, f"{clone.parent} has no dvc.yaml; go to"),
    ):
        monkeypatch.chdir(folder)
        error = CliRunner().invoke(app, command.split()).exception
        assert isinstance(error, UserError)
        assert words in str(error)
    assert sorted(clone.rglob("*")) == before


def test_a_worker_of_a_cluster_and_a_stage_in_a_wrong_folder_refuse_likewise(
    clone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(clone.parent)  # A worker goes to the project's folder itself.
    with refused("dvc.lock records"):
        _there(str(clone), len, "")
    monkeypatch.chdir(clone / "stages")
    with pytest.raises(SystemExit, match=f"go to {clone}, the project's folder"), stage("split"):
        pass


@pytest.mark.parametrize("command", ["ask x", "describe . --csv a.csv", "serve", "demo"])
def test_a_model_may_be_asked_wherever_the_package_is_installed(
    clone: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """Where no other is named, the one that is shipped: a clone's code, and a folder without a chain, are no matter."""
    asked: list[Path | None] = []

    def load(folder: Path | None, *_: object) -> None:
        asked.append(folder)
        raise UserError("reached")

    monkeypatch.setattr("pipeline.cli._load", load)
    # The server's and the demo's threads load it.
    monkeypatch.setattr("pipeline.use.server.serve", lambda load, *_: load())
    monkeypatch.setattr("pipeline.use.demo.serve_demo", lambda load, *_: load())
    for folder in (clone, clone / "pipeline/encoder", clone.parent):
        monkeypatch.chdir(folder)
        error = CliRunner().invoke(app, command.split()).exception
        assert isinstance(error, UserError), error
        assert str(error) == "reached"
    assert asked == [None] * 3


def test_no_scale_is_chosen_while_a_stage_runs(here: Path) -> None:
    before = (here / "params.yaml").read_bytes()
    with stage("split"):
        assert running_stages() == ["split"]
        result = CliRunner().invoke(app, ["scale", "small"])
    assert isinstance(result.exception, UserError)
    assert "split is running" in str(result.exception)
    assert (here / "params.yaml").read_bytes() == before
    assert running_stages() == []


STARTED = """
import os, sys, time
from pathlib import Path
from pipeline.core.errors import UserError
from pipeline.core.stage import stage
with stage("align", "x", launched=True) as run:
    Path("started").write_text(str(os.getpid()))
    while sys.argv[1] == "waits":
        time.sleep(0.1)
    from accelerate import Accelerator
    from pipeline.training.trainer import check_accelerate
    print("computes in", Accelerator().mixed_precision)
    check_accelerate()
    if sys.argv[1] == "fails":
        raise UserError("no such thing")
"""
SHIPPED = compose("paper-7b", conf=ROOT / "conf").runtime.launcher


def started(here: Path, launcher: str, what: str) -> subprocess.Popen[str]:
    """A stage that is started as DVC starts it, where the user's own configuration of accelerate says bfloat16."""
    (here / "stage.py").write_text(STARTED)
    (here / "conf").symlink_to(ROOT / "conf")
    own = {"compute_environment": "LOCAL_MACHINE", "distributed_type": "NO", "mixed_precision": "bf16"}
    (here / "home" / "accelerate").mkdir(parents=True)
    (here / "home" / "accelerate" / "default_config.yaml").write_text(yaml.safe_dump(own | {"num_processes": 1}))
    (here / "two.yaml").write_text(yaml.safe_dump(own | {"distributed_type": "MULTI_CPU", "num_processes": 2}))
    write_params(compose("smoke", [f"runtime.launcher={launcher}"], conf=ROOT / "conf"), here / "params.yaml")
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.Popen(
        ["python", "stage.py", what],
        env={**os.environ, "PATH": programs, "PYTHONPATH": str(ROOT), "HF_HOME": str(here / "home")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A background shell has it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


@pytest.mark.parametrize(
    ("launcher", "line"),
    [
        (SHIPPED, "no such thing\n"),
        ("accelerate launch -q --num_processes 1", "runtime.launcher: ACCELERATE_MIXED_PRECISION is bf16, which"),
        ("nowhere", "runtime.launcher: nowhere: No such file or directory; set it to python\n"),
    ],
)
def test_a_stage_starts_itself_by_the_launcher(here: Path, launcher: str, line: str) -> None:
    """With its status and one line. The configuration that comes along keeps the user's own out."""
    process = started(here, launcher, "fails")
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1
    assert errors.startswith(f"align@x: {line}")
    assert errors.count("\n") == 1
    if launcher == SHIPPED:
        assert "computes in no\n" in output
        assert int((here / "started").read_text()) != process.pid


@pytest.mark.parametrize(
    ("launcher", "number"),
    [
        (SHIPPED, signal.SIGINT),
        ("accelerate launch --cpu --config_file two.yaml", signal.SIGKILL),
    ],
)
def test_a_stage_that_is_ended_leaves_no_process(here: Path, launcher: str, number: signal.Signals) -> None:
    process = started(here, launcher, "waits")
    file = here / "started"
    while process.poll() is None and not (file.exists() and file.read_text()):
        time.sleep(0.1)
    children = psutil.Process(process.pid).children(recursive=True)
    assert int(file.read_text()) in {child.pid for child in children}
    process.send_signal(number)
    process.communicate(timeout=300)
    assert process.returncode != 0
    assert psutil.wait_procs(children, timeout=300)[1] == []


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    write_json(target, {"old": 1})
    with pytest.raises(RuntimeError), atomic(target) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert read_json(target) == {"old": 1}
    assert os.listdir(tmp_path) == ["a.json"]
    with pytest.raises(ValueError, match="JSON"):
        write_json(target, {"x": float("nan")})
    assert read_json(target) == {"old": 1}


SCORE = Score(
    question_id="q", task="PC", measure="choice", correct=True, parsed=True, truncated=False, expected="yes",
    predicted="yes", objects=("a", "b"),
)  # fmt: skip


def test_a_stage_removes_what_killed_ones_were_writing(here: Path) -> None:
    kill = "import os; from pathlib import Path; from pipeline.core.io import atomic"
    kill += "; t = atomic(Path('data/graded.parquet')).__enter__(); t.write_text('half'); os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", kill], cwd=here, check=False).returncode == -9
    (rest,) = (here / "data").iterdir()
    dead = rest.name.split(".")[-2]
    rests = [rest]
    for folder in ("data", "data/encoder/0", "reports/smoke-scenes/figures", "models", "runs"):
        (here / folder).mkdir(parents=True, exist_ok=True)
        others = [here / folder / name for name in (f".x.{os.getpid()}.part", ".frames.part", f"x.{dead}.csv")]
        for other in others:
            other.touch()
        rests += [here / folder / name for name in (f".b.npy.{dead}.part", f".c.{dead}.part.mp4")]
        for made in rests[-2:]:
            made.touch()
        rests.append(here / folder / f".d.{dead}.part")
        (rests[-1] / "within").mkdir(parents=True)
    kept = {f for f in here.rglob("*") if f.is_file()} - set(rests)
    with stage("grade"):
        assert not [rest for rest in rests if rest.exists()]
    assert not kept - set(here.rglob("*")), "a living process's, and what is none"


def test_a_folder_that_was_killed_is_made_anew_and_one_in_the_making_left_alone(tmp_path: Path) -> None:
    kill = "import os; from pathlib import Path; from pipeline.core.io import atomic_folder"
    kill += "; making = atomic_folder(Path('[a]')); (making.__enter__() / 'half').touch(); os.kill(os.getpid(), 9)"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    assert subprocess.run([sys.executable, "-c", kill], cwd=tmp_path, env=env, check=False).returncode == -9
    (rest,) = tmp_path.iterdir()
    living, other = tmp_path / f".[a].{os.getppid()}.part", rest.with_name(rest.name.replace("[a]", "a"))
    living.mkdir()
    other.mkdir()
    with atomic_folder(tmp_path / "[a]") as made:
        (made / "whole").touch()
    assert set(tmp_path.iterdir()) == {tmp_path / "[a]", living, other}
    assert os.listdir(tmp_path / "[a]") == ["whole"]


def test_tables_come_back_as_they_went(tmp_path: Path) -> None:
    for model, records in (
        (Score, [SCORE, SCORE.model_copy(update={"objects": ()})]),
        (Assignment, [Assignment(video_id="ä b", object_id="x", part=Part.TEST)]),
        (Assignment, []),
    ):
        write_table(tmp_path / "t.parquet", model, records)
        assert read_table(tmp_path / "t.parquet", model) == records
        write_jsonl(tmp_path / "t.jsonl", records)
        assert read_jsonl(tmp_path / "t.jsonl", model) == records


@given(st.lists(st.floats(allow_nan=False, width=64), max_size=5))
def test_floats_survive_exactly(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    path = tmp_path_factory.mktemp("t") / "t.parquet"
    records = [Measurement(step=i, name="x", value=v) for i, v in enumerate(values)]
    write_table(path, Measurement, records)
    assert read_table(path, Measurement) == records


def test_bad_files_are_named_with_the_mend(tmp_path: Path) -> None:
    write_table(tmp_path / "t.parquet", Score, [SCORE])
    (tmp_path / "half.parquet").write_bytes((tmp_path / "t.parquet").read_bytes()[:40])
    (tmp_path / "q.jsonl").write_text(SCORE.model_dump_json() + "\n{}\n")
    (tmp_path / "x.safetensors").write_bytes(b"\x80\x04 a pickle, say")
    for words, read in (
        ("none.parquet.*dvc repro", lambda: read_table(tmp_path / "none.parquet", Video)),
        ("t.parquet.*columns", lambda: read_table(tmp_path / "t.parquet", Video)),
        ("half.parquet", lambda: read_table(tmp_path / "half.parquet", Score)),
        ("q.jsonl.*line 2", lambda: read_jsonl(tmp_path / "q.jsonl", Score)),
        ("x.safetensors.*not a safetensors file", lambda: load_tensors(tmp_path / "x.safetensors")),
        ("y.safetensors.*no such file", lambda: load_tensors(tmp_path / "y.safetensors")),
    ):
        with refused(words):
            read()
