"""Bodies against their formulas, and a patch as the sum of what it is made of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.scenes.geometry import IMAGE_MM, Bar, Round, Wedge, heights
from pipeline.scenes.grid import Grid

PITCH = IMAGE_MM[0] / 160


@given(st.floats(1, 1e4), st.floats(1, 1e4), st.integers(1, 40), st.floats(0.01, 1))
def test_a_round_body_is_its_paraboloid(across: float, along: float, half: int, pitch: float) -> None:
    side = 2 * half + 1
    found = heights(Round(radii=(across, along)), (), side, pitch, np.random.default_rng(0))
    for row, column in ((half, half), (0, half), (half, 0), (side - 1, 0)):
        x, y = (column - half) * pitch, (row - half) * pitch
        assert found[row, column] == pytest.approx(-x * x / 2 / across - y * y / 2 / along, rel=1e-4, abs=1e-7)
    assert found.max() == 0
    assert found.dtype == np.float32


def test_a_bar_is_flat_and_falls_off_at_its_edges() -> None:
    bar = Bar(width=10, edge=2).sample(Grid(201, 0.1))
    x = (np.arange(201) - 100) * 0.1
    assert not bar[:, np.abs(x) < 2.9].any()
    assert bar[0, np.abs(x - 5).argmin()] == pytest.approx(-(2**2) / 4)
    assert (bar == bar[:1]).all()


def test_a_wedge_is_round_on_top_and_straight_far_from_it() -> None:
    slope, tip = 0.5, 1.0
    wedge = Wedge(slope=slope, tip=tip).sample(Grid(1601, 0.025))[0].astype(float)
    assert wedge[800] == 0
    assert np.diff(wedge, 2)[799] / 0.025**2 == pytest.approx(-1 / tip, rel=0.02)
    assert np.diff(wedge)[-1] / 0.025 == pytest.approx(-slope, rel=0.01)
    np.testing.assert_allclose(wedge, wedge[::-1], atol=1e-6)
