"""The no-contact reference, light that changes, and which frames are kept, against slow second implementations."""

import math
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from pipeline.config import FramesConfig
from pipeline.use.frames import read_touch
from pipeline.videos.decoding import Decoder, fit, picture, planes
from pipeline.videos.frames import selection
from pipeline.videos.frames.reference import reference_indices, thumbnail
from tests import frame_rules
from tests.conftest import encode, moving_square, write_video
from tests.frame_rules import CONFIG, Scanned, constant, frames_of, luma, pressing, published, salience, scanned

WIDTH, HEIGHT = 120, 90


def film(depths: list[float], seed: int = 0, light: list[float] | None = None) -> list[np.ndarray]:
    """A pattern of bumps pressed as deep as `depths` says, under a light that is `light` steps brighter."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    bumps = np.sin(x / 4) * np.sin(y / 4) * np.exp(-(((x - 60) / 30) ** 2) - ((y - 45) / 23) ** 2)
    frames = []
    for depth, more in zip(depths, light or [0.0] * len(depths), strict=True):
        grey = 110 + 25 * x / WIDTH + depth * bumps + more + rng.normal(0, 0.5, x.shape)
        frames.append(np.clip(np.stack([grey - 20, grey, grey + 15], axis=2), 0, 255).astype(np.uint8))
    return frames


def filmed(path: Path, frames: list[np.ndarray], name: str = "contact", *, lossless: bool = False) -> Scanned:
    (encode if lossless else write_video)(path, frames)
    return scanned(path, FramesConfig(pixels=32, selection=name))


def rise(count: int) -> list[float]:
    """Untouched for a fifth of the time, then contact to the end."""
    return [90 * max(0.0, (i / count - 0.2) / 0.8) for i in range(count)]


@pytest.mark.parametrize(("count", "expected"), [(1, (0,)), (3, (0,)), (50, (0, 2, 4)), (126, (0, 2, 4, 6))])
def test_the_reference_of_usual_lengths(tmp_path: Path, count: int, expected: tuple[int, ...]) -> None:
    """50 and 126 frames: five seconds at 10 and 25 frames a second."""
    assert reference_indices(count) == expected
    found = filmed(path := tmp_path / "v.avi", film(rise(count)))
    fitted = np.array([fit(frame, FramesConfig(pixels=32)) for frame in frames_of(path)], np.float64)
    np.testing.assert_array_equal(found.reference, np.rint(fitted[list(expected)].mean(axis=0)))
    assert not found.probe.starts_touching
    if count > 3:
        assert found.probe.contact_end > 2
        assert found.probe.contact == pytest.approx(found.probe.contact_end, rel=0.2)
        assert found.probe.quiet < 1


@pytest.mark.parametrize(("count", "name"), [(12, "contact"), (50, "salient"), (126, "contact")])
def test_a_video_that_starts_in_contact_takes_its_reference_from_the_end(tmp_path: Path, count: int, name: str) -> None:
    found = filmed(tmp_path / "back.avi", film(rise(count)[::-1]), name)
    still = filmed(tmp_path / "still.avi", film([0.0] * count, seed=1))
    assert (found.probe.starts_touching, still.probe.starts_touching) == (True, False)
    assert np.abs(found.reference.astype(int) - still.reference).mean() < 1.5, "no trace of contact"
    assert found.probe.contact_end < 1 < 2 < found.probe.contact
    if name != "salient":
        assert found.kept[0].index <= 1, "contact is strongest in the first frames"
        assert max(k.score for k in found.kept) == pytest.approx(found.probe.contact)


def test_neither_contact_throughout_nor_a_step_of_the_light_is_contact(tmp_path: Path) -> None:
    throughout = filmed(tmp_path / "throughout.avi", film([80.0] * 40)).probe
    assert not throughout.starts_touching
    assert throughout.contact < 1
    stepped = filmed(tmp_path / "light.avi", film([0.0] * 50, light=[0.0] * 25 + [12.0] * 25)).probe
    without = filmed(tmp_path / "dark.avi", film([0.0] * 50)).probe
    touched = filmed(tmp_path / "touched.avi", film(rise(50))).probe
    assert stepped.brightness_step == pytest.approx(12, abs=1)
    assert without.brightness_step < 0.5
    assert stepped.contact < without.contact + 0.5 < touched.contact / 3


WARM_UP = [0.25 + 0.75 * i / 8 for i in range(8)]
SLOWLY = [1 - 0.6 * 0.8**i for i in range(18)]


def warmed(frames: list[np.ndarray], gains: list[float]) -> list[np.ndarray]:
    """The same frames under a light that begins with these gains and then stays as it is."""
    gains = [*gains, *[1.0] * (len(frames) - len(gains))]
    return [np.clip(np.rint(f * gain), 0, 255).astype(np.uint8) for f, gain in zip(frames, gains, strict=True)]


@pytest.mark.parametrize(
    ("name", "gains", "shape"),
    [
        *(("salient", WARM_UP, "press"), ("contact", WARM_UP, "start"), ("contact", SLOWLY, "throughout")),
        *(("contact", SLOWLY, "press"), ("salient", [0.0], "start")),
        ("release", [1.3, 1.3, 1.2, 1.2, 1.1], "press"),
    ],
)
def test_a_warm_up_changes_nothing_else(tmp_path: Path, name: str, gains: list[float], shape: str) -> None:
    """Against the same press without the frames whose light is not yet that of the others."""
    depths = {"press": rise(100), "throughout": [0.0] * 100, "start": rise(100)[::-1]}[shape]
    steady = film(depths)
    found = filmed(tmp_path / "warm.avi", warmed(steady, gains), name, lossless=True)
    cold = found.probe.unsteady
    # At the end of a slow rise a change of a step in eight frames is left in.
    assert max(1, len(gains) - 6) <= cold <= len(gains)
    expected = filmed(tmp_path / "cut.avi", warmed(steady, gains)[cold:], name, lossless=True)
    assert found.probe.untouched == tuple(i + cold for i in expected.probe.untouched)
    np.testing.assert_array_equal(found.reference, expected.reference)
    for measure in ("contact", "contact_end", "starts_touching", "brightness", "thumbnail"):
        assert getattr(found.probe, measure) == pytest.approx(getattr(expected.probe, measure), rel=0.2, abs=0.05)
    assert found.probe.starts_touching == (shape == "start")
    if name != "release":
        assert min(k.index for k in found.kept) >= cold + (name == "salient"), "no difference in light is kept"


@pytest.mark.parametrize(("gains", "opened"), [([], 1), (WARM_UP, 2)])
def test_a_video_is_decoded_twice_at_most(tmp_path: Path, gains: list[float], opened: int) -> None:
    """The second has no number of frames in its header, light that rises, and contact at its beginning."""
    depths = rise(100)[::-1] if gains else rise(100)
    path = encode(tmp_path / ("v.mkv" if gains else "v.avi"), warmed(film(depths), gains))
    with patch.object(Decoder, "frames", autospec=True, side_effect=Decoder.frames) as decoded:
        scanned(path)
    assert decoded.call_count == opened


def test_a_warm_up_is_noted_and_hides_no_lack_of_contact(tmp_path: Path) -> None:
    frames = warmed(film([0.0] * 60), WARM_UP)
    first, second = read_touch(encode(tmp_path / "v.avi", frames), FramesConfig(pixels=32), quiet=1.0).notes
    assert first.startswith("nothing touches the sensor")
    assert second == "the light is not steady in the first 8 frames, which are left out"


def test_a_steady_press_has_the_reference_that_it_had(tmp_path: Path) -> None:
    """Also where contact begins at once, under a light that only ever changes later, and one that never settles."""
    late, flicker = [0.0] * 30 + [20.0] * 70, [15.0 * (i % 2) for i in range(60)]
    for number, (depths, light, unsteady) in enumerate(
        (([4.0 * i for i in range(60)], None, 0), (rise(100), None, 0), (rise(100), late, 0), (rise(60), flicker, 60))
    ):
        found = filmed(tmp_path / f"{number}.avi", film(depths, light=light), "salient", lossless=True).probe
        assert (found.unsteady, found.untouched) == (unsteady, reference_indices(len(depths)))


@pytest.mark.parametrize(("height", "width"), [(240, 320), (17, 97), (1, 1), (600, 4)])
def test_thumbnails_keep_the_shape(tmp_path: Path, height: int, width: int) -> None:
    (frame,) = frames_of(encode(tmp_path / "v.mkv", [np.full((height, width, 3), 128, np.uint8)], "ffv1", "yuv420p"))
    thumb = thumbnail(frame)
    rows, columns = (max(1, round(80 * min(1, share))) for share in (height / width, width / height))
    assert thumb.shape == (rows, columns, 3)
    assert (thumb[..., 0] == planes(frame)[0][0, 0]).all()


def assert_fitted(path: Path, found: Scanned) -> None:
    """Pictures of what was kept are the frames at their places, fitted."""
    raw = frames_of(path)
    for kept in found.kept:
        np.testing.assert_array_equal(kept.image, fit(raw[kept.index], CONFIG))


def chosen(found: Scanned) -> list[tuple[int, float]]:
    return [(k.index, k.score) for k in found.kept]


STEPS = [constant(1, value)[0] for value in [*[77] * 5, *np.random.default_rng(0).choice([0, 77, 255], 40)]]
"""Many differences are equal: of such the earlier frame is kept. The first frames are steady, or they are skipped."""


@pytest.mark.parametrize(
    "frames", [*(moving_square(n) for n in (101, 3, 1)), moving_square(9, 1, 98, 17), constant(9), STEPS]
)
def test_salience_equals_the_reference(tmp_path: Path, frames: list[np.ndarray]) -> None:
    path = write_video(tmp_path / "v.avi", frames)
    # 0.07 of the 100 differences of 101 frames is 7.000000000000001 in floating point, of which 8 would be kept.
    for fraction in ("0.01", "0.07", "0.3", "1.0"):
        found = scanned(path, FramesConfig(pixels=16, fraction=float(fraction)))
        assert found.probe.frames == len(frames)
        assert chosen(found) == salience(luma(path), fraction)
        assert_fitted(path, found)


@pytest.mark.parametrize("name", ["salient", "release", "contact"])
def test_what_is_held_in_memory_changes_nothing(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "v.avi", pressing(40))
    config = FramesConfig(pixels=16, selection=name)
    held = scanned(path, config)
    monkeypatch.setattr(selection, "HELD_BYTES", 0)
    at_once = scanned(path, config)
    assert chosen(held) == chosen(at_once)
    np.testing.assert_array_equal([k.image for k in held.kept], [k.image for k in at_once.kept])


@pytest.mark.parametrize("count", [1, 3, 16, 17, 40])
def test_the_published_rule(tmp_path: Path, count: int) -> None:
    for make in (moving_square, pressing, constant):
        path = write_video(tmp_path / "v.avi", make(count))
        for promised in (max(1, count - 14), count, count + 7):
            with frame_rules.promising(promised):
                found = scanned(path, FramesConfig(pixels=16, selection="release"))
            assert chosen(found) == published(path, promised)
            assert_fitted(path, found)


@pytest.mark.parametrize(("seed", "fraction"), [(0, 0.05), (1, 0.3)])
def test_contact_frames_are_those_most_unlike_the_reference(tmp_path: Path, seed: int, fraction: float) -> None:
    """By the definition of strength, in float64; frames of the reference count as untouched."""
    path = write_video(tmp_path / "v.avi", pressing(50, seed))
    found = scanned(path, FramesConfig(pixels=16, selection="contact", fraction=fraction))
    thumbs = np.array([thumbnail(frame) for frame in frames_of(path)], np.float64)
    first = list(reference_indices(50))
    change = thumbs - np.rint(thumbs[first].mean(axis=0))
    expected = np.abs(change).mean(axis=(1, 2, 3)) - np.abs(change.mean(axis=(1, 2))).mean(axis=1)
    expected[: first[-1] + 1] = -1
    best = sorted(np.argsort(-expected, kind="stable")[: math.ceil(fraction * 50)].tolist())
    assert [k.index for k in found.kept] == best
    assert [k.score for k in found.kept] == pytest.approx(expected[best], abs=1e-9)
    assert found.probe.contact == pytest.approx(expected.max(), abs=1e-9)


@pytest.mark.real
@pytest.mark.parametrize("name", ["hairbrush_bristles_side_4", "tv_remote_back_3", "rice_spatula_base_1"])
def test_real_frames(real_data: Path, name: str) -> None:
    path = real_data / f"{name}.mov"
    assert chosen(scanned(path, FramesConfig(pixels=64))) == salience(luma(path), "0.3")
    promised = Decoder(path).header.frames
    assert chosen(scanned(path, FramesConfig(pixels=64, selection="release"))) == published(path, promised)
    for frame in frames_of(path)[::40]:
        expected = frame_rules.pillow(picture(frame)[..., ::-1], 64, "crop").astype(int)
        assert np.abs(fit(frame, FramesConfig(pixels=64)).astype(int) - expected).mean() < 1.5
