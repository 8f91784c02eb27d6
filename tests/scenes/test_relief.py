"""Bodies and every layer of relief against what their formulas say, and against themselves on another grid."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.scenes.geometry import IMAGE_MM, Bar, Round, Wedge, heights
from pipeline.scenes.grid import Grid
from pipeline.scenes.relief import AnyLayer, Creases, Digits, Domes, Grains, Plates, Ridges, Rough, Strands, Weave

GRID = Grid(320, 0.1)
LAYERS: tuple[AnyLayer, ...] = (
    Rough(rms=0.03, longest=2.0),
    Rough(rms=0.03, longest=2.0, stretch=4, angle=30),
    Creases(height=0.3, spacing=2.0),
    Domes(height=0.4, width=1.6, spacing=2.2),
    Domes(height=-0.4, width=2.4, spacing=2.2, jitter=1, occupied=0.7),
    Ridges(height=0.4, width=1.6, spacing=2.2, angle=25),
    Plates(height=0.5, size=(3, 2), gap=1, uneven=0.3),
    Weave(spacing=1.0, thread=0.8, crimp=0.3),
    Weave(spacing=0.8, thread=0.8, crimp=0.2, repeat=4),
    Strands(width=1.0, spacing=1.2, waver=0.4, bundles=3),
    Grains(length=4, width=2, thickness=1.5),
    Digits(height=-0.3, size=4, stroke=0.8, spacing=(4, 6)),
)


def patch(layer: AnyLayer, seed: int = 0, grid: Grid = GRID) -> np.ndarray:
    return layer.sample(grid, np.random.default_rng(seed))


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: layer.kind)
def test_statistics_do_not_depend_on_the_pitch(layer: AnyLayer) -> None:
    grids = [Grid(round(32 / pitch), pitch) for pitch in (0.06, 0.12)]
    fine, coarse = (np.mean([patch(layer, seed, grid).std() for seed in range(6)]) for grid in grids)
    assert fine == pytest.approx(coarse, rel=0.12)
    assert fine > 0.005


@given(st.sampled_from(LAYERS), st.integers(1, 40), st.floats(0.02, 5), st.integers(0, 9))
def test_any_grid_will_do(layer: AnyLayer, side: int, pitch: float, seed: int) -> None:
    found, again = (patch(layer, seed, Grid(side, pitch)) for _ in range(2))
    np.testing.assert_array_equal(found, again)
    assert (found.shape, found.dtype) == ((side, side), np.float32)
    assert np.isfinite(found).all()
    assert np.abs(found).max() < 10


@pytest.mark.parametrize("hurst", [0.3, 0.8])
def test_roughness_falls_off_with_its_hurst_exponent(hurst: float) -> None:
    """Power ~ q^-2(1 + H) in two dimensions, fitted over a decade of wavelengths; nothing beyond the longest."""
    side, pitch = 512, 0.05
    layer = Rough(rms=0.05, longest=4.0, hurst=hurst)
    q = np.hypot(np.fft.fftfreq(side, pitch)[:, None], np.fft.fftfreq(side, pitch)[None])
    power = np.mean([np.abs(np.fft.fft2(patch(layer, s, Grid(side, pitch)))) ** 2 for s in range(4)], axis=0)
    rings = [(q >= low) & (q < high) for low, high in itertools.pairwise(np.geomspace(0.5, 5, 12))]
    slope = np.polyfit(*(np.log([x[ring].mean() for ring in rings]) for x in (q, power)), 1)[0]
    assert slope == pytest.approx(-2 * (1 + hurst), abs=0.15)
    assert power[q < 0.99 / 4.0].sum() < 1e-6 * power.sum()


def test_stretched_roughness_is_longer_along_its_direction() -> None:
    field = patch(Rough(rms=0.05, longest=2, stretch=4, angle=0)).astype(float)
    along, across = (np.abs(np.diff(field, axis=a)).mean() for a in (0, 1))
    assert across > 2 * along


@pytest.mark.parametrize(("width", "spacing", "occupied"), [(1.0, 2.0, 1.0), (2.0, 2.5, 1.0), (1.5, 2.0, 0.6)])
def test_domes_cover_what_a_hexagonal_packing_covers(width: float, spacing: float, occupied: float) -> None:
    layer = Domes(height=0.3, width=width, spacing=spacing, occupied=occupied, jitter=0, uneven=0)
    covered = np.mean([(patch(layer, seed, Grid(700, 0.05)) > 1e-6).mean() for seed in range(4)])
    assert covered == pytest.approx(occupied * math.pi * width**2 / (2 * math.sqrt(3) * spacing**2), rel=0.05)
    assert patch(layer).max() == pytest.approx(0.3, rel=0.02)


def test_ridges_have_their_width_height_and_spacing() -> None:
    field = patch(Ridges(height=0.5, width=1.5, spacing=2.5), grid=Grid(1000, 0.02))
    assert (field > 1e-6).mean() == pytest.approx(1.5 / 2.5, rel=0.02)
    assert field.max() == pytest.approx(0.5, rel=1e-3)
    assert np.ptp(field, axis=0).max() < 1e-4, "they run along the body"
    np.testing.assert_allclose(field[:, :-125], field[:, 125:], atol=1e-3)


def test_plates_repeat_and_are_flat_on_top() -> None:
    field = patch(Plates(height=0.5, size=(3, 2), gap=1, edge=0.1), grid=Grid(800, 0.02))
    np.testing.assert_allclose(field[:-150, :-200], field[150:, 200:], atol=2e-3)
    superellipse = math.gamma(1.25) ** 2 / math.gamma(1.5)  # Area of x^4 + y^4 < 1 over its square.
    assert (field > 1e-6).mean() == pytest.approx(3 * 2 / (4 * 3) * superellipse, rel=0.02)
    assert (field > 0.499).mean() > 0.7 * (field > 1e-6).mean()


@pytest.mark.parametrize("repeat", [2, 4])
def test_cloth_repeats_both_ways_and_no_sooner(repeat: int) -> None:
    field = patch(Weave(spacing=1.0, thread=0.9, crimp=0.3, repeat=repeat), grid=Grid(600, 0.02))
    for along in (field, field.T):
        np.testing.assert_allclose(along[50 * repeat :], along[: -50 * repeat], atol=2e-3)
    assert np.abs(field[50:] - field[:-50]).max() > 0.1
    assert np.abs(field[50:, 50:] - field[:-50, :-50]).max() < (2e-3 if repeat == 2 else 1)
    assert field.max() == pytest.approx(0.15, abs=2e-3), "half the crimp over the middle"


def test_strands_are_cylinders() -> None:
    field = patch(Strands(width=2, spacing=3, uneven=0), grid=Grid(600, 0.01))
    assert field.max() == pytest.approx(0, abs=1e-4)
    assert (field > -1).mean() == pytest.approx(2 / 3, rel=0.02)
    assert (field[field > -1] + 1).mean() == pytest.approx(math.pi / 4, rel=0.02), "mean height of a half circle"


def test_folds_are_as_far_apart_as_rice_says() -> None:
    """Rice's formula: zeros of a Gaussian process along a line."""
    layer = Creases(height=1.0, spacing=2.0, fold=0)
    fields = np.array([patch(layer, seed, Grid(1024, 0.05)) for seed in range(6)])
    middle = fields[..., 1:-1]
    top = (middle > fields[..., :-2]) & (middle >= fields[..., 2:]) & (middle > 0.93)
    assert 6 * 1024 * 1024 * 0.05 / top.sum() == pytest.approx(2.0, rel=0.08)


@pytest.mark.parametrize("packing", [0.5, 1.5])
def test_grains_hide_the_ground_as_their_number_says(packing: float) -> None:
    """Less than the exp(-packing) of places drawn at will (Boolean model), for they are stratified."""
    layer = Grains(length=2, width=1.5, thickness=1.5, packing=packing, depth=0.3)
    fields = np.array([patch(layer, seed) for seed in range(4)])
    bare = (fields == fields.min(axis=(1, 2), keepdims=True)).mean()
    assert max(0, 1 - packing) < bare < math.exp(-packing)
    assert fields.max() <= 0


def test_digits_are_as_tall_as_asked_for() -> None:
    layer = Digits(height=0.4, size=5, stroke=0.6, spacing=(9, 60))
    fields = np.array([patch(layer, seed, Grid(800, 0.05)) for seed in range(8)])
    assert (fields > 0.2).any(axis=2).sum(axis=1).max() * 0.05 == pytest.approx(5, abs=0.4)
    assert 0.3 < fields.max() <= 0.4


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
