"""The demo: what the page is given, what it refuses, and all of it in a real browser."""

import asyncio
import base64
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx2
import numpy as np
import pytest

from pipeline.core.records import GAIN, MIDDLE
from pipeline.scenes.recipe import load_recipes
from pipeline.use.demo import ASIDE, GLOW, MOST_TOUCHES, Asked, Session, make_app, where
from pipeline.use.server import Failed
from pipeline.videos.catalogue import Catalogue
from tests.conftest import HUNG, PHYSICLEAR, refused
from tests.use.browser import tab
from tests.use.fake import KEPT, FakeOctopi, digest, running
from tests.use.videos import press


@pytest.fixture(scope="module")
def session(catalogue: Catalogue) -> Session:
    recipes = load_recipes(PHYSICLEAR, catalogue, 0)
    model: Any = FakeOctopi()
    return Session(model, catalogue, {o: recipes[o] for o in ("baseball", "pillow")})


@pytest.fixture(scope="module")
def site(session: Session) -> Iterator[str]:
    with running(make_app(session)) as port:
        yield f"http://127.0.0.1:{port}"
    assert not session.folder.exists(), "what was shown is forgotten"


def picture(uri: str) -> np.ndarray:
    kind, data = uri.split(",")
    assert kind == "data:image/png;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]


def put(site: str, name: str, video: bytes) -> httpx2.Response:
    return httpx2.put(f"{site}/api/touches/{name}", content=video, timeout=HUNG)


def test_a_video_is_shown_as_the_model_sees_it(site: str, session: Session, tmp_path: Path) -> None:
    video = press(tmp_path / "rug 1.mp4")
    shown, touch = put(site, "rug%201.mp4", video.read_bytes()).json(), session.model.look(video)
    assert (shown["name"], tuple(shown["numbers"]), shown["contact"]) == ("rug 1.mp4", touch.numbers, touch.contact)
    for name, pictures in (("frames", touch.frames), ("difference", touch.difference), ("touched", where(touch))):
        np.testing.assert_array_equal([picture(f) for f in shown[name]], pictures)
    np.testing.assert_array_equal(picture(shown["reference"]), touch.reference)
    assert shown["probabilities"]["roughness"] == {"smooth": 0.5, "slightly rough": 0.25, "rough": 0.125}


def test_it_glows_where_it_touches_and_nowhere_else(session: Session, tmp_path: Path) -> None:
    touch = session.model.look(press(tmp_path / "rug.mp4"))
    y, x = np.mgrid[:96, :96]
    distance = np.hypot(x - 48, y - 48)
    difference = np.full_like(touch.difference, MIDDLE)
    difference[:, distance < 22, 1] += 2 * int(GAIN * GLOW)
    painted = where(touch.model_copy(update={"difference": difference}))
    assert (painted[:, distance < 18] == (230, 30, 60)).all(), "red"
    np.testing.assert_array_equal(painted[:, distance > 30], touch.frames[:, distance > 30])


def test_an_answer_streams_with_its_history(site: str, session: Session, tmp_path: Path) -> None:
    videos = [press(tmp_path / "a.mp4"), press(tmp_path / "b.mp4", begin=12)]
    ids = [put(site, video.name, video.read_bytes()).json()["id"] for video in videos]
    turn = {"question": "{tactile}?", "touches": ids[:1], "answer": "Soft."}
    asked = {"question": "And {tactile}", "touches": ids[1:], "history": [turn]}
    model: Any = session.model
    model.gate = threading.Event()
    with httpx2.stream("POST", f"{site}/api/ask", json=asked, timeout=HUNG) as response:
        pieces = response.iter_text()
        assert next(pieces) == "And ", "the first piece comes while the model goes on"
        model.gate.set()
        rest = f"{{tactile}} | {{tactile}}?>Soft.:{digest(videos[0])} | {digest(videos[1])} "
        answer, heads = "".join(pieces).split(ASIDE)
        assert answer == rest
        assert heads == "Property heads: soft (50%). the sentence and the heads disagree"
    for history, note in (([], ". it compares one video"), ([turn], "")):
        asked = {"question": "Is {tactile} softer?", "touches": ids[:1], "history": history}
        told = httpx2.post(f"{site}/api/ask", json=asked, timeout=HUNG).text.split(ASIDE)[1]
        assert told == f"Property heads: soft (50%){note}"
    assert len(model.threads - {threading.get_ident()}) == 1, "one thread does all that the model does"
    model.gate = None


def test_an_answer_that_nobody_hears_ends_and_one_that_breaks_off_says_so(site: str, session: Session) -> None:
    model: Any = session.model
    model.seconds = 0.01
    with httpx2.stream("POST", f"{site}/api/ask", json={"question": "endless"}, timeout=HUNG) as response:
        assert next(response.iter_text()).startswith("on ")
    made = asyncio.run(session.work(lambda: model.made))  # Its turn comes only where the answer is given up.
    time.sleep(0.05)
    assert model.made == made
    model.seconds = 0.0
    assert said(session, question="crash") == f"crash \n[{Failed()}]"


def said(session: Session, **asked: Any) -> str:
    async def whole() -> str:
        return "".join([piece async for piece in await session.stream(Asked(**asked))]).split(ASIDE)[0]

    return asyncio.run(whole())


def test_what_is_wrong_comes_back_as_one_line(site: str, tmp_path: Path) -> None:
    asked = {"question": "{tactile}?", "touches": []}
    for place, body, told in (
        ("touches/a.mp4", {}, "a.mp4: empty (0 bytes); copy it again, or remove it"),
        ("touches/%2e%2e", {"content": b"no video"}, "video: "),
        ("touches/..%5C..%5Ca.mp4", {"content": b"no video"}, "no frame decodes"),
        ("ask", {"json": asked}, "the question has 1 {tactile} for 0 videos"),
        ("ask", {"json": {**asked, "touches": ["0"]}}, "1 touches are forgotten; begin a new conversation"),
    ):
        answer = httpx2.request("POST" if place == "ask" else "PUT", f"{site}/api/{place}", timeout=HUNG, **body)
        assert answer.status_code == 422
        line = answer.json()["error"]
        assert told in line
        assert "\n" not in line
        assert str(tmp_path.parent.parent) not in line
        assert "octopi-demo" not in line
    assert httpx2.get(f"{site}/api/about").status_code == 200, "the server goes on"


def test_a_large_video_and_other_sites_are_refused(
    site: str, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.use.demo.MOST_BYTES", 2_000_000)
    before = set(session.folder.iterdir())
    answer = put(site, "a.mp4", bytes(2_000_001))
    assert (answer.status_code, answer.json()["error"]) == (422, "a.mp4: more than 2 MB; drop a shorter video")
    assert set(session.folder.iterdir()) == before, "nothing of it is kept"
    assert httpx2.get(f"{site}/api/about", headers={"Host": "evil.example"}).status_code == 400
    plain = {"Content-Type": "text/plain"}  # What a page of another site may send without asking first.
    assert httpx2.post(f"{site}/api/ask", content=b'{"question": "hi"}', headers=plain).status_code == 422
    assert "default-src 'none'" in httpx2.get(f"{site}/").text, "the page asks nobody else for anything"


def test_old_touches_are_forgotten(tmp_path: Path, catalogue: Catalogue) -> None:
    model: Any = FakeOctopi()
    session = Session(model, catalogue, {})
    dropped = [session.folder / str(i) / "rug.mp4" for i in range(MOST_TOUCHES)]
    videos = [press(tmp_path / "rug.mp4"), *dropped]
    for video in dropped:
        video.parent.mkdir()
        video.hardlink_to(videos[0])
    ids = [session.show("rug", video)["id"] for video in videos]
    with refused("forgotten"):
        said(session, question="{tactile}", touches=ids[:1])
    assert said(session, question="{tactile}", touches=ids[1:2])
    assert all(video.exists() for video in videos), "a file that the page was not given is not its own"
    session.show("rug", videos[0])
    assert [video.exists() for video in dropped] == [False] + [True] * (MOST_TOUCHES - 1)
    session.close()


@pytest.mark.slow
def test_in_a_browser(site: str, session: Session, tmp_path: Path) -> None:
    files = [press(tmp_path / "soft <i>thing.mp4"), press(tmp_path / "other.mp4", begin=12)]
    (notes := tmp_path / "notes.txt").write_text("no video")
    with tab(tmp_path) as page:
        page.call("Page.navigate", url=site)
        page.until("document.querySelectorAll('#scene option').length === 3")
        page.choose("#file", notes)
        page.until("document.querySelector('#message').textContent.startsWith('notes.txt: no video by its name')")
        page.choose("#file", *files)
        page.until("document.querySelectorAll('.touch').length === 2")
        assert page.run("document.querySelector('#message').textContent") == "", "the message goes when all is well"
        heads = page.run("[...document.querySelectorAll('.touch h2')].map(e => e.textContent)")
        assert heads == ["1. soft <i>thing.mp4", "2. other.mp4"], "a name is text, never markup"
        page.until("[...document.querySelectorAll('.strip img')].every(i => i.complete && i.naturalWidth === 96)")
        assert page.run("document.querySelectorAll('.strip img').length") == 2 * (1 + 3 * KEPT)
        bars = "document.querySelector('.touch').querySelectorAll('.bar')"
        widths = page.run(f"[...{bars}].map(b => b.firstChild.offsetWidth / b.offsetWidth)")
        np.testing.assert_allclose(widths, [0.5, 0.25, 0.5, 0.25, 0.125], atol=0.02)
        page.type("#question", "Which is <b>softer</b>?")
        page.until("!document.querySelector('#send').disabled && document.querySelector('.model')")
        said = page.run("[...document.querySelectorAll('.said')].map(e => e.textContent)")
        asked = "{tactile} {tactile} Which is <b>softer</b>?"
        answer = f"{asked} | {digest(files[0])} | {digest(files[1])} "
        assert said == [asked, answer], "an answer is text, too"
        heads = page.run("document.querySelector('.model + .heads').textContent")
        assert heads == "Property heads: soft (50%)", "no part of the answer"
        page.type("#question", "Why?")
        page.until("document.querySelectorAll('.model').length === 2 && !document.querySelector('#send').disabled")
        shown = page.run("[...document.querySelectorAll('.model')].at(-1).textContent")
        assert shown == f"Why? | {asked}>{answer}:{digest(files[0])},{digest(files[1])} ", "with what was said before"
        page.type("#question", "{tactile} {tactile} {tactile}?")
        page.until("document.querySelector('#message').textContent.includes('3 {tactile} for 2 videos')")
        assert page.run("document.querySelectorAll('.said').length") == 4, "what was refused is no part of the talk"
        model: Any = session.model
        model.gate = threading.Event()
        page.run("document.querySelector('#question').value = ''")
        page.type("#question", "late?")
        page.until("[...document.querySelectorAll('.model')].at(-1).textContent === 'late? '")
        page.run("document.querySelector('#reset').click()")
        model.gate.set()
        page.until("!document.querySelector('#send').disabled")
        page.type("#question", "Why?")
        page.until("document.querySelector('.model') && !document.querySelector('#send').disabled")
        shown = page.run("[...document.querySelectorAll('.model')].map(e => e.textContent)")
        assert shown == [f"{{tactile}} {{tactile}} Why? | {digest(files[0])} | {digest(files[1])} "], "it begins anew"
        model.gate = None
        page.run("document.querySelector('#scene').value = 'baseball'")
        page.run("document.querySelector('#scene').dispatchEvent(new Event('change'))")
        page.until("document.querySelectorAll('.touch').length === 3")
        assert page.run("document.querySelector('#file').disabled"), "three are enough"
        assert page.run("document.documentElement.scrollWidth <= innerWidth")
        assert {url.partition(":")[0] for url in page.requests() if not url.startswith(site)} <= {"data"}
        assert page.complaints() == []
        page.run("fetch('http://127.0.0.1:9/').catch(() => 0)")
        page.until("true")
        assert any("Content Security Policy" in line for line in page.complaints()), "the policy forbids other hosts"
