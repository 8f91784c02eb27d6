"""The studio: a camera that is odd in every way, and the whole page in a real browser, killed in the middle."""

import asyncio
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import httpx2
import numpy as np
import pytest

from pipeline.use import live, studio
from pipeline.use.folder import FITTED
from pipeline.use.model import Octopi
from pipeline.use.studio import Sensor, Studio
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.film import write_film
from pipeline.videos.frames.reference import LONGEST
from pipeline.videos.importing.presses import Shot
from tests.checkpoints import model_folder
from tests.conftest import HUNG, ROOT, wait_for
from tests.use.browser import Tab, tab
from tests.use.fake import Running
from tests.use.test_live import Camera, shots
from tests.use.videos import recording

pytestmark = pytest.mark.slow
CLASSES = {"foam": (0, 1, 0), "brick": (2, 2, 0), "toy_brick": (2, 0, 2)}


def test_what_is_odd_about_camera_gel_and_press_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera that says 60 and gives fewer, whose light changes, and that is unplugged in a press, then comes back.

    A press right behind another one is judged by itself.
    """
    pictures: list[np.ndarray] = recording([range(30, 50), range(80, 82), range(100, 140)], 120)
    weak = [np.rint(0.8 * a + 0.2 * b).astype(np.uint8) for a, b in zip(pictures[:6], pictures[32:38], strict=True)]
    told, opened, seen = list[tuple[str, list[Shot]]](), list[Any](), list[str]()

    class Slow(Camera):
        def read(self) -> tuple[bool, Any]:
            time.sleep(0.01)
            return super().read()

    def plugged(name: object) -> Camera:
        light = [np.clip(picture.astype(int) + 20, 0, 255).astype(np.uint8) for picture in pictures[:25]]
        twice = [*pictures[:53], *pictures[35:40], *pictures[50:80]]  # The second begins as the first ends.
        films = [*twice, *weak, *pictures[:15], *pictures[80:]], 3 * light, [p[:-16].copy() for p in 3 * light]
        opened.append(Slow(films[2 if seen else bool(opened)], name))
        return opened[-1]

    monkeypatch.setattr(cv2, "VideoCapture", plugged)
    monkeypatch.setattr(live, "PAUSE", 0.0)
    monkeypatch.setattr(studio, "AGAIN", 0.1)
    monkeypatch.setattr(studio, "LOST", 40)  # The fake camera stumbles, more so on a busy machine.
    sensor = Sensor("0", 2.0, lambda odd, press: told.append((odd, press)))
    wait_for(lambda: any("says 60" in note for note in sensor.notes()))
    wait_for(lambda: len(opened) > 1)
    wait_for(lambda: any("changed by +" in note for note in sensor.notes()))
    assert not any("dropped" in note for note in sensor.notes()), "while it was gone it sent none"
    seen.append("the light")
    wait_for(lambda: any(one.shot.picture.shape[0] < len(pictures[0]) for one in [*sensor.quiet]))
    wait_for(lambda: "picture" in sensor.shown() and len(sensor.quiet) >= LONGEST)
    assert not any("changed" in note for note in sensor.notes()), "in another format it is compared with itself"
    sensor.close()
    found = [(odd.partition(":")[0].partition(",")[0], bool(press)) for odd, press in told]
    touches = [("", True), ("short", True), ("too weak", False), ("too short", False)]
    assert found == [*touches, ("cut off before the release", True)]
    assert len({shot.stamped for shot in told[0][1]}) == len(told[0][1]), "each picture has its time"


def watched(
    pictures: Sequence[np.ndarray], monkeypatch: pytest.MonkeyPatch, lost: range = range(0)
) -> tuple[list[str], list[str]]:
    """What a sensor notes in the end, whose camera sends pictures and loses some; and what it told of touches."""
    told, sent = list[str](), shots(pictures, [i for i in range(len(pictures)) if i not in lost])
    monkeypatch.setattr(studio, "watch", lambda *_: iter(sent))
    monkeypatch.setattr(studio, "AGAIN", HUNG)
    sensor = Sensor("0", 2.0, lambda odd, _: told.append(odd))
    wait_for(lambda: sensor.gone.endswith("has ended"))
    sensor.close()
    return sensor.notes(), told


def test_dirt_that_is_darker_than_the_gel_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A change of the light, also by a factor, is called that alone."""
    pictures: list[np.ndarray] = recording([], 60)
    y, x = np.mgrid[:48, :64]
    stain = 30.0 * (np.hypot(x - 25, y - 20) < 10)[:, :, None]

    def notes(factor: float, step: float | np.ndarray) -> list[str]:
        later = [np.clip(factor * picture + step, 0, 255).astype(np.uint8) for picture in pictures[30:]]
        return [note.partition(":")[0] for note in watched([*pictures[:30], *later], monkeypatch)[0]]

    assert notes(1.0, 0.0) == []
    assert notes(1.0, -stain) == notes(1.0, stain) == ["the untouched gel is not as at the start"]
    for factor, step in ((0.7, 0.0), (1.3, 0.0), (1.0, -30.0), (1.0, 20.0)):
        (note,) = notes(factor, step)
        assert note.startswith("the light has changed by ")
    assert len(notes(0.8, -stain)) == 2


def test_a_weak_and_a_clipped_press_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures: list[np.ndarray] = recording([range(30, 50)], 75)
    weak = [np.rint(0.4 * a + 0.6 * b).astype(np.uint8) for a, b in zip(pictures[30:50], pictures[:20], strict=True)]
    assert watched([*pictures[:30], *weak, *pictures[50:]], monkeypatch)[1] == ["weak: press harder"]
    for picture in pictures[30:50]:
        picture[12:36, 16:32], picture[12:36, 32:48] = 0, 255
    clipped = "clipped, 25% of values are 0 or 255: change light or exposure"
    assert watched(pictures, monkeypatch)[1] == [clipped]


def test_lost_pictures_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures: list[np.ndarray] = recording([], 91)
    assert watched(pictures, monkeypatch, range(1, 90, 8))[0] == ["it dropped 12 of the last 90 pictures"]
    assert watched(pictures, monkeypatch, range(30, 33))[0] == []


def test_it_is_adapted_by_ratings_from_two_rated_objects_on(tmp_path: Path) -> None:
    """With fewer it is adapted by all videos alone, and the page is told so."""
    (videos := tmp_path / "folder" / "videos").mkdir(parents=True)
    for name, example in (("foam", "soft"), ("brick", "hard"), ("unknown", "rough")):
        shutil.copy(ROOT / "examples" / f"{example}.mp4", videos / f"{name}_0.mp4")

    def load(copy: str | None) -> Octopi:
        return Octopi.from_pretrained(copy, base=model_folder("smollm2"), device="cpu")

    lab = Studio(load, tmp_path / "folder", str(ROOT / "examples" / "soft.mp4"), 2.0)
    try:
        for count, name in enumerate(("", "foam", "brick")):
            for place, property in enumerate(lab.data.names if name else ()):
                lab.rate("ann", name, property, CLASSES[name][place])
            told = asyncio.run(lab.adapt())
            assert lab.state()["told"] == told
            alone = [f"Rated objects: {count}. Ratings count", "standardised by 3 videos, without a label"]
            assert all(words in told for words in alone if count < 2)
            assert ("2 rated objects (2 videos)" in told) == (count == 2)
            assert lab.model.config.trained_on == ("videos" if count == 2 else FITTED)
    finally:
        lab.close()


def submit(page: Tab, field: str, text: str) -> None:
    page.run(f"(f => {{ f.value = {text!r}; f.dispatchEvent(new Event('change')); f.form.requestSubmit() }})({field})")


def rate(page: Tab, rater: str, classes: Sequence[int]) -> None:
    submit(page, "document.querySelector('#rater')", rater)
    page.until("document.querySelectorAll('.card').length === 3 && !document.querySelector('.card.done')")
    for place, level in enumerate(classes):
        slider = f"document.querySelectorAll('input[type=range]')[{place}]"
        page.run(f"(s => {{ s.value = {level}; s.dispatchEvent(new Event('click')) }})({slider})")
    page.until("document.querySelectorAll('.card.done').length === 3")


def test_record_rate_adapt_and_ask_in_a_browser(tmp_path: Path) -> None:
    write_film(camera := tmp_path / "camera.mp4", recording([range(40, 60)], 75, height=96, width=128), 25.0)
    lab, (first, *others) = tmp_path / "lab", CLASSES
    command = ("studio", lab, "--camera", camera, "--base", model_folder("smollm2"))
    run = Running(*command)
    try:
        with tab(tmp_path, 1440) as page:
            page.call("Page.navigate", url=run.address)
            page.until("document.querySelector('#gone')?.textContent.endsWith('has ended')")
            submit(page, "document.querySelector('#object')", first)
            submit(page, "document.querySelector('#camera')", str(camera))
            page.until("document.querySelectorAll('.chip').length === 1")
            submit(page, "document.querySelector('#camera')", str(camera))
            page.until("document.querySelector('#curve.pressed')")
            run.end()  # In the middle of a press: what was recorded before is there.
            page.until("document.querySelector('#gone').textContent.includes('does not answer')")
            run = Running(*command)
            page.call("Page.navigate", url=run.address)
            page.until("document.querySelectorAll('.chip').length === 1")
            for number, name in enumerate(others, 2):
                submit(page, "document.querySelector('#object')", name)
                submit(page, "document.querySelector('#camera')", str(camera))
                page.until(f"document.querySelectorAll('.chip').length === {number}")
            page.run("document.querySelector('[data-part=rate]').click()")
            flat = [level for classes in CLASSES.values() for level in classes]
            rate(page, "ann", flat)
            rate(page, "ben", [1, *flat[1:]])
            said = "document.querySelector('#summary').textContent"
            page.until(f"{said}.includes('no smooth and no bumps object yet') && {said}.includes('ann, ben')")
            page.run("document.querySelector('[data-part=adapt]').click()")
            assert "foam again: raters disagree" in page.run("document.querySelector('#next').textContent")
            page.run("document.querySelector('#fit').click()")
            page.until("document.querySelector('#told').textContent.includes('3 rated objects (3 videos)')")
            submit(page, "document.querySelector('#camera')", str(camera))
            page.until("document.querySelector('.touch .sentence') && document.querySelectorAll('.bar').length === 9")
            assert "unknown_0.mp4" in page.run("document.querySelector('#lately').textContent")
            choose = "(s => {{ s.value = '{}'; s.dispatchEvent(new Event('change')) }})({})".format
            page.run(choose("foam_0.mp4", "document.querySelector('#again')"))
            page.until("document.querySelectorAll('.touch .sentence').length === 2")
            page.run("document.querySelector('#both').click()")
            page.until("document.querySelectorAll('#compared tr').length === 3")
            assert page.run("document.querySelectorAll('#compared td').length") == 6
            page.run("was = post; post = async (...all) => (await was(...all)).map(one => ({...one, answer: ''}))")
            page.run("document.querySelector('#both').click()")
            page.until("document.querySelectorAll('#compared td').length === 3")
            assert "language" not in page.run("post = was; document.querySelector('#compared').textContent")
            page.type("#question", "Which is softer?")
            page.until("document.querySelector('.model') && !document.querySelector('#send').disabled")
            page.run("document.querySelector('[data-part=record]').click(); window.prompt = () => 'a big brick'")
            rename = "[...document.querySelectorAll('.object')].find(o => o.textContent.startsWith('brick'))"
            page.run(f"[...{rename}.querySelectorAll('button')].find(b => b.textContent === 'rename').click()")
            chips = "[...document.querySelectorAll('.chip')].map(c => c.firstChild.textContent).sort().join()"
            page.until(f"{chips} === 'a_big_brick_0,foam_0,toy_brick_0,unknown_0'")
            unknown = "[...document.querySelectorAll('.chip')].find(c => c.textContent.startsWith('unk'))"
            page.run(choose("foam", f"{unknown}.querySelector('select')"))
            page.until(f"{chips} === 'a_big_brick_0,foam_0,foam_1,toy_brick_0'")
            for shown in ("a_big_brick_0,foam_0,toy_brick_0,unknown_0", "brick_0,foam_0,toy_brick_0,unknown_0"):
                page.run("document.querySelector('#undo').click()")
                page.until(f"{chips} === '{shown}'")
            assert page.complaints() == []
        ratings = {key: [*zip(c, c, strict=True)] for key, c in CLASSES.items()} | {"foam": [(0, 1), (1, 1), (0, 0)]}
        found = load_catalogue(lab / "catalogue").objects
        assert {key: [*o.ratings] for key, o in found.items()} == ratings
        assert sorted(f.name for f in (lab / "videos").glob("*.mp4")) == [
            *("brick_0.mp4", "foam_0.mp4", "toy_brick_0.mp4", "unknown_0.mp4")
        ]
        api = run.address.partition("studio.html")[0] + "api/"
        token = {"Authorization": f"Bearer {run.address.partition('#')[2]}"}
        asked = [httpx2.get(f"{api}state", headers=h).status_code for h in ({}, {**token, "Host": "evil.example"})]
        assert asked == [401, 400], "no other site, nobody without the token"
        assert len(httpx2.get(f"{api}state?rater=cid", headers=token).json()["ratings"]) == 0, "raters are blind"
    finally:
        run.end()
