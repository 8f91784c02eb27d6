"""Maps of embeddings keep what is near, and are the same each time."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.core.records import Part
from pipeline.evaluation.maps import map_frame
from pipeline.videos.records import Assignment
from tests.evaluation.conftest import CATALOGUE


def videos(objects: int, each: int) -> list[Assignment]:
    names = list(CATALOGUE.objects)[:objects]
    return [Assignment(video_id=f"{o}_{i}", object_id=o, part=Part.TEST) for o in names for i in range(each)]


@pytest.mark.parametrize("count", [2, 3, 40])
def test_a_map_has_each_video_once_a_method_and_keeps_clusters_apart(count: int) -> None:
    tested = videos(count, 1)
    far = 20.0 * (np.arange(len(tested)) % 2)
    features = np.random.default_rng(0).normal(size=(len(tested), 8)) + far[:, None]
    found = map_frame(features, tested, CATALOGUE)
    assert found.equals(map_frame(features, tested, CATALOGUE)), "the same each time"
    for _, rows in found.groupby("method"):
        assert sorted(rows["video_id"]) == sorted(v.video_id for v in tested)
        assert np.isfinite(rows[["x", "y"]].to_numpy()).all()
        if count >= 40:
            places = rows[["x", "y"]].to_numpy()
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.where(np.eye(len(rows)), np.inf, 0)
            assert (far[apart.argmin(1)] == far).all()


def test_of_many_videos_a_map_has_some_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.evaluation.maps.MAPPED", 40)
    tested = videos(20, 3)
    found = map_frame(np.random.default_rng(0).normal(size=(60, 3)), tested, CATALOGUE)
    shown = found[found["method"] == "PCA"]
    assert len(shown) == 40
    assert shown["video_id"].str.rpartition("_")[0].nunique() == 20
