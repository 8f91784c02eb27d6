"""`octopi live`: presses found while they happen, on files and on a camera that drops frames."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.running.errors import UserError
from pipeline.use import live
from pipeline.videos.film import write_film
from pipeline.videos.frames.reference import LONGEST
from pipeline.videos.importing.presses import Shot
from tests.use.shared import Made
from tests.use.videos import recording

STEP_NS = 40_000_000
TOUCHED = (range(30, 50), range(80, 92))
LENGTH = 120


def shots(pictures: Sequence[np.ndarray], kept: Sequence[int]) -> list[Shot]:
    return [Shot(pictures[i], i * STEP_NS, i * STEP_NS) for i in kept]


@pytest.mark.parametrize("drift", [0.0, 0.05])
@pytest.mark.parametrize("dropped", [0.0, 0.3])
def test_each_press_is_found_once_with_untouched_pictures_in_front(drift: float, dropped: float) -> None:
    rng = np.random.default_rng(1)
    kept = [i for i in range(LENGTH) if rng.random() >= dropped]
    found = list(live.presses(shots(recording(TOUCHED, LENGTH, drift=drift), kept)))
    assert len(found) == len(TOUCHED)
    for press, touched in zip(found, TOUCHED, strict=True):
        places = [shot.recorded // STEP_NS for shot in press]
        assert set(places) >= set(touched) & set(kept)
        assert not [i for i in places[:LONGEST] if i in touched]
        assert len(places) - LONGEST - sum(i in touched for i in places) <= 3, "and ends soon"


def test_a_light_that_changes_for_good_is_no_endless_press() -> None:
    pictures = recording(TOUCHED, LENGTH)
    light = np.linspace(0.8, 1.2, 64)[None, :, None]
    changed = [np.clip(picture * light, 0, 255).astype(np.uint8) for picture in pictures]
    plain, other, pressed = pictures[:25], changed[:25], changed[TOUCHED[0].start : TOUCHED[0].stop]
    film = [*plain, *other * 31, *pressed, *other]
    found = list(live.presses(shots(film, range(len(film)))))
    assert [press[-1].recorded // STEP_NS > len(plain) * 32 for press in found] == [True], "but the press after it"


@pytest.mark.parametrize("steps", [0.2, 0.5, 1.0])
def test_a_press_that_deepens_slowly_is_never_told_by_its_release(steps: float) -> None:
    y, x = np.mgrid[:48, :64]
    bump = np.sign(x - 32) * (np.hypot(x - 32, y - 24) < 12)
    plain = recording(TOUCHED, LENGTH)[:25]
    depth = [0.0] * 80 + [min(40.0, steps * i) for i in range(200)] + [0.0] * 60
    film = [np.clip(plain[i % 25] + d * bump[:, :, None], 0, 255).astype(np.uint8) for i, d in enumerate(depth)]
    for press in live.presses(shots(film, range(len(film)))):
        assert press[0].recorded // STEP_NS < 130, "it begins with the press"


class Camera:
    """OpenCV's, whose every third read brings nothing, and that is unplugged at its end."""

    def __init__(self, pictures: Sequence[np.ndarray], name: object) -> None:
        self.left, self.reads, self.opens = list(pictures), 0, name == 0

    def isOpened(self) -> bool:
        return self.opens

    def read(self) -> tuple[bool, Any]:
        self.reads += 1
        good = bool(self.reads % 3 and self.left)
        return good, self.left.pop(0) if good else None

    def get(self, _: int) -> float:
        return 60.0

    def release(self) -> None:
        self.opens = False


def test_by_command_on_a_file_and_a_lossy_camera(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = recording(TOUCHED, LENGTH)
    write_film(tmp_path / "long.mp4", pictures, 25.0)
    command, model = ["live", "--times", "4"], ["--model", str(made.folder), "--device", "cpu"]
    said = CliRunner().invoke(app, [*command, str(tmp_path / "long.mp4"), *model])
    assert said.exit_code == 0, said.output
    lines = [line for line in said.stdout.splitlines() if line.startswith("press")]
    assert [line.split(",")[0] for line in lines] == ["press 1", "press 2"]
    assert all("25.0 a second: hardness " in line for line in lines)
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: Camera(pictures, name))
    monkeypatch.setattr(live, "PAUSE", 0.0)
    (device := tmp_path / "usb-camera").symlink_to("/dev/null")
    with pytest.raises(UserError, match="usb-camera: no camera that opens"):
        next(live.watch(str(device)))
    said = CliRunner().invoke(app, [*command, "0", "--ask", "How soft is it?", *model])
    assert sum(line.startswith("press") for line in said.stdout.splitlines()) == 2
    assert isinstance(said.exception, UserError)
    assert "0: brings no picture any more" in str(said.exception)
    error = CliRunner().invoke(app, [*command, "7", *model]).exception
    assert "7: no camera that opens" in str(error)
