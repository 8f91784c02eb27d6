"""`octopi serve` in process: OpenAI's forms field by field, every way to be refused, and questions in one batch."""

import asyncio
import json
import re
import threading
import time
from collections.abc import AsyncGenerator, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from openai import OpenAI
from openai.types import Model
from openai.types.chat import ChatCompletion, ChatCompletionChunk
from starlette.testclient import TestClient

from pipeline.language.generate import Stream
from pipeline.running.errors import UserError
from pipeline.use.model import Octopi
from pipeline.use.serve import make_app, read_token
from pipeline.use.server import Failed, Worker, listen
from tests.conftest import HUNG, refused
from tests.use.fake import CHAT, FakeOctopi, body, digest, events, part, said, text, user
from tests.use.videos import video

TOKEN = "0123456789abcdef"


@pytest.fixture(scope="module")
def fake() -> FakeOctopi:
    return FakeOctopi()


@pytest.fixture(scope="module")
def client(fake: FakeOctopi) -> Iterator[TestClient]:
    app = make_app(fake, "octopi", token=TOKEN, places=2)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with TestClient(app, headers=headers, raise_server_exceptions=False) as client:
        yield client


def error(response: Any, status: int) -> str:
    """The message of an error in OpenAI's form: one line, nothing of the server's insides."""
    assert response.status_code == status, response.text
    assert set(response.json()) == {"error"}
    found = response.json()["error"]
    assert set(found) == {"message", "type", "param", "code"}
    message: str = found["message"]
    assert message
    assert "\n" not in message
    assert not re.search(r"Traceback|File \"|/tmp|/home|0x[0-9a-f]{6}", response.text)
    return message


def test_an_answer_has_openai_s_form(client: TestClient) -> None:
    began = time.time()
    response = client.post(CHAT, json=body(user(text("How soft is it?"), part(video(1)))))
    answer = ChatCompletion.model_validate(response.json())
    assert response.json()["notes"] == ["video 1: little touches the sensor"]
    assert response.json()["heads"] == "soft (50%)"
    (touch,) = response.json()["touches"]
    assert touch["probabilities"]["hardness"] == {"soft": 0.5, "hard": 0.25}
    assert (touch["levels"]["hardness"], touch["calibrated"]) == ("soft", True)
    assert (answer.id[:9], answer.model) == ("chatcmpl-", "octopi")
    assert abs(answer.created - began) < HUNG
    (choice,) = answer.choices
    assert (choice.index, choice.message.role, choice.finish_reason) == (0, "assistant", "stop")
    assert choice.message.content == f"{{tactile}} How soft is it? | {digest(video(1))} "


def test_a_stream_has_openai_s_chunks(client: TestClient) -> None:
    response = client.post(CHAT, json=body(user(text("one two"), part(video(1))), stream=True))
    assert client.post(CHAT, json=body(user("one"), stream=None)).json()["object"] == "chat.completion"
    assert response.headers["content-type"].startswith("text/event-stream")
    *events_, done = events(response.text)
    assert done == "[DONE]"
    apart = ["video 1: little touches the sensor", "the sentence and the heads disagree"]
    assert [event.get("notes") for event in events_] == [None] * 6 + [apart]
    assert [event.get("heads") for event in events_] == [None] * 6 + ["soft (50%)"]
    chunks = [ChatCompletionChunk.model_validate(event) for event in events_]
    assert len({(c.id, c.created, c.model) for c in chunks}) == 1
    deltas = [c.choices[0].delta.model_dump(exclude_unset=True) for c in chunks]
    words = [{"content": f"{word} "} for word in ("{tactile}", "one", "two", "|", digest(video(1)))]
    assert deltas == [{"role": "assistant", "content": ""}, *words, {}]
    assert [c.choices[0].finish_reason for c in chunks] == [None] * 6 + ["stop"]


def test_openai_s_own_client(client: TestClient) -> None:
    there = OpenAI(base_url="http://testserver/v1", api_key=TOKEN, http_client=client)
    assert there.chat.completions.create(**body(user("hello"))).choices[0].message.content == "hello "
    (entry,) = there.models.list()
    assert Model.model_validate(entry.model_dump()).model_dump() == there.models.retrieve("octopi").model_dump()
    assert entry.id == "octopi"


def test_the_real_model_answers_as_the_library_does(octopi: Octopi, files: list[Path]) -> None:
    question = "Which is softer, {tactile} or {tactile}?"
    asked = body(user(text(question), *(part(file.read_bytes()) for file in files[:2])))
    with TestClient(make_app(octopi, "octopi"), base_url="http://localhost") as client:
        whole = said(client.post(CHAT, json=asked).json())
        assert whole == said(client.post(CHAT, json={**asked, "stream": True}).text)
        assert error(client.post(CHAT, json=body(user(part(video(1, 1))))), 422).startswith("video 1: ")
    assert whole.strip() == octopi.ask(question, files[:2]).strip()


@pytest.mark.parametrize(
    ("content", "question"),
    [
        ((text("Which is softer?"), part(video(1)), part(video(2))), "{tactile} {tactile} Which is softer?"),
        ((text("a) {tactile} b) {tactile}?"), part(video(1)), part(video(2))), "a) {tactile} b) {tactile}?"),
        ((text("a)\n"), part(video(1)), text("\nb)\n"), part(video(2))), "a)\n{tactile}\nb)\n{tactile}"),
        ((text("a)"), part(video(1), "image_url"), text("b)"), part(video(2))), "a) {tactile} b) {tactile}"),
    ],
)
def test_videos_stand_where_their_parts_or_marks_stand(client: TestClient, content: Any, question: str) -> None:
    answer = said(client.post(CHAT, json=body(user(*content))).json())
    assert answer == f"{question} | {digest(video(1))} | {digest(video(2))} "


def test_a_conversation_and_what_is_let_through(client: TestClient, fake: FakeOctopi) -> None:
    before = user(text("First"), part(video(1)))
    answered = [{"role": "assistant", "content": [text("Soft.")]}, {"role": "developer", "content": [text("x")]}]
    messages = [{"role": "system", "content": "You are a robot."}, before, *answered]
    messages.append(user(text("Second"), part(video(2))))
    more = {"temperature": 0.2, "top_p": 1, "seed": 4, "user": "r2", "n": 1, "tools": [], "stop": None, "x": {"y": 1}}
    response = client.post(CHAT, json=body(*messages, max_tokens=7, **more))
    assert said(response.json()) == f"{{tactile}} Second | First>Soft.:{digest(video(1))} | {digest(video(2))} "
    assert fake.tokens[-1] == 7
    client.post(CHAT, json=body(user("a"), max_completion_tokens=5000))
    client.post(CHAT, json=body(user("a")))
    assert fake.tokens[-2:] == [1024, None]


def test_who_is_let_in(client: TestClient, fake: FakeOctopi) -> None:
    for path in ("/v1/models", "/v1/models/octopi", CHAT):
        for header in ("", f"Basic {TOKEN}x", f"Bearer {TOKEN}x", "Bearer \xe9"):
            headers = {"Authorization": header.encode("latin-1")}
            response = client.request("POST" if path == CHAT else "GET", path, headers=headers)
            assert "token" in error(response, 401)
            assert response.headers["www-authenticate"] == "Bearer"
    health = client.get("/health", headers={"Authorization": ""})
    assert health.json() == {"status": "ok", "model": "octopi", "waiting": 0, "places": 2}
    # Without a token, only names of this machine: another site's may be pointed at it.
    with TestClient(make_app(fake, "octopi")) as tokenless:
        for host in ("127.0.0.1:8000", "localhost", "[::1]:80"):
            assert tokenless.get("/v1/models", headers={"Host": host}).status_code == 200
        for host in ("evil.example", "127.0.0.1.evil.example"):
            assert tokenless.get("/v1/models", headers={"Host": host}).status_code == 403


ASK = user("hello")
BAD: list[tuple[bytes | dict[str, Any], str]] = [
    (b"[" * 100_000, "JSON"),
    (body(*[ASK] * 65), "messages"),
    (body(user("x" * 20_001)), "at most 20000 characters"),
    (body(user({"type": "input_audio", "input_audio": {}})), "messages.0.content.0: Input tag 'input_audio'"),
    (body(ASK, {"role": "assistant", "content": "a"}), "take turns"),
    (body(ASK, {"role": "assistant", "content": [part(video())]}, ASK), "assistant"),
    (body(ASK, n=2), "n:"),
    (body(user({"type": "video_url", "video_url": {"url": "/etc/passwd"}})), "url: broken base64"),
    (body(user(part(b"no video at all"))), "video 1: no frame"),
    (body(user("one {tactile} and no video")), "{tactile}"),
    (body(user(text("blank"), part(video()))), "video 1: 12 frames show no touch"),
]


@pytest.mark.parametrize(("bad", "words"), BAD)
def test_bad_requests_keep_no_place(client: TestClient, bad: bytes | dict[str, Any], words: str) -> None:
    content = bad if isinstance(bad, bytes) else json.dumps(bad).encode()
    for _ in range(3):  # There are two places.
        response = client.post(CHAT, content=content, headers={"Content-Type": "application/json"})
        assert words in error(response, 422)
    assert client.get("/health").json()["waiting"] == 0


def test_other_refusals_and_a_model_that_breaks(client: TestClient) -> None:
    error(client.get("/nowhere"), 404)
    error(client.get("/v1/models/gpt-4"), 404)
    error(client.get(CHAT), 405)
    error(client.post(CHAT, content=b"{}", headers={"Content-Type": "text/plain"}), 415)
    assert "octopi" in error(client.post(CHAT, json={**body(ASK), "model": "gpt-4"}), 404)
    for stream in (False, True):
        assert "the server's log says why" in error(client.post(CHAT, json=body(user("break"), stream=stream)), 500)
    assert client.post(CHAT, json=body(ASK)).status_code == 200
    *_, last = events(client.post(CHAT, json=body(user("early late never"), stream=True)).text)
    assert last == {"error": {**last["error"], "message": "the touch ended; send another"}}
    assert error(client.post(CHAT, json=body(user("early late never"))), 422) == "the touch ended; send another"


def test_429_when_all_places_are_taken(client: TestClient, fake: FakeOctopi) -> None:
    asked = fake.asked
    fake.gate = threading.Event()
    with ThreadPoolExecutor(2) as pool:
        waiting = [pool.submit(client.post, CHAT, json=body(ASK)) for _ in range(2)]
        try:
            while client.get("/health").json()["waiting"] < 2:
                time.sleep(0.01)
            response = client.post(CHAT, json=body(ASK))
        finally:
            fake.gate.set()
    fake.gate = None
    assert "2 places" in error(response, 429)
    assert [a.result().status_code for a in waiting] == [200, 200]
    assert fake.asked == asked + 2
    assert client.post(CHAT, json=body(ASK)).status_code == 200


def test_addresses_and_tokens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for host, token in (("localhost", ""), ("0.0.0.0", "x" * 16)):
        listen(host, 0, token).close()
    with listen("127.0.0.1", 0) as taken:
        for host, port, words in (
            ("0.0.0.0", 0, "OCTOPI_TOKEN"),
            ("127.0.0.1", taken.getsockname()[1], "choose another"),
            ("localhost", 70_000, "cannot be had"),
        ):
            with refused(words):
                listen(host, port)
    monkeypatch.setenv("OCTOPI_TOKEN", " \n")
    assert read_token(None) == ""
    (file := tmp_path / "token").write_text(f" {'x' * 16}\n")
    assert read_token(file) == "x" * 16
    for content in (b"\n", b"x" * 15, "ü".encode() * 20, b"a b\nc" * 5, b"\xff\xfe"):
        file.write_bytes(content)
        with refused("--token-file"):
            read_token(file)
    monkeypatch.setenv("OCTOPI_TOKEN", "short")
    with refused("OCTOPI_TOKEN.*openssl"):
        read_token(None)


QUESTIONS = (("Describe this. {tactile}", 1, None), ("Is it soft?", 1, 3), ("Which is softer?", 2, 20), ("Why?", 3, 1))


async def everything(pieces: AsyncGenerator[Any]) -> str:
    return "".join([piece async for piece in pieces]).strip()


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many were answered at once, batch by batch."""
    sizes: list[int] = []
    together = Stream.together

    def counted(streams: Sequence[Stream], left: Collection[int]) -> Iterator[tuple[int, str | None]]:
        sizes.append(len(streams))
        return together(streams, left)

    monkeypatch.setattr(Stream, "together", staticmethod(counted))
    return sizes


def test_what_waits_is_one_batch_answered_as_alone(octopi: Octopi, files: list[Path], batches: list[int]) -> None:
    """Beside one that is refused, one that breaks, one that is given up before its turn, and one in the middle."""
    alone = [octopi.ask(q, files[:n], max_new_tokens=most) for q, n, most in QUESTIONS]

    async def ask() -> list[Any]:
        worker, gate = Worker(), threading.Event()
        first = asyncio.ensure_future(everything(worker.answer(lambda: [str(gate.wait(HUNG))])))

        def queue(question: str, count: int, most: int | None = None) -> AsyncGenerator[Any]:
            asked = partial(octopi.stream, question, files[:count], max_new_tokens=most)
            return worker.answer(asked)

        asked = [queue(*each) for each in QUESTIONS]
        refused, never, halfway = queue("{tactile}", 0), queue("Never?", 1), queue("Halfway?", 1)
        broken = worker.answer(lambda: iter([1 / 0]))
        begun = asyncio.ensure_future(anext(never))
        await asyncio.sleep(0)
        begun.cancel()
        await asyncio.gather(begun, return_exceptions=True)
        gate.set()
        whole = [asyncio.ensure_future(everything(pieces)) for pieces in asked]
        await anext(halfway)
        await halfway.aclose()
        failed = await asyncio.gather(everything(refused), everything(broken), return_exceptions=True)
        found = [await first, *map(type, failed), await asyncio.gather(*whole)]
        await asyncio.to_thread(worker.stop)
        return found

    *failed, answered = asyncio.run(ask())
    assert failed == ["True", UserError, Failed]
    assert answered == [text.strip() for text in alone]
    assert batches[-1] == len(QUESTIONS) + 1


def test_who_asks_moments_later_is_in_the_same_batch(
    octopi: Octopi, files: list[Path], batches: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.use.server.PAUSE", 5.0)

    async def ask() -> None:
        worker, found = Worker(), []
        for _ in range(2):
            found.append(worker.answer(lambda: octopi.stream("Why?", files[:1])))
            await asyncio.sleep(0.2)  # The thread has taken the first one by now.
        await asyncio.gather(*map(everything, found))
        await asyncio.to_thread(worker.stop)

    asyncio.run(ask())
    assert batches == [2]


def test_a_batch_that_breaks_fails_all(octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    async def ask() -> list[Any]:
        worker = Worker()
        asked = [worker.answer(lambda: octopi.stream("Why?", files[:1])) for _ in range(3)]
        found = await asyncio.gather(*map(everything, asked), return_exceptions=True)
        monkeypatch.undo()
        after = await everything(worker.answer(lambda: octopi.stream("Why?", files[:1])))
        await asyncio.to_thread(worker.stop)
        return [*map(type, found), after]

    monkeypatch.setattr("pipeline.language.generate.greedy_tokens", lambda *_: iter([1 / 0]))
    assert asyncio.run(ask()) == [Failed] * 3 + [octopi.ask("Why?", files[:1]).strip()]
