"""Light on the gel's skin, against normals computed in another way, and what must not change a picture."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from pipeline.scenes.light import NOISE, Sensor, make_sensor, shade

WIDTH, HEIGHT, PITCH = 96, 72, 0.2
FLAT = np.zeros((HEIGHT, WIDTH), np.float32)


def quiet(sensor: Sensor) -> Sensor:
    """The same without noise and dust."""
    return dataclasses.replace(sensor, noise=np.zeros_like(sensor.noise), dust=np.ones_like(sensor.dust))


def bump(height: float, wide: float) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    square = ((x - (WIDTH - 1) / 2) ** 2 + (y - (HEIGHT - 1) / 2) ** 2) * PITCH**2
    return (height * np.exp(-square / (2 * wide**2))).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_flat_skin_is_the_background_within_the_noise(seed: int) -> None:
    sensor = make_sensor(WIDTH, HEIGHT, seed)
    frame = shade(FLAT, sensor, PITCH, 7)
    assert frame.dtype == np.uint8
    error = frame - sensor.background
    assert np.abs(error).max() < 6 * NOISE
    assert error.std() == pytest.approx(NOISE, rel=0.1)
    np.testing.assert_array_equal(shade(FLAT, quiet(sensor), PITCH, 7), cv2.convertScaleAbs(sensor.glow))


def test_red_comes_from_above_green_from_the_right_blue_from_below() -> None:
    """As in the real videos: a bulge's upper flank is redder than flat skin, its lower flank bluer."""
    sensor = quiet(make_sensor(WIDTH, HEIGHT, 0))
    change = shade(bump(1.0, 1.5), sensor, PITCH, 0).astype(int) - shade(FLAT, sensor, PITCH, 0)
    row, column = HEIGHT // 2, WIDTH // 2
    upper, lower, left, right = change[[row - 7, row + 7, row, row], [column, column, column - 7, column + 7]]
    assert upper[2] > 10 > -10 > lower[2]
    assert lower[0] > 10 > -10 > upper[0]
    assert right[1] > 10 > -10 > left[1]


def test_drift_carries_the_marks_and_nothing_else() -> None:
    sensor = make_sensor(WIDTH, HEIGHT, 1)
    bare, marked = quiet(sensor), dataclasses.replace(quiet(sensor), dust=sensor.dust)
    assert (sensor.dust < 0.9).any()

    def shown(sensor: Sensor, x: float, y: float) -> np.ndarray:
        return shade(bump(0.5, 2.0), sensor, PITCH, 0, (np.full_like(FLAT, x), np.full_like(FLAT, y)))

    still, plain = (shade(bump(0.5, 2.0), each, PITCH, 0) for each in (marked, bare))
    np.testing.assert_array_equal(shown(marked, 0, 0), still)
    moved = shown(marked, 4 * PITCH, -3 * PITCH)
    assert (moved != still).any()
    shifted = np.ones_like(sensor.dust)
    shifted[:-3, 4:] = sensor.dust[3:, :-4]
    assert np.abs(moved - plain * shifted).max() <= 1.01, "right and up"
    np.testing.assert_array_equal(shown(bare, 1, 1), plain)
