"""Around a stage: one line for bad input, one process at a time, the code beside it; and files that appear whole."""

import errno
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from pipeline.core import io
from pipeline.core.io import atomic, read_json, read_jsonl, read_table, write_json, write_jsonl, write_table
from pipeline.core.records import Measurement, Part
from pipeline.core.runtime import name_dtype, resolve_dtype
from pipeline.encoder.embed import EncoderSource
from pipeline.language.generate import ModelSource
from pipeline.running import parallel
from pipeline.running.errors import UserError
from pipeline.running.parallel import device_here, use_backend
from pipeline.running.stage import running_stages, stage
from pipeline.scales import check_inputs, compose, write_params
from pipeline.tasks.records import Score
from pipeline.videos.records import Assignment, Video
from tests.conftest import ROOT, octopi, refused


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
        (OSError(errno.ENOSPC, "No space left on device", "data/x"), "data/x: No space left on device; free space"),
        # As safetensors and torch say it.
        (RuntimeError("I/O error: No space left on device (os error 28)"), "No space left on device; free"),
        (RuntimeError("basic_ios::clear: iostream error"), "data/ or checkpoints/: Input/output error"),
    ],
)
def test_bad_end_is_one_line_and_leaves_no_metrics(here: Path, error: Exception, words: str) -> None:
    with pytest.raises(SystemExit) as caught, stage("split"):
        raise error
    assert words in str(caught.value.code)
    assert "\n" not in str(caught.value.code)
    assert not (here / "runs" / "split.json").exists()
    with pytest.raises(ZeroDivisionError), stage("split"):
        _ = 1 / 0  # A bug keeps its traceback.


def test_stage_runs_once_at_a_time(here: Path) -> None:
    (here / "runs/locks").mkdir(parents=True)
    with FileLock(here / "runs/locks/split.lock"):
        with pytest.raises(SystemExit, match="still running"), stage("split"):
            pass
        with stage("grade", "another"):
            pass
    with stage("split"):
        pass


def test_what_people_change_while_a_stage_runs_is_no_silent_matter(here: Path) -> None:
    """DVC would record it as what the outputs were made from."""
    catalogue = here / "mine"
    catalogue.mkdir()
    (catalogue / "objects.csv").write_text("one")
    params = compose("smoke", ["kernels=machine", f"data.catalogue={catalogue}"], conf=ROOT / "conf")
    write_params(params, here / "params.yaml")
    with pytest.raises(SystemExit, match=r"^split: mine/objects.csv was changed while it ran"), stage("split"):
        (catalogue / "objects.csv").write_text("two")
    with pytest.raises(SystemExit, match=r"^split: mine/other.yaml was changed while it ran"), stage("split"):
        (catalogue / "other.yaml").touch()
    with stage("invent"):
        (catalogue / "objects.csv").write_text("its own output")
    with pytest.raises(SystemExit, match=r"params.yaml was changed while it ran"), stage("split"):
        write_params(params.model_copy(update={"seed": 1}), here / "params.yaml")
    assert not (here / "runs/split.json").exists()
    with stage("split"):
        os.utime(here / "params.yaml")  # Written anew with the same values.


@pytest.mark.parametrize("name", ["TORCH_ALLOW_TF32_CUBLAS_OVERRIDE", "NVIDIA_TF32_OVERRIDE"])
def test_no_variable_changes_the_format_of_numbers(here: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "1")
    with pytest.raises(SystemExit, match=f"^split: {name} is set.*unset it$"), stage("split"):
        pass


def test_no_scale_is_chosen_while_a_stage_runs(here: Path) -> None:
    before = (here / "params.yaml").read_bytes()
    with stage("split"):
        assert running_stages() == ["split"]
        with refused("split is running"):
            octopi("scale", "small")
    assert (here / "params.yaml").read_bytes() == before
    assert running_stages() == []


def test_a_run_that_trains_nothing_leaves_folders_that_are_not_empty(here: Path) -> None:
    params = compose("smoke", ["kernels=machine", "ablation.train=false"], conf=ROOT / "conf")
    write_params(params, here / "params.yaml")
    (here / "dvc.yaml").write_bytes((ROOT / "dvc.yaml").read_bytes())
    for name, key in (("embed", None), ("align", "base-all-0"), ("answer", "base-with-all-0")):
        with pytest.raises(SystemExit) as ended, stage(name, key, of_variants=True):
            pytest.fail("it went on")
        assert not ended.value.code
    made = {file.parent.relative_to(here / "data").as_posix() for file in (here / "data").rglob("not_trained")}
    encoders = {"embeddings/finetuned-0", "embeddings/base-0"}
    assert made == {*encoders, "models/without/base-all-0", "answers/base-with-all-0"}


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """As much of another clone, in a path with a space, as a check of the folder looks at."""
    folder = tmp_path / "another clone"
    for file in ("pipeline/running/stage.py", "pipeline/encoder/model.py", "stages/split.py", "dvc.yaml"):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    write_params(compose("smoke", conf=ROOT / "conf"), folder / "params.yaml")
    return folder


COMMANDS = ["scale smoke", "repro", "publish", "page", "diff HEAD"]
COMMANDS += ["answer-with --endpoint http://a/v1 --model b --input frames"]


@pytest.mark.parametrize("command", COMMANDS)
def test_records_are_of_the_code_beside_them(clone: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    """Whichever environment is active, since dvc.lock records what lies in the project's folder."""
    before = sorted(clone.rglob("*"))
    refusals = {clone: f"dvc.lock records {clone / 'pipeline'}"}
    refusals |= {clone / "pipeline/encoder": f"go to {clone}, the project's folder"}
    refusals |= {clone.parent: f"{clone.parent} has no dvc.yaml; go to"}
    for folder, words in refusals.items():
        monkeypatch.chdir(folder)
        with refused(re.escape(words)):
            octopi(*command.split())
    assert sorted(clone.rglob("*")) == before


@pytest.mark.parametrize("command", ["ask x", "describe . --csv a.csv"])
def test_a_model_may_be_asked_in_any_folder(clone: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setattr("pipeline.use.model.Octopi.from_pretrained", lambda *_, **__: 1 / 0)
    for folder in (clone, clone / "pipeline/encoder", clone.parent):
        monkeypatch.chdir(folder)
        with pytest.raises(ZeroDivisionError):  # It is reached.
            octopi(*command.split())


def test_a_worker_that_outlives_a_stage_loads_anew() -> None:
    """As one behind RAY_ADDRESS may: what is trained later lies at the same place, and a worker keeps one of a kind."""
    config, here = compose("smoke", conf=ROOT / "conf").encoder, Path("here")
    encoder, model = EncoderSource(config, "cpu", here, here, here), ModelSource(here, "", "auto", "none", "cpu")
    for first in (encoder, model):
        assert {first, replace(first)} == {first}
        assert replace(first, run=1.0) != first


def test_a_backend_is_a_parameter_and_may_lack_its_package(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    params = compose("smoke", ["runtime.parallel=ray", "kernels=machine"], ROOT / "conf")
    monkeypatch.setattr(parallel, "find_spec", lambda _: None)
    for check in (lambda: check_inputs(params), lambda: use_backend("ray")):
        monkeypatch.chdir(ROOT)
        with refused(r"\Aruntime\.parallel: ray takes the package ray: pip install -e '\.\[ray\]'\Z"):
            check()
    monkeypatch.chdir(here)
    monkeypatch.setattr(parallel, "_chosen", "processes")
    monkeypatch.setattr(parallel, "find_spec", lambda _: True)
    write_params(params)
    with stage("split"):
        assert device_here("cuda") == "cpu", "the workers' is another"


SCORE = Score(
    question_id="q", task="PC", measure="choice", correct=True, parsed=True, truncated=False, expected="yes",
    predicted="yes", objects=("a", "b"),
)  # fmt: skip


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    write_json(target, {"old": 1})
    with pytest.raises(RuntimeError), atomic(target) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    with pytest.raises(ValueError, match="JSON"):
        write_json(target, {"x": float("nan")})
    assert read_json(target) == {"old": 1}
    assert os.listdir(tmp_path) == ["a.json"]


def test_tables_come_back_as_they_went(tmp_path: Path) -> None:
    for model, records in (
        (Score, [SCORE, SCORE.model_copy(update={"objects": ()})]),
        (Assignment, [Assignment(video_id="ä b", object_id="x", part=Part.TEST)]),
        (Assignment, []),
        (Measurement, [Measurement(step=1, name="x", value=0.1), Measurement(step=2, name="x", value=5e-324)]),
    ):
        write_table(tmp_path / "t.parquet", model, records)
        assert read_table(tmp_path / "t.parquet", model) == records
        write_jsonl(tmp_path / "t.jsonl", records)
        assert read_jsonl(tmp_path / "t.jsonl", model) == records


def test_bad_files_are_named_with_the_mend(tmp_path: Path) -> None:
    write_table(tmp_path / "t.parquet", Score, [SCORE])
    (tmp_path / "q.jsonl").write_text(SCORE.model_dump_json() + "\n{}\n")
    (tmp_path / "x.safetensors").write_bytes(b"\x80\x04 a pickle, say")
    for words, read in (
        ("t.parquet.*columns", lambda: read_table(tmp_path / "t.parquet", Video)),
        ("q.jsonl.*line 2", lambda: read_jsonl(tmp_path / "q.jsonl", Score)),
        ("x.safetensors.*not a safetensors file", lambda: io.load_tensors(tmp_path / "x.safetensors")),
    ):
        with refused(words):
            read()


@pytest.mark.skipif(not Path("/proc/cpuinfo").is_file(), reason="needs /proc/cpuinfo")
def test_on_a_processor_auto_follows_its_instructions(monkeypatch: pytest.MonkeyPatch) -> None:
    flags = {flag for line in Path("/proc/cpuinfo").read_text().splitlines() for flag in line.split()}
    assert name_dtype("auto", "cpu") == ("bfloat16" if flags & {"avx512_bf16", "amx_bf16"} else "float32")
    for avx, amx, name in ((False, False, "float32"), (True, False, "bfloat16"), (False, True, "bfloat16")):
        monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda avx=avx: avx)
        monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda amx=amx: amx)
        assert name_dtype("auto", "cpu") == name


@pytest.mark.parametrize("capable", [True, False])
def test_on_a_card_auto_follows_the_card(capable: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: capable)
    assert name_dtype("auto") == name_dtype("auto", "cuda") == ("bfloat16" if capable else "float32")
    assert resolve_dtype("auto") is getattr(torch, name_dtype("auto"))
