"""The benchmark of scenes, as small as it goes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.benchmarks import scenes
from pipeline.benchmarks.__main__ import SECTIONS
from pipeline.videos.catalogue import Catalogue
from pipeline.scenes.recipe import load_recipes
from tests.conftest import ROOT


@pytest.fixture
def two_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = {name: scenes.ways()[name] for name in ("layer, 64 cells", "winkler")}
    monkeypatch.setattr(scenes, "ways", lambda: chosen)
    monkeypatch.setattr(scenes, "VIDEOS", 1)


def test_sections_are_listed() -> None:
    assert SECTIONS["scenes"] is scenes.measure
    assert "realism" in SECTIONS


def test_the_solver_beats_springs_on_hertz() -> None:
    rows = {row.case: row for row in scenes.ball_rows(repeats=1)}
    springs = rows["ball, winkler"].error
    assert springs is not None
    for case, row in rows.items():
        assert row.error is not None
        assert row.low <= row.error <= row.high
        if "half_space" in case:
            assert row.error < 0.01 * springs
            assert row.radius is not None
            assert row.radius < 0.02
    # The same tolerance on finer grids, and tighter tolerances, are no worse.
    finest = rows["ball, half_space 256 cells 1e-06 float64"]
    assert finest.error < 1e-4
    assert rows["ball, half_space 32 cells 1e-06 float64"].error > finest.error


def test_ways_are_held_against_the_first(two_ways: None, catalogue: Catalogue) -> None:
    recipes = load_recipes(ROOT / "pipeline" / "physiclear", catalogue, 0)
    chosen = {o: recipes[o] for o in sorted(recipes)[::12]}
    pictures, labels = scenes.look_at(chosen, catalogue)
    first, springs = pictures
    assert (first.error, first.image) == (0.0, 0.0)
    assert springs.error is not None
    assert springs.error > 0.1
    assert (first.image_low, first.image_high) == (0.0, 0.0)
    assert springs.image is not None
    assert springs.image_low is not None
    assert springs.image_high is not None
    assert springs.image_low < springs.image < springs.image_high
    assert springs.ratio == 1
    assert [row.case for row in labels] == ["labels, layer, 64 cells", "labels, winkler"]
    for row in labels:
        assert row.error is not None
        assert 0 <= row.low <= row.error <= row.high <= 1


def test_an_interval_over_objects_is_students() -> None:
    """Three objects with means 1, 2 and 6: 3 plus and minus t (4.3027 with two degrees) times the root of 7 / 3."""
    errors = [("a", 0.5), ("a", 1.5), ("b", 2.0), ("b", 2.0), ("c", 5.0), ("c", 7.0)]
    assert scenes.over_objects(errors) == (0.0, pytest.approx(3 + 4.3027 * (7 / 3) ** 0.5, abs=1e-3))
    close = [(owner, 10 + error / 100) for owner, error in errors]
    assert scenes.over_objects(close) == (pytest.approx(9.964, abs=2e-3), pytest.approx(10.096, abs=2e-3))
    assert scenes.over_objects(errors[:2]) == (None, None)


def test_a_data_set_is_timed_and_weighed(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "PUBLIC_VIDEOS", 3)
    recipes = load_recipes(ROOT / "pipeline" / "physiclear", catalogue, 0)
    (row,) = scenes.write_rows({o: recipes[o] for o in ("egg", "pillow")})
    assert row.case.startswith("write 3 videos, ")
    assert row.bytes is not None
    assert row.bytes > 1000
    assert np.isfinite(row.cost)
