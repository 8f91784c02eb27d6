"""Synthetic pictures: each follows from seed and number alone, says what is so of its object, and survives kills."""

import itertools
import math
import os
import runpy
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

import pipeline.running.parallel
from pipeline.config import FramesConfig, PretrainConfig
from pipeline.core.io import read_table
from pipeline.core.layout import HISTORY_FILE, PRETRAINED, SHIPPED
from pipeline.core.records import Measurement
from pipeline.core.runtime import seed_everything
from pipeline.encoder import synthetic as module
from pipeline.encoder.pretrain import STRENGTH, PretrainingDataset, PretrainingModel, vary
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.synthetic import HEIGHT, KINDS, PITCH, SIDE, WIDTH, SyntheticPictures, draw_object, draw_pictures
from pipeline.running.errors import UserError
from pipeline.scales import compose, write_params
from pipeline.scenes.geometry import heights
from pipeline.scenes.invent import MODULUS_MPA, invent
from pipeline.scenes.measure import bump_share, texture
from pipeline.scenes.recipe import SceneRecipe
from pipeline.videos.frames.subtraction import subtract
from tests.closure import ROOT
from tests.frame_rules import pillow

CONFIG = PretrainConfig(objects=9, seed=5)
FRAMES = FramesConfig(pixels=32)


def equal(one: Iterable[np.ndarray], other: Iterable[np.ndarray]) -> bool:
    return all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.fixture(scope="module", autouse=True)
def few_sensors() -> Iterator[None]:
    """Making all of them takes each process seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SENSORS", 3)
        module.sensors.cache_clear()
        yield
    module.sensors.cache_clear()


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> SyntheticPictures:
    """Drawn in three chunks, by as many processes as there are cores."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CHUNK", 4)
        return draw_pictures(CONFIG, FRAMES, tmp_path_factory.mktemp("pictures"))


@pytest.mark.slow
def test_an_object_follows_from_seed_and_number_alone(drawn: SyntheticPictures) -> None:
    other = PretrainConfig(objects=5000, seed=5, steps=7)
    for number in (8, 0):
        np.random.seed(number)
        assert equal(draw_object(number, other, FRAMES), [array[[number]] for array in drawn])
    assert len({pictures.tobytes() for pictures in drawn.pictures}) == 9
    elsewhere = draw_object(0, CONFIG.model_copy(update={"seed": 6}), FRAMES)
    assert not any(np.array_equal(elsewhere.pictures[0], p) for p in drawn.pictures)
    assert (elsewhere.quantities[0, 0, 0] != drawn.quantities[:, 0, 0]).all()


@pytest.mark.slow
def test_a_killed_drawing_goes_on(drawn: SyntheticPictures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.running.parallel, "cores", lambda: 1)
    monkeypatch.setattr(module, "CHUNK", 4)

    def dying(number: int, config: PretrainConfig, frames: FramesConfig) -> SyntheticPictures:
        if number == 5:
            os._exit(9)
        return draw_object(number, config, frames)

    with monkeypatch.context() as patch:
        patch.setattr(module, "draw_object", dying)
        with pytest.raises(UserError):
            draw_pictures(CONFIG, FRAMES, tmp_path)
    (finished,) = tmp_path.glob("[0-9]*.npz")
    assert finished.name == "000000.npz"
    before = finished.stat().st_mtime_ns
    assert equal(draw_pictures(CONFIG, FRAMES, tmp_path), drawn)
    assert finished.stat().st_mtime_ns == before, "not drawn again"


def test_pictures_have_their_shapes_and_ranges(drawn: SyntheticPictures) -> None:
    assert [array.shape for array in drawn] == [(9, 3, 32, 32, 3), (9, 3, 16), (9, len(KINDS))]
    assert np.isfinite(drawn.quantities).all()
    assert (drawn.kinds[:, -4:].sum(axis=1) == 1).all(), "one body each"
    assert (drawn.kinds[:, :-4].sum(axis=1) <= 3).all(), "three layers at most"
    modulus, force, radius, _, bumps, *_ = drawn.quantities.transpose(2, 0, 1)
    assert (modulus == modulus[:, :1]).all(), "the object's, whatever the press"
    assert ((modulus >= np.log10(MODULUS_MPA[0])) & (modulus <= np.log10(MODULUS_MPA[1]))).all()
    assert ((force >= np.log10(module.FORCES[0])) & (force <= np.log10(module.FORCES[1]))).all()
    assert (np.diff(force, axis=1) > 0).all()
    assert (np.diff(radius, axis=1) > -1e-6).all(), "pressed harder, nothing loses contact"
    assert ((bumps >= 0) & (bumps <= 1)).all()


@pytest.mark.parametrize("number", [12, 15])
def test_quantities_are_measured_where_they_are_shown(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Texture of the whole surface; bumps and depth of the skin in view, under each force."""
    fields: dict[str, list[np.ndarray]] = {"texture": [], "bump_share": []}
    for name, seen in fields.items():
        own = getattr(module, name)
        monkeypatch.setattr(module, name, lambda f, p, own=own, seen=seen: (seen.append(f), own(f, p))[1])
    told = draw_object(number, CONFIG, FRAMES).quantities[0].astype(np.float64)
    (surface,), skins = fields["texture"], fields["bump_share"]
    assert surface.shape == (SIDE, SIDE)
    assert {skin.shape for skin in skins} == {(HEIGHT, WIDTH)}
    np.testing.assert_allclose(10 ** told[:, 3] - 5e-4, texture(surface, PITCH), rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(told[:, 4], [bump_share(skin, PITCH) for skin in skins], atol=1e-6)
    np.testing.assert_allclose(told[:, 5], [math.log10(skin.max() + 1e-3) for skin in skins], atol=1e-5)


@pytest.mark.parametrize("length", [0.6, 2.4, 7.0])
def test_bands_tell_a_wave_as_the_filters_transfer_says(length: float) -> None:
    """A Gaussian filter of cutoff c passes 2^-(c / L)^2 of a sine of wavelength L (ISO 16610-21)."""
    wave = np.tile(0.1 * np.sin(2 * np.pi * PITCH / length * np.arange(SIDE)), (SIDE, 1)).astype(np.float32)
    inner = np.zeros((SIDE, SIDE), bool)
    inner[:, 60:-60] = True  # Filters lack neighbours at the border.
    left, expected = 0.1, []
    for cutoff in (0.3, 0.6, 1.2, 2.4, 4.8):
        passed = left * 2 ** -((cutoff / length) ** 2)
        expected.append((left - passed) / math.sqrt(2))
        left = passed
    found = 10.0 ** np.array(module._bands(wave, inner)) - 1e-3
    assert found[0] == pytest.approx(expected[0], rel=0.25), "half a pixel wide, a Gaussian is only nearly one"
    np.testing.assert_allclose(found[1:], expected[1:], rtol=0.06, atol=3e-4)
    assert module._bands(wave, ~(inner | ~inner)) == [-3.0] * 5, "nothing touches, nothing to tell"


def test_a_press_that_touches_nothing_shows_128(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the sensor; what is left is noise, doubled, and what coding makes of it."""
    shade = module.shade
    monkeypatch.setattr(module, "shade", lambda skin, *rest: shade(np.zeros_like(skin), *rest))
    for number in range(2):
        pictures = draw_object(number, CONFIG, FRAMES).pictures.astype(float)
        assert np.abs(pictures.mean(axis=(2, 3)) - 128).max() < 1
        assert pictures.std(axis=(2, 3)).max() < 4
        assert np.abs(pictures - 128).max() < 25


@pytest.mark.parametrize(("fit", "size"), [("crop", 16), ("squash", 150)])
def test_pictures_are_fitted_as_frames_of_videos(fit: str, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against PIL, and in RGB: the difference of what is lit to the same sensor's background."""
    sensor = module.sensors()[0]
    background = cv2.convertScaleAbs(sensor.background)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / 12
    waves = np.stack([30 * np.sin(x + c) * np.cos(y) + 10 * np.sin(y) for c in range(3)], axis=2)
    lit = np.clip(background + waves, 0, 255).astype(np.uint8)
    monkeypatch.setattr(module, "shade", lambda *_: lit)
    skin = np.zeros((HEIGHT, WIDTH), np.float32)
    found = module._picture(skin, sensor, np.random.default_rng(0), FramesConfig(pixels=size, fit=fit)).astype(float)
    frame, reference = (pillow(np.ascontiguousarray(picture[..., ::-1]), size, fit) for picture in (lit, background))
    expected = subtract(frame[None], reference)[0]
    assert np.abs(found - expected).mean() < 2 * 2.5, "a difference is shown doubled; coding included"
    assert np.abs(found - expected[..., ::-1]).mean() > 4 * 2.5


ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
RAMPS = np.repeat(np.stack([ramp, ramp, ramp])[..., None], 3, axis=3)
"""Three presses that show every value once in every channel."""


def test_presses_are_mirrored_alike_and_strengths_turn_about_the_middle() -> None:
    """128 + g (v - 128), rounded and cut at the ends: one factor a press, one of four ways for all."""
    before, ways, steps = RAMPS.copy(), [], np.arange(256) - 128.0
    for seed in range(40):
        found = vary(RAMPS, np.random.default_rng(seed))
        assert np.array_equal(found, vary(RAMPS, np.random.default_rng(seed))), "repeatable"
        # The ramps rise to the right and, more, downwards.
        press = found[0, ..., 0].astype(int)
        ways.append((press[-1, 0] < press[0, 0], press[8, -1] < press[8, 0]))
        turned = np.flip(found, tuple(axis for axis, is_turned in zip((1, 2), ways[-1], strict=True) if is_turned))
        gains = []
        for press in turned.astype(int):
            assert (press == press[..., :1]).all(), "all channels alike"
            values = press[..., 0].ravel()
            inside = (values > 0) & (values < 255)
            gains.append(float(steps[inside] @ (values[inside] - 128.0) / (steps[inside] @ steps[inside])))
            assert np.abs(values - np.clip(128 + gains[-1] * steps, 0, 255)).max() < 1.6
            assert values[128] == 128
        assert STRENGTH[0] - 0.01 < min(gains) <= max(gains) < STRENGTH[1] + 0.01
        assert len(set(gains)) == 3, "each press has its own"
    assert min(map(ways.count, itertools.product((False, True), repeat=2))) > 3
    assert np.array_equal(RAMPS, before), "what was given stays"


def test_an_item_of_a_training_depends_on_seed_epoch_and_number_alone(drawn: SyntheticPictures) -> None:
    def shown(seed: int, epoch: int) -> bytes:
        data = PretrainingDataset(drawn, augment=True, seed=seed)
        data.epoch = epoch
        return data[3]["frames"].numpy().tobytes()

    assert shown(1, 0) == shown(1, 0)
    assert len({shown(1, 0), shown(2, 0), shown(1, 1)}) == 3
    plain = PretrainingDataset(drawn, augment=False, seed=1)
    assert len(plain) == 9
    sources = {"frames": drawn.pictures, "quantities": drawn.quantities, "kinds": drawn.kinds.astype(np.float32)}
    for name, source in sources.items():
        assert plain[3][name].numpy().dtype == source.dtype
        np.testing.assert_array_equal(plain[3][name].numpy(), source[3])


@given(st.integers(0, 2**62))
@settings(max_examples=40)
def test_what_is_invented_can_be_made(seed: int) -> None:
    recipe = invent(np.random.default_rng(seed))
    assert SceneRecipe.model_validate_json(recipe.model_dump_json()) == recipe
    assert recipe == invent(np.random.default_rng(seed))
    assert MODULUS_MPA[0] <= recipe.modulus <= MODULUS_MPA[1]
    kinds = [layer.kind for layer in recipe.relief]
    assert len(kinds) == len(set(kinds)) <= 3
    assert {*kinds, recipe.body.kind} <= set(KINDS)
    surface = heights(recipe.body, recipe.relief, 65, 0.25, np.random.default_rng(seed))
    assert (surface.shape, surface.dtype) == ((65, 65), np.float32)
    assert np.isfinite(surface).all()
    assert surface.max() < 20, "in mm: nothing stands out farther than the sensor is wide"


def test_the_loss_weighs_standardised_quantities_and_kinds() -> None:
    """From what the head says, by hand in float64; the first quantity never changes, and its deviation is 0."""
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 256, (6, 2, 32, 32, 3), dtype=np.uint8)
    quantities = rng.normal(3, 5, size=(6, 2, 4)).astype(np.float32)
    pictures = SyntheticPictures(frames, quantities, rng.integers(0, 2, (6, 3)).astype(np.uint8))
    pictures.quantities[..., 0] = 7
    seed_everything(0)
    model = PretrainingModel(SceneEncoder(), pictures).eval()
    arrays = (pictures.pictures, pictures.quantities, pictures.kinds.astype(np.float32))
    with torch.no_grad():
        found = {n: v.item() for n, v in model(*map(torch.from_numpy, arrays)).items()}
        features = model.encoder(torch.from_numpy(pictures.pictures).flatten(0, 1), torch.zeros(12))
        told = model.head(features).double().numpy().reshape(6, 2, 7)
    exact = pictures.quantities.astype(np.float64)
    off = np.abs(told[..., :4] - (exact - exact.mean(axis=(0, 1))) / (exact.std(axis=(0, 1)) + 1e-6))
    huber = np.where(off < 1, off**2 / 2, off - 0.5).mean()
    chances, present = expit(told[..., 4:]), pictures.kinds[:, None].astype(float)
    flags = -(present * np.log(chances) + (1 - present) * np.log(1 - chances)).mean()
    assert found["quantities"] == pytest.approx(huber, rel=1e-5)
    assert found["kinds"] == pytest.approx(flags, rel=1e-5)
    assert found["loss"] == pytest.approx(2 * huber + 0.6 * flags, rel=1e-5)


def test_a_run_that_starts_from_a_model_takes_its_backbone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    params = compose("small", [f"language.start={SHIPPED}"], conf=ROOT / "conf")
    write_params(params)
    script = str(ROOT / "stages" / "pretrain.py")
    made_before = runpy.run_path(script, run_name="__main__")["made_before"]
    theirs = SHIPPED / "encoder" / "scenes.safetensors"
    assert PRETRAINED.read_bytes() == theirs.read_bytes()
    assert not read_table(PRETRAINED.with_name(HISTORY_FILE), Measurement)
    assert made_before(params) == theirs
    from_it = f"language.start={SHIPPED}"
    others = [(from_it, other) for other in ("pretrain.steps=899", "frames.pixels=96", "frames.fit=crop")]
    for other in (*others, ["language.start=models/other"], ["language.start=''"]):
        assert made_before(compose("small", other, conf=ROOT / "conf")) is None, other
