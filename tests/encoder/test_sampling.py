"""Which of the kept frames are drawn, and the store that gives their pictures."""

from __future__ import annotations

import itertools
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import UserError
from pipeline.training.sampling import sample_evaluation, sample_training
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.frames.subtraction import subtract
from tests.encoders import write_frames
from tests.frame_rules import CONFIG


@given(st.integers(1, 400), st.integers(1, 64), st.integers(0, 2**32))
def test_training_samples(count: int, k: int, seed: int) -> None:
    drawn = sample_training(count, k, random.Random(seed))
    assert len(drawn) == k
    assert list(drawn) == sorted(drawn)
    assert set(drawn) <= set(range(count))
    assert len(set(drawn)) == k or count < k
    assert drawn == sample_training(count, k, random.Random(seed))


@given(st.integers(1, 400), st.integers(1, 64))
def test_evaluation_samples_are_uniform_from_the_first(count: int, k: int) -> None:
    drawn = sample_evaluation(count, k)
    assert len(drawn) == k
    assert drawn[0] == 0
    assert drawn[-1] < count
    gaps = [b - a for a, b in itertools.pairwise(drawn)]
    assert all(between in (count // k, -(-count // k)) for between in gaps)


def test_the_store_gives_pictures_with_and_without_the_reference(
    tiny_videos: Path, tmp_path: Path, catalogue: Catalogue
) -> None:
    found = extract_frames(tiny_videos, catalogue, CONFIG, tmp_path, tmp_path / "partial")
    plain, subtracted = FrameStore(tmp_path), FrameStore(tmp_path, "subtract")
    references = np.load(tmp_path / "references.npy")
    for place, video in enumerate(found.videos):
        rows = [f.row for f in found.frames if f.video_id == video.video_id]
        assert plain.rows(video.video_id) == rows
        np.testing.assert_array_equal(plain.pictures(video.video_id), plain.pixels[rows])
        np.testing.assert_array_equal(
            subtracted.pictures(video.video_id), subtract(np.asarray(plain.pixels[rows]), references[place])
        )
        drawn = sample_evaluation(len(rows), 5)
        np.testing.assert_array_equal(
            subtracted.pictures(video.video_id, drawn), subtracted.pictures(video.video_id)[list(drawn)]
        )


@pytest.mark.parametrize(("file", "reference"), [("frames.npy", "none"), ("references.npy", "subtract")])
def test_a_store_with_a_row_too_few_is_an_error(tmp_path: Path, file: str, reference: str) -> None:
    write_frames(tmp_path, {"a_0": 4, "b_0": 1})
    np.save(tmp_path / file, np.load(tmp_path / file)[:-1])
    with pytest.raises(UserError, match="differ in length; run"):
        FrameStore(tmp_path, "subtract" if reference == "subtract" else "none")
