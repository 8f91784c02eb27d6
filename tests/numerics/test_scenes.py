"""Synthetic scenes at their edges: any force and modulus, flats, needles, rims of threads, relief, light.

The contact solver runs in the format of its gap, float64 or float32; what is made of it for the camera is float32.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from pipeline.scenes.contact import Method, press
from pipeline.scenes.elastic.kernels import Gel, Kernel, half_space_table, layer_table, make_kernel
from pipeline.scenes.elastic.solver import Solution, solve
from pipeline.scenes.grid import Grid
from pipeline.scenes.light import make_sensor, shade
from pipeline.scenes.relief import Rough, thread
from tests.numerics.bounds import summing
from tests.numerics.harness import FLOAT32, FLOAT64, SOLVED, Check, Floats, Format, formats

PART = "scenes"
TOLERANCE = 1e-4
"""Of the solver's residual."""
SIDE, PITCH = 32, 0.2


def ball(pitch: float = PITCH, side: int = SIDE, radius: float = 10.0) -> Floats:
    """The gap in mm under a ball in its parabolic approximation, side x side."""
    axis = (np.arange(side) - (side - 1) / 2) * pitch
    return (axis[None] ** 2 + axis[:, None] ** 2) / (2 * radius)


def half_space(fmt: Format, side: int = SIDE, pitch: float = PITCH) -> Kernel:
    """The kernel of a half-space of 1 MPa."""
    return make_kernel(half_space_table((side, side), pitch, 1.0), fmt)


def carried(found: Solution, pitch: float = PITCH) -> Floats:
    """The force in N that pressures add up to; NaN where the solver did not get there."""
    return np.where(found.converged, np.asarray(found.pressure, np.float64).sum(axis=(1, 2)) * pitch**2, np.nan)


CONTACTS: dict[str, tuple[Floats, list[float]]] = {
    "ball": (ball(), [0.0, 1e-12, 1e-6, 1.0, 1e6, 1e12]),
    "flat on flat": (np.zeros((SIDE, SIDE)), [2.0]),
    "contact everywhere": (ball(radius=500.0), [1e3]),
}


@formats(*SOLVED)
@pytest.mark.parametrize("name", CONTACTS)
def test_any_force_is_carried(check: Check, fmt: Format, name: str) -> None:
    """roundings: the pressures' mean is a sum over all pixels."""
    gap, forces = CONTACTS[name]
    for force in forces:
        found = solve(gap.astype(fmt), force, half_space(fmt), PITCH, tolerance=TOLERANCE)
        case, bound = f"{name} under {force:g} N: force carried", summing(SIDE * SIDE, fmt)
        check(case, fmt, lambda _, found=found: carried(found), bound, [force])


@formats(*SOLVED)
@pytest.mark.parametrize("ratio", [1e-4, 1e-2, 1.0, 1e2, 1e4])
def test_an_object_of_any_modulus_carries_its_force(check: Check, fmt: Format, ratio: float) -> None:
    """From a ten thousandth of the gel's modulus to ten thousand times as much; roundings: as above."""
    gap, gel = ball(0.3).astype(fmt), Gel()
    layers = layer_table(gap.shape, 0.3, gel) + half_space_table(gap.shape, 0.3, gel.modulus * ratio)
    found = solve(gap, [0.1, 10.0], make_kernel(layers, fmt), 0.3, tolerance=TOLERANCE)
    case = f"modulus {ratio:g} of the gel's: force carried"
    check(case, fmt, lambda _: carried(found, 0.3), summing(SIDE * SIDE, fmt), [0.1, 10.0])


@formats(*SOLVED)
def test_a_needle_sinks_in_by_loves_formula_for_one_pixel(check: Check, fmt: Format) -> None:
    """A single pixel stands out by 50 mm.

    roundings: two transforms, log2 N steps each of some 4 roundings (Higham 2002, theorem 24.2), N squares added.
    """
    gap = np.full((SIDE + 1, SIDE + 1), 50.0, fmt)
    gap[SIDE // 2, SIDE // 2] = 0
    found = solve(gap, 1e-3, half_space(fmt, SIDE + 1), PITCH)
    pixels = (2 * (SIDE + 1)) ** 2
    bound = 8 * math.log2(pixels) * math.sqrt(pixels) * fmt.roundoff
    exact = 1e-3 / PITCH**2 * half_space_table((1, 1), PITCH, 1.0)[0]
    check("needle: approach", fmt, lambda _: found.approach, bound, exact)
    assert found.converged.all()
    assert np.count_nonzero(found.pressure) == 1


@formats(*SOLVED)
def test_a_rough_ball_has_the_same_energy_in_both_formats(check: Check, fmt: Format) -> None:
    """The residual bounds how far an energy is from its minimum.

    Each of two solutions is off by twice the tolerance at most, since an energy is at least half of pressure times
    sink; the residual's two sums are rounded.
    """
    gap = ball(0.15) + 0.02 * np.random.default_rng(1).random((SIDE, SIDE))
    gap -= gap.min()

    def energy(f: Format) -> Floats:
        """Half of pressure times sink, and pressure times gap, in N mm, of three forces."""
        found = solve(gap.astype(f), [0.3, 2.0, 30.0], half_space(f, pitch=0.15), 0.15, tolerance=TOLERANCE)
        pressure = np.asarray(found.pressure, np.float64)
        sink = half_space(FLOAT64, pitch=0.15).sink(pressure)
        return np.where(found.converged, (pressure * (sink / 2 + gap)).sum(axis=(1, 2)) * 0.15**2, np.nan)

    check("rough ball: energy", fmt, energy, 2 * (TOLERANCE + 2 * summing(SIDE * SIDE, fmt)))


METHODS = (Method("winkler"), Method("layer", 32), Method("layer"), Method("half_space", 32), None)
"""None chooses by itself."""


def heights(body: str, side: int = 61) -> Floats:
    """In mm, side x side; a needle is one pixel."""
    if body == "needle":
        spike = np.full((side, side), -50.0)
        spike[side // 2, side // 2] = 0
        return spike
    smooth = np.zeros((side, side)) if body == "flat" else -ball(30 / side, side, 25.0)
    return smooth + 0.02 * np.random.default_rng(0).standard_normal((side, side)) * (body == "rough ball")


@pytest.mark.parametrize("body", ["ball", "rough ball", "flat", "needle"])
@pytest.mark.parametrize("method", METHODS, ids=str)
@pytest.mark.filterwarnings("ignore::pipeline.scenes.elastic.solver.NotConverged")
def test_an_imprint_is_finite_at_any_force_and_modulus(check: Check, method: Method | None, body: str) -> None:
    """What has not converged is rendered with its residual; here it must be finite all the same."""

    def imprint(f: Format) -> Floats:
        found = [
            press(heights(body).astype(f), force, 0.25 * ratio, 30 / 61, method)
            for force, ratio in ((0.0, 1.0), (1e-9, 1.0), (1e6, 1.0), (8.0, 1e-4), (8.0, 1e4))
        ]
        return np.concatenate([np.r_[one.skins.ravel(), one.radii] for one in found])

    check(f"imprint of a {body}, {method or 'auto'}: forces to 1e6 N, moduli to 1e4", FLOAT32, imprint)


def test_a_thread_is_round_up_to_its_rim(check: Check) -> None:
    """roundings: r^2 - x^2 cancels at the rim and is off by 6 u r^2 at most, its root by the root of that."""
    offset = np.linspace(0, 1, 257) ** 0.125 * 0.75
    exact = np.sqrt(0.75**2 - np.minimum(offset, 0.75) ** 2) - 0.75
    bound = math.sqrt(6 * FLOAT32.roundoff)
    check("thread: heights up to its rim", FLOAT32, lambda f: thread(offset.astype(f), 0.75), bound, exact)


@pytest.mark.parametrize("pitch", [1e-3, 0.1, 10.0])
@pytest.mark.parametrize("rms", [1e-6, 100.0])
def test_roughness_deviates_as_much_as_the_grid_carries(check: Check, rms: float, pitch: float) -> None:
    """Of a self-affine surface that is rms sqrt(1 - (2 pitch / longest)^2H); roundings: sums over all pixels."""
    layer = Rough(rms=rms, longest=25.0)
    found = layer.sample(Grid(SIDE, pitch), np.random.default_rng(0)).astype(np.float64).std()
    exact = rms * math.sqrt(max(0.0, 1 - (2 * pitch / layer.longest) ** (2 * layer.hurst)))
    name = f"roughness of {rms:g} mm, pixels of {pitch:g} mm: deviation"
    check(name, FLOAT32, lambda _: found, 2 * summing(SIDE * SIDE, FLOAT32), exact)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e6])
def test_light_on_any_slope_is_lamberts(check: Check, size: float) -> None:
    """On skin of white noise of a deviation of `size` mm, against Lambert's law in float64 before it is rounded.

    use: half a step of 8 bits; and roundings of some 20 operations on twice the lights' sum.
    """
    sensor = make_sensor(48, 36, 1)
    skin = np.float32(size) * np.random.default_rng(0).standard_normal((36, 48), dtype=np.float32)
    settings = {"scale": 1 / (8 * PITCH), "borderType": cv2.BORDER_REPLICATE}
    x, y = (cv2.Sobel(skin.astype(np.float64), cv2.CV_64F, i, 1 - i, **settings) for i in (1, 0))
    lit = [
        np.maximum((across * x + along * y + direct) / np.sqrt(1 + x * x + y * y), 0) - direct
        for direct, (across, along) in zip(sensor.direct, sensor.gains, strict=True)
    ]
    exact = np.clip((np.stack(lit, axis=-1) + sensor.glow) * sensor.dust + sensor.noise[:36, :48], 0, 255)
    bound = 0.5 / exact.max() + 20 * 2 * FLOAT32.roundoff
    check(f"light on noise of {size:g} mm", FLOAT32, lambda _: shade(skin, sensor, PITCH, 0), bound, exact)
