"""Lessons: each follows from seed and number alone, says what is so of its object, and survives kills and bad light."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, log_softmax

import pipeline.parallel
from pipeline.data import lessons as module
from pipeline.data.lessons import (
    BODIES,
    FORCES,
    HEIGHT,
    KINDS,
    PITCH,
    QUANTITIES,
    SIDE,
    WIDTH,
    Lessons,
    draw_lesson,
    draw_lessons,
    sensors,
)
from pipeline.errors import UserError
from pipeline.frames.subtraction import subtract
from pipeline.models.scene_encoder import LessonModel, SceneEncoder
from pipeline.runtime import seed_everything
from pipeline.scenes.geometry import heights
from pipeline.scenes.invent import LAYERS, MODULUS_MPA, invent
from pipeline.scenes.light import Sensor
from pipeline.scenes.measure import Measured, measure
from pipeline.scenes.recipe import Recipe
from pipeline.sections import FramesConfig, PretrainConfig
from pipeline.training.pretrain import Disturbance, LessonDataset, disturb, held_out, lesson_model
from tests.frame_rules import pillow

CONFIG = PretrainConfig(objects=9, presses=3, seed=5)
FRAMES = FramesConfig(size=32)
ARRAYS = ("pictures", "quantities", "kinds", "classes")


def equal(one: Lessons, other: Lessons) -> bool:
    pairs = [(getattr(one, name), getattr(other, name)) for name in ARRAYS]
    return all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in pairs)


def row(lessons: Lessons, number: int) -> Lessons:
    return Lessons(*(getattr(lessons, name)[number : number + 1] for name in ARRAYS))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Lessons:
    """Drawn in three chunks, by as many processes as there are cores."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CHUNK", 4)
        return draw_lessons(CONFIG, FRAMES, tmp_path_factory.mktemp("lessons"))


# Drawing


@pytest.mark.parametrize("number", [0, 3, 4, 8])
def test_a_lesson_alone_is_the_same_as_among_others(number: int, drawn: Lessons) -> None:
    """Whatever else the settings say, and whatever was drawn before."""
    np.random.seed(number)
    other = PretrainConfig(objects=5000, presses=3, seed=5, steps=7, batch_size=1, augment=False)
    assert equal(draw_lesson(number, other, FRAMES), row(drawn, number))


def test_lessons_differ_by_number_and_by_seed(drawn: Lessons) -> None:
    assert len({drawn.pictures[i].tobytes() for i in range(9)}) == 9
    elsewhere = draw_lesson(0, CONFIG.model_copy(update={"seed": 6}), FRAMES)
    assert not any(np.array_equal(elsewhere.pictures[0], p) for p in drawn.pictures)
    assert (elsewhere.quantities[0, 0, 0] != drawn.quantities[:, 0, 0]).all()


@pytest.mark.parametrize(("processes", "chunk"), [(1, 50), (3, 1)])
def test_the_number_of_processes_and_chunks_changes_nothing(
    processes: int, chunk: int, drawn: Lessons, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline.parallel, "cores", lambda: processes)
    monkeypatch.setattr(module, "CHUNK", chunk)
    assert equal(draw_lessons(CONFIG, FRAMES, tmp_path), drawn)


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("death", "error"),
    [(interrupt, KeyboardInterrupt), (lambda: os._exit(9), UserError)],
    ids=["interrupted", "killed"],
)
def test_a_killed_drawing_keeps_what_is_finished_and_ends_the_same(
    death: Callable[[], None],
    error: type[BaseException],
    drawn: Lessons,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pipeline.parallel, "cores", lambda: 1)
    monkeypatch.setattr(module, "CHUNK", 4)
    with monkeypatch.context() as patch:

        def until(number: int, config: PretrainConfig, frames: FramesConfig) -> Lessons:
            if number == 5:
                death()
            return draw_lesson(number, config, frames)

        patch.setattr(module, "draw_lesson", until)
        with pytest.raises(error):
            draw_lessons(CONFIG, FRAMES, tmp_path)
    finished = {int(f.stem) for f in tmp_path.glob("[0-9]*.npz")}
    assert 0 in finished
    assert 4 not in finished
    assert finished <= {0, 8}

    def only_others(number: int, config: PretrainConfig, frames: FramesConfig) -> Lessons:
        assert number // 4 * 4 not in finished, "drawn again"
        return draw_lesson(number, config, frames)

    monkeypatch.setattr(module, "draw_lesson", only_others)
    assert equal(draw_lessons(CONFIG, FRAMES, tmp_path), drawn)


# What is told


def test_lessons_have_their_shapes_and_ranges(drawn: Lessons) -> None:
    assert (drawn.pictures.shape, drawn.pictures.dtype) == ((9, 3, 32, 32, 3), np.uint8)
    assert (drawn.quantities.shape, drawn.quantities.dtype) == ((9, 3, len(QUANTITIES)), np.float32)
    assert (drawn.kinds.shape, drawn.kinds.dtype) == ((9, len(KINDS)), np.uint8)
    assert (drawn.classes.shape, drawn.classes.dtype) == ((9, 3), np.int64)
    assert np.isfinite(drawn.quantities).all()
    assert set(np.unique(drawn.kinds)) == {0, 1}
    assert (drawn.kinds[:, -len(BODIES) :].sum(axis=1) == 1).all(), "one body each"
    assert (drawn.kinds[:, : -len(BODIES)].sum(axis=1) <= 3).all(), "three layers at most"
    assert ((drawn.classes >= 0) & (drawn.classes <= 2)).all()
    told = {name: drawn.quantities[..., i] for i, name in enumerate(QUANTITIES)}
    modulus, force, radius = (told[f"log10 {name}"] for name in ("modulus", "force", "contact radius"))
    assert (modulus == modulus[:, :1]).all(), "the object's, whatever the press"
    assert ((modulus >= np.log10(MODULUS_MPA[0])) & (modulus <= np.log10(MODULUS_MPA[1]))).all()
    assert ((force >= np.log10(FORCES[0])) & (force <= np.log10(FORCES[1]))).all()
    assert (np.diff(force, axis=1) > 0).all()
    assert (np.diff(radius, axis=1) > -1e-6).all(), "pressed harder, nothing loses contact"
    assert ((told["bump share"] >= 0) & (told["bump share"] <= 1)).all()


@pytest.mark.parametrize("number", range(12, 20))
def test_classes_are_those_that_the_scene_measures_as(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the surface and the skin under the largest force; and from the quantities, which must say the same."""
    surfaces: list[np.ndarray] = []
    skins: list[np.ndarray] = []
    texture, share = module.texture, module.bump_share

    def note_surface(surface: np.ndarray, pitch: float) -> float:
        surfaces.append(surface)
        assert pitch == PITCH
        return texture(surface, pitch)

    def note_skin(skin: np.ndarray, pitch: float) -> float:
        skins.append(skin)
        return share(skin, pitch)

    monkeypatch.setattr(module, "texture", note_surface)
    monkeypatch.setattr(module, "bump_share", note_skin)
    lesson = draw_lesson(number, CONFIG, FRAMES)
    (surface,), (*_, last) = surfaces, skins
    assert surface.shape == (SIDE, SIDE)
    assert last.shape == (HEIGHT, WIDTH)
    told = lesson.quantities[0].astype(np.float64)
    modulus = float(10 ** told[-1, 0])
    found = measure(modulus, surface, last, PITCH)
    assert lesson.classes[0].tolist() == [found.hardness, found.roughness, found.bumpiness]
    again = Measured(modulus, float(10 ** told[-1, 3]) - 5e-4, float(told[-1, 4]))
    assert lesson.classes[0].tolist() == [again.hardness, again.roughness, again.bumpiness]
    assert told[:, 5] == pytest.approx([math.log10(skin.max() + 1e-3) for skin in skins], abs=1e-5)


def test_bumps_are_those_under_the_largest_force(monkeypatch: pytest.MonkeyPatch) -> None:
    shares = iter([0.5, 0.0, 0.2])
    monkeypatch.setattr(module, "bump_share", lambda *_: next(shares))
    lesson = draw_lesson(0, CONFIG, FRAMES)
    assert lesson.quantities[0, :, 4] == pytest.approx([0.5, 0.0, 0.2])
    assert lesson.classes[0, 2] == 1


@pytest.mark.parametrize("length", [0.6, 1.2, 2.4, 4.8, 7.0])
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


# Pictures


def test_pictures_are_differences_to_the_untouched_gel(drawn: Lessons) -> None:
    """Where it touches least, at the border, every channel lies about 128."""
    ring = np.ones((32, 32), bool)
    ring[4:-4, 4:-4] = False
    border = drawn.pictures[:, :, ring].astype(float)
    assert np.abs(np.median(border, axis=2) - 128).max() <= 1
    assert np.abs(border.mean() - 128) < 2
    assert drawn.pictures[:, :, 10:22, 10:22].std(axis=(2, 3)).mean() > 2 * border.std(axis=2).min()


def test_a_press_that_touches_nothing_shows_128(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the sensor; what is left is noise, doubled, and what coding makes of it."""
    shade = module.shade
    monkeypatch.setattr(module, "shade", lambda skin, *rest: shade(np.zeros_like(skin), *rest))
    for number in range(4):
        pictures = draw_lesson(number, CONFIG, FRAMES).pictures.astype(float)
        assert np.abs(pictures.mean(axis=(2, 3)) - 128).max() < 1
        assert pictures.std(axis=(2, 3)).max() < 4
        assert np.abs(pictures - 128).max() < 25


@pytest.mark.parametrize(("fit", "size"), [("crop", 16), ("crop", 60), ("squash", 48), ("crop", 128), ("squash", 150)])
def test_frames_are_fitted_as_those_of_videos(fit: str, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against PIL, and in RGB; a press's frame and reference are of one sensor."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / 12
    waves = np.stack([120 + 60 * np.sin(x + c) * np.cos(y) + 20 * np.sin(y) for c in range(3)], axis=2).astype(np.uint8)
    seen: list[Sensor] = []
    taken: list[tuple[np.ndarray, np.ndarray]] = []

    def light(_: np.ndarray, sensor: Sensor, pitch: float, seed: int) -> np.ndarray:
        seen.append(sensor)
        return waves

    def note(frames: np.ndarray, reference: np.ndarray) -> np.ndarray:
        taken.append((frames[0], reference))
        return subtract(frames, reference)

    monkeypatch.setattr(module, "shade", light)
    monkeypatch.setattr(module, "subtract", note)
    lesson = draw_lesson(2, CONFIG, FramesConfig(size=size, fit=fit))
    assert lesson.pictures.shape == (1, 3, size, size, 3)
    for sensor, (frame, reference), shown in zip(seen, taken, lesson.pictures[0], strict=True):
        for found, whole in ((frame, waves), (reference, cv2.convertScaleAbs(sensor.background))):
            expected = pillow(np.ascontiguousarray(whole[..., ::-1]), size, fit).astype(float)
            assert np.abs(found - expected).mean() < 2.5, "coding included"
        np.testing.assert_array_equal(shown, subtract(frame[None], reference)[0])


def test_sensors_are_made_once_and_differ() -> None:
    assert sensors() is sensors()
    assert len({s.background.tobytes() for s in sensors()}) == len(sensors()) == 24
    assert all(s.background.shape == (HEIGHT, WIDTH, 3) for s in sensors())


# Disturbing


ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
RAMPS = np.repeat(np.stack([ramp, ramp, ramp])[..., None], 3, axis=3)
"""Three presses that show every value once in every channel."""
NOTHING = Disturbance(strength=0, tint=0, shift=0, noise=0)


def mirrored(pictures: np.ndarray) -> list[np.ndarray]:
    return [np.flip(pictures, axes) for axes in ((), (1,), (2,), (1, 2))]


def upright(pictures: np.ndarray) -> np.ndarray:
    """The ramps turned back: on average they rise to the right and downwards."""
    across, down = pictures[:, :, -1].mean() - pictures[:, :, 0].mean(), pictures[:, -1].mean() - pictures[:, 0].mean()
    return np.flip(pictures, tuple(axis for axis, rise in ((1, down), (2, across)) if rise < 0))


def test_no_disturbance_only_mirrors() -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 3), dtype=np.uint8)
    before = pictures.copy()
    ways = []
    for seed in range(60):
        found = disturb(pictures, NOTHING, np.random.default_rng(seed))
        ways += [i for i, way in enumerate(mirrored(pictures)) if np.array_equal(way, found)]
    assert len(ways) == 60, "all presses alike, in one of four ways"
    assert min(ways.count(i) for i in range(4)) > 5
    assert np.array_equal(pictures, before), "what was given stays"


@given(
    st.integers(0, 10**6),
    *(st.floats(0, top, allow_subnormal=False) for top in (3, 1, 60, 200)),
    st.sampled_from([0, 1, 127, 128, 254, 255]),
)
def test_disturbed_pictures_stay_pictures(
    seed: int, strength: float, tint: float, shift: float, noise: float, value: int
) -> None:
    amount = Disturbance(strength, tint, shift, noise)
    pictures = np.full((2, 6, 5, 3), value, np.uint8)
    found = disturb(pictures, amount, np.random.default_rng(seed))
    assert (found.shape, found.dtype) == (pictures.shape, np.uint8)
    assert np.array_equal(found, disturb(pictures, amount, np.random.default_rng(seed))), "the generator alone decides"
    if value == 128 and shift == noise == 0:
        assert (found == 128).all()


@given(st.integers(0, 10**6), st.floats(0, 2), st.floats(0, 0.5))
def test_gains_turn_about_the_middle(seed: int, strength: float, tint: float) -> None:
    """128 + g (v - 128), rounded and cut at the ends: one factor a press, and one on top a channel."""
    found = upright(disturb(RAMPS, Disturbance(strength, tint, 0, 0), np.random.default_rng(seed)).astype(int))
    gains = np.empty((3, 3))
    for press in range(3):
        for channel in range(3):
            values = found[press, ..., channel].ravel()
            inside = (values > 0) & (values < 255)
            given_ = np.arange(256)[inside] - 128.0
            gain = float(given_ @ (values[inside] - 128.0) / (given_ @ given_))
            assert np.abs(values - np.clip(128 + gain * (np.arange(256) - 128), 0, 255)).max() < 1.6
            assert values[128] == 128
            gains[press, channel] = gain
    assert (np.abs(np.log(gains)) <= strength + tint + 0.02).all()
    assert np.log(gains.max(axis=1) / gains.min(axis=1)).max() <= 2 * tint + 0.04


def test_shifts_move_each_channel_of_each_press_as_a_whole() -> None:
    moves = []
    for seed in range(40):
        found = upright(disturb(RAMPS, Disturbance(0, 0, 4, 0), np.random.default_rng(seed)).astype(int))
        moved = (found - RAMPS)[:, 2:-2]  # Away from what is cut at 0 and 255.
        assert (moved == moved[:, :1, :1]).all()
        moves.append(moved[:, 0, 0])
    assert np.std(moves) == pytest.approx(4, rel=0.15)
    assert abs(np.mean(moves)) < 1
    assert np.std(np.array(moves).std(axis=1)) > 0, "presses differ"


def test_noise_is_no_more_than_said_and_differs_between_presses() -> None:
    grey = np.full((4, 64, 64, 3), 128, np.uint8)
    found = np.concatenate([disturb(grey, Disturbance(0, 0, 0, 6), np.random.default_rng(s)) for s in range(20)])
    deviations = found.astype(float).std(axis=(1, 2, 3))
    assert deviations.max() < 6.2
    assert deviations.mean() == pytest.approx(3, abs=0.6), "even from 0 to 6"
    assert np.abs(found.mean(axis=(1, 2, 3)) - 128).max() < 0.3


def test_a_lesson_of_a_training_depends_on_seed_epoch_and_number_alone(drawn: Lessons) -> None:
    data = LessonDataset(drawn, augment=Disturbance(), seed=1)
    first = data[3]["frames"]
    assert torch.equal(first, LessonDataset(drawn, augment=Disturbance(), seed=1)[3]["frames"])
    assert not torch.equal(first, LessonDataset(drawn, augment=Disturbance(), seed=2)[3]["frames"])
    data.follow(lambda: 1)
    assert not torch.equal(first, data[3]["frames"])
    data.follow(lambda: 0)
    assert torch.equal(first, data[3]["frames"])
    plain = LessonDataset(drawn, augment=None, seed=1)
    assert len(plain) == 9
    for name, kind in (("frames", torch.uint8), ("quantities", torch.float32), ("kinds", torch.float32)):
        assert plain[3][name].dtype == kind
        source = drawn.pictures if name == "frames" else getattr(drawn, name)
        np.testing.assert_array_equal(plain[3][name].numpy(), source[3])
    np.testing.assert_array_equal(plain[3]["classes"].numpy(), drawn.classes[3])


# Inventing


@given(st.integers(0, 2**62))
@settings(max_examples=150)
def test_what_is_invented_can_be_made(seed: int) -> None:
    recipe = invent(np.random.default_rng(seed))
    assert Recipe.model_validate_json(recipe.model_dump_json()) == recipe
    assert recipe == invent(np.random.default_rng(seed))
    assert MODULUS_MPA[0] <= recipe.modulus <= MODULUS_MPA[1]
    kinds = [layer.kind for layer in recipe.relief]
    assert len(kinds) == len(set(kinds)) <= 3
    assert {*kinds, recipe.body.kind} <= set(KINDS)
    surface = heights(recipe.surface, 65, 0.25, np.random.default_rng(seed))
    assert (surface.shape, surface.dtype) == ((65, 65), np.float32)
    assert np.isfinite(surface).all()
    assert surface.max() < 20, "in mm: nothing stands out farther than the sensor is wide"


def test_bodies_and_layers_come_as_often_as_said() -> None:
    """Within five standard deviations of 2000 draws; of more than three layers some are left out."""
    recipes = [invent(np.random.default_rng(seed)) for seed in range(2000)]
    bodies = [r.body.kind for r in recipes]
    for kind, share in {"flat": 0.25, "round": 0.5, "bar": 0.13, "wedge": 0.12}.items():
        assert bodies.count(kind) / 2000 == pytest.approx(share, abs=5 * math.sqrt(share * (1 - share) / 2000))
    for kind, (share, _) in LAYERS.items():
        found = sum(kind in [layer.kind for layer in r.relief] for r in recipes) / 2000
        slack = 5 * math.sqrt(share * (1 - share) / 2000)
        assert 0.9 * share - slack <= found <= share + slack
    orders = {tuple(layer.kind for layer in r.relief) for r in recipes}
    assert ("rough", "domes") in orders
    assert ("domes", "rough") in orders


# The model


@pytest.mark.parametrize("rare", [False, True])
def test_the_loss_by_hand(rare: bool) -> None:
    """In float64; `rare`: classes that the lessons lack, and a quantity that never changes."""
    rng = np.random.default_rng(1)
    lessons = Lessons(
        pictures=rng.integers(0, 256, (6, 2, 32, 32, 3), dtype=np.uint8),
        quantities=rng.normal(3, 5, size=(6, 2, 4)).astype(np.float32),
        kinds=rng.integers(0, 2, (6, 3)).astype(np.uint8),
        classes=np.array([[0, 1, 2], [0, 1, 1], [1, 1, 0], [2, 0, 0], [2, 1, 0], [2, 1, 0]]),
    )
    if rare:
        lessons.classes[:, 1] = 1
        lessons.quantities[..., 0] = 7
    seed_everything(0)
    model = lesson_model(SceneEncoder(), lessons).eval()
    batch = slice(1, 5)
    kinds, classes = lessons.kinds[batch].astype(np.float32), lessons.classes[batch]
    arrays = (lessons.pictures[batch], lessons.quantities[batch], kinds, classes)
    with torch.no_grad():
        found = {n: v.item() for n, v in model(*map(torch.from_numpy, arrays)).items()}
        pictures = torch.from_numpy(lessons.pictures[batch].reshape(-1, 32, 32, 3))
        features = model.encoder(pictures, torch.zeros(8)).double().numpy()
    weights = {n: p.detach().double().numpy() for n, p in model.named_parameters()}
    hidden = np.maximum(features @ weights["frame_head.1.weight"].T + weights["frame_head.1.bias"], 0)
    told = (hidden @ weights["frame_head.3.weight"].T + weights["frame_head.3.bias"]).reshape(4, 2, 7)
    exact = lessons.quantities.astype(np.float64)
    wanted = (exact[batch] - exact.mean(axis=(0, 1))) / (exact.std(axis=(0, 1)) + 1e-6)
    off = np.abs(told[..., :4] - wanted)
    quantities = np.where(off < 1, off**2 / 2, off - 0.5).mean()
    chances = expit(told[..., 4:])
    present = np.repeat(lessons.kinds[batch, None].astype(float), 2, axis=1)
    flags = -(present * np.log(chances) + (1 - present) * np.log(1 - chances)).mean()
    means = features.reshape(4, 2, -1).mean(axis=1)
    logits = np.split(means @ weights["object_head.weight"].T + weights["object_head.bias"], 3, axis=1)
    told_classes = 0.0
    for position, z in enumerate(logits):
        shares = np.maximum([np.mean(lessons.classes[:, position] == c) for c in range(3)], 1e-3)
        weight = 1 / (3 * shares)[classes[:, position]]
        told_classes += (weight * -log_softmax(z, axis=1)[range(4), classes[:, position]]).sum() / weight.sum()
    assert found["quantities"] == pytest.approx(quantities, rel=1e-5)
    assert found["kinds"] == pytest.approx(flags, rel=1e-5)
    assert found["classes"] == pytest.approx(told_classes, rel=1e-5)
    assert found["loss"] == pytest.approx(2 * quantities + 0.6 * flags + 0.3 * told_classes, rel=1e-5)


def test_held_out_parts_are_means_over_lessons(drawn: Lessons) -> None:
    seed_everything(0)
    model = lesson_model(SceneEncoder(), drawn)
    data = LessonDataset(drawn, augment=None, seed=0)
    found = held_out(model, data)
    assert isinstance(model, LessonModel)
    assert not model.training
    with torch.no_grad():
        single = [model(**{n: v[None] for n, v in data[i].items()}) for i in range(9)]
    assert found == pytest.approx(
        {f"held_out_{n}": np.mean([s[n].item() for s in single]) for n in ("loss", "quantities", "kinds", "classes")}
    )
    assert found == held_out(model, data), "nothing is dropped at random"
