"""Sample answers: a rule chooses them, and no frame of a real video leaves the machine."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.io import read_jsonl, read_table
from pipeline.params import Params
from pipeline.records import Prediction, Question, Score, Task
from pipeline.reporting.inputs import read_inputs
from pipeline.reporting.samples import GAP, NO_PICTURES, SampleSheet, write_samples
from tests.fake_chain import fake_params, write_chain

KEY = "finetuned-with-all-0"


@pytest.fixture(scope="module")
def params() -> Params:
    return fake_params()


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory, params: Params) -> Path:
    root = tmp_path_factory.mktemp("samples")
    write_chain(root, params)
    return root


def sheet(params: Params, root: Path, folder: Path) -> SampleSheet:
    write_samples(read_inputs(params, root), root, folder)
    return SampleSheet.model_validate_json((folder / "samples.json").read_text())


def test_the_first_right_and_the_first_wrong_of_each_task(chain: Path, params: Params, tmp_path: Path) -> None:
    found = sheet(params, chain, tmp_path)
    assert found.variant == KEY
    assert found.note == ""
    scores = read_table(chain / "data" / "scores" / KEY / "scores.parquet", Score)
    said = {p.question_id: p for p in read_jsonl(chain / "data" / "answers" / KEY / "predictions.jsonl", Prediction)}
    asked = {q.question_id: q for q in read_jsonl(chain / "data" / "questions" / "evaluation.jsonl", Question)}
    wanted = []
    for task in Task:
        for right in (True, False):
            ids = [
                s.question_id
                for s in scores
                if s.task == task and s.correct == right and s.measure in ("choice", "combined")
            ]
            wanted += [(task, right, min(ids))] if ids else []
    assert [(s.task, s.right, s.question_id) for s in found.samples] == wanted
    assert {s.right for s in found.samples} == {True, False}
    for sample in found.samples:
        question = asked[sample.question_id]
        assert sample.answered == said[sample.question_id].outputs
        assert [v.video_id for v in sample.videos] == list(question.videos)
        assert "{tactile}" not in "".join(sample.asked)
        places = [" ".join(sample.asked).index(f"[{v.name}]") for v in sample.videos]
        assert places == sorted(places)


def test_strips_show_what_the_model_was_given(chain: Path, params: Params, tmp_path: Path) -> None:
    found = sheet(params, chain, tmp_path)
    video = found.samples[0].videos[0]
    strip = cv2.imread(str(tmp_path / video.strip))
    frames = np.load(chain / "data" / "frames" / "frames.npy")
    count, side = params.frames.per_video, frames.shape[1]
    assert strip.shape == (side, count * (side + GAP) - GAP, 3)
    kept = [f["row"] for f in _index(chain) if f["video_id"] == video.video_id]
    np.testing.assert_array_equal(strip[0, 0, ::-1], frames[kept[0], 0, 0])
    assert {p.name for p in tmp_path.glob("*.png")} == {v.strip for s in found.samples for v in s.videos}


def _index(chain: Path) -> list[dict[str, object]]:
    import pyarrow.parquet as pq

    return pq.read_table(chain / "data" / "frames" / "frames.parquet").to_pylist()


def test_no_frame_of_a_real_video_is_written(chain: Path, params: Params, tmp_path: Path) -> None:
    real = params.model_copy(update={"data": params.data.model_copy(update={"source": "videos"})})
    (tmp_path / "old.png").write_bytes(b"of an earlier run")
    found = sheet(real, chain, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["samples.json"]
    assert found.note == NO_PICTURES
    assert found.samples
    assert {v.strip for s in found.samples for v in s.videos} == {""}


def test_without_answers_a_note_says_so(params: Params, tmp_path: Path) -> None:
    write_chain(tmp_path, params)
    (tmp_path / "data" / "answers" / KEY / "predictions.jsonl").unlink()
    found = sheet(params, tmp_path, tmp_path / "out")
    assert (found.samples, found.variant) == ((), "")
    assert found.note


def test_equal_input_gives_equal_bytes(chain: Path, params: Params, tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other):
        sheet(params, chain, folder)
    assert {p.name: p.read_bytes() for p in one.iterdir()} == {p.name: p.read_bytes() for p in other.iterdir()}
    assert json.loads((one / "samples.json").read_text())["rule"].startswith("Of each task")
