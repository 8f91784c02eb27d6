"""Files that appear whole or not at all, records that come back as they went, and the number format `auto`."""

import os
from pathlib import Path

import pytest
import torch

from pipeline.core import io
from pipeline.core.io import atomic, read_json, read_jsonl, read_table, write_json, write_jsonl, write_table
from pipeline.core.records import Measurement, Part
from pipeline.core.runtime import name_dtype, resolve_dtype
from pipeline.tasks.records import Score
from pipeline.videos.records import Assignment, Video
from tests.conftest import refused

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
