"""`octopi serve` in process: OpenAI's forms field by field, and every way to be refused."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from pipeline.use.media import Limits
from pipeline.use.model import Octopi
from pipeline.use.serve import make_app
from tests.conftest import HUNG
from tests.use.fake import FakeOctopi, digest
from tests.use.videos import claims_frames, claims_pixels, uri, video

TOKEN = "0123456789abcdef"
CHAT = "/v1/chat/completions"
LIMITS = Limits(body_bytes=400_000, videos=3, frames=200)


@pytest.fixture(scope="module")
def fake() -> FakeOctopi:
    return FakeOctopi()


@pytest.fixture(scope="module")
def client(fake: FakeOctopi) -> Iterator[TestClient]:
    app = make_app(fake, "octopi", token=TOKEN, limits=LIMITS, places=2, most_tokens=100)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with TestClient(app, headers=headers, raise_server_exceptions=False) as client:
        yield client


def part(data: bytes, kind: str = "video_url") -> dict[str, Any]:
    return {"type": kind, kind: {"url": uri(data)}}


def text(words: str) -> dict[str, Any]:
    return {"type": "text", "text": words}


def user(*content: Any) -> dict[str, Any]:
    return {"role": "user", "content": content[0] if isinstance(content[0], str) else list(content)}


def body(*messages: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"model": "octopi", "messages": list(messages), **more}


def events(content: str) -> list[Any]:
    """Server-sent events by the WHATWG's grammar: `data:` lines, a blank line behind each event."""
    assert content.endswith("\n\n")
    found = [line.removeprefix("data: ") for line in content.split("\n\n")[:-1]]
    assert all("\n" not in event for event in found)
    return [event if event == "[DONE]" else json.loads(event) for event in found]


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


# ---- OpenAI's forms ----


def test_an_answer_has_openai_s_fields(client: TestClient) -> None:
    began = time.time()
    response = client.post(CHAT, json=body(user(text("How soft is it?"), part(video(1)))))
    assert response.status_code == 200
    answer = response.json()
    # github.com/openai/openai-openapi, CreateChatCompletionResponse: required are all of these; usage is not.
    assert set(answer) == {"id", "object", "created", "model", "choices", "notes"}
    assert answer["notes"] == ["video 1: little touches the sensor"]
    assert answer["id"].startswith("chatcmpl-")
    assert (answer["object"], answer["model"]) == ("chat.completion", "octopi")
    assert type(answer["created"]) is int
    assert abs(answer["created"] - began) < HUNG
    (choice,) = answer["choices"]
    message = {"role": "assistant", "content": f"{{tactile}} How soft is it? | {digest(video(1))} ", "refusal": None}
    assert choice == {"index": 0, "message": message, "logprobs": None, "finish_reason": "stop"}


def test_a_stream_has_openai_s_chunks(client: TestClient) -> None:
    seen = client.post(CHAT, json=body(user(text("one"), part(video(1))), stream=True))
    assert events(seen.text)[-2]["notes"] == ["video 1: little touches the sensor"]
    response = client.post(CHAT, json=body(user("one two three"), stream=True))
    assert response.headers["content-type"].startswith("text/event-stream")
    *chunks, done = events(response.text)
    assert done == "[DONE]"
    assert chunks[-1].pop("notes") == []
    for chunk in chunks:
        assert set(chunk) == {"id", "object", "created", "model", "choices"}
        assert chunk["object"] == "chat.completion.chunk"
        assert set(chunk["choices"][0]) == {"index", "delta", "logprobs", "finish_reason"}
    assert len({(c["id"], c["created"], c["model"]) for c in chunks}) == 1
    deltas = [c["choices"][0]["delta"] for c in chunks]
    words = [{"content": f"{word} "} for word in ("one", "two", "three")]
    assert deltas == [{"role": "assistant", "content": ""}, *words, {}]
    assert [c["choices"][0]["finish_reason"] for c in chunks] == [None] * 4 + ["stop"]


def test_models(client: TestClient) -> None:
    listed = client.get("/v1/models").json()
    assert (set(listed), listed["object"]) == ({"object", "data"}, "list")
    (entry,) = listed["data"]
    assert set(entry) == {"id", "object", "created", "owned_by"}
    assert (entry["id"], entry["object"]) == ("octopi", "model")
    assert client.get("/v1/models/octopi").json() == entry
    error(client.get("/v1/models/gpt-4"), 404)


def test_openai_s_own_client(client: TestClient) -> None:
    openai = pytest.importorskip("openai")
    there = openai.OpenAI(base_url="http://testserver/v1", api_key=TOKEN, http_client=client)
    assert there.chat.completions.create(**body(user("hello"))).choices[0].message.content == "hello "
    assert [m.id for m in there.models.list()] == ["octopi"]


def test_the_real_model_answers_as_the_library_does(octopi: Octopi, files: list[Path]) -> None:
    question = "Which is softer, {tactile} or {tactile}?"
    asked = body(user(text(question), *(part(file.read_bytes()) for file in files[:2])))
    blank = body(user(text("What is it?"), part(video(1, 1))))
    with TestClient(make_app(octopi, "octopi"), base_url="http://localhost") as client:
        whole = client.post(CHAT, json=asked).json()["choices"][0]["message"]["content"]
        *chunks, _ = events(client.post(CHAT, json={**asked, "stream": True}).text)
        refused = error(client.post(CHAT, json=blank), 422)
    assert whole == "".join(c["choices"][0]["delta"].get("content", "") for c in chunks)
    assert whole.strip() == octopi.ask(question, files[:2]).strip()
    assert refused.startswith("video 1")


@pytest.mark.parametrize(
    ("content", "question"),
    [
        ((text("Which is softer?"), part(video(1)), part(video(2))), "{tactile} {tactile} Which is softer?"),
        ((part(video(1)), part(video(2)), text("Which is softer?")), "{tactile} {tactile} Which is softer?"),
        ((text("a) {tactile} b) {tactile}?"), part(video(1)), part(video(2))), "a) {tactile} b) {tactile}?"),
        ((text("a)\n"), part(video(1)), text("\nb)\n"), part(video(2))), "a)\n{tactile}\nb)\n{tactile}"),
        (
            (text("a)"), part(video(1), "image_url"), text("b)"), part(video(2), "image_url")),
            "a) {tactile} b) {tactile}",
        ),
    ],
)
def test_videos_stand_where_their_parts_or_marks_stand(client: TestClient, content: Any, question: str) -> None:
    answer = client.post(CHAT, json=body(user(*content))).json()["choices"][0]["message"]["content"]
    assert answer == f"{question} | {digest(video(1))} | {digest(video(2))} "


def test_a_conversation_and_what_is_let_through(client: TestClient, fake: FakeOctopi) -> None:
    before = user(text("First"), part(video(1)))
    messages = [
        {"role": "system", "content": "You are a robot."},
        before,
        {"role": "assistant", "content": [text("Soft.")]},
        {"role": "developer", "content": [text("x")]},
        user(text("Second"), part(video(2))),
    ]
    more = {"temperature": 0.2, "top_p": 1, "seed": 4, "user": "r2", "n": 1, "tools": [], "stop": None, "x": {"y": 1}}
    response = client.post(CHAT, json=body(*messages, max_tokens=7, **more))
    said = f"{{tactile}} Second | First>Soft.:{digest(video(1))} | {digest(video(2))} "
    assert response.json()["choices"][0]["message"]["content"] == said
    assert fake.tokens[-1] == 7
    client.post(CHAT, json=body(user("a"), max_completion_tokens=5000))
    client.post(CHAT, json=body(user("a")))
    assert fake.tokens[-2:] == [100, None]


# ---- refused ----


@pytest.mark.parametrize("path", ["/v1/models", "/v1/models/octopi", "/metrics", CHAT])
@pytest.mark.parametrize("header", ["", "Bearer", "Bearer wrong", f"Basic {TOKEN}x", f"Bearer {TOKEN}x", "Bearer \xe9"])
def test_401(client: TestClient, path: str, header: str) -> None:
    headers = {"Authorization": header.encode("latin-1")}
    response = client.request("POST" if path == CHAT else "GET", path, headers=headers)
    assert "token" in error(response, 401)
    assert response.headers["www-authenticate"] == "Bearer"


def test_health_needs_no_token(client: TestClient) -> None:
    health = client.get("/health", headers={"Authorization": ""})
    assert health.json() == {"status": "ok", "model": "octopi", "waiting": 0, "places": 2}


def test_without_a_token_only_this_machine_s_names_are_answered(fake: FakeOctopi) -> None:
    for base, status in {
        **dict.fromkeys(("http://127.0.0.1:8000", "http://localhost", "http://[::1]:80"), 200),
        **dict.fromkeys(("http://evil.example", "http://127.0.0.1.evil.example"), 403),
    }.items():
        with TestClient(make_app(fake, "octopi"), base_url=base) as client:
            assert client.get("/v1/models").status_code == status


def test_413(client: TestClient) -> None:
    assert "400000 bytes" in error(client.post(CHAT, json=body(user("x" * 400_000))), 413)
    chunks = (b"x" * 1000 for _ in range(500))
    error(client.post(CHAT, content=chunks, headers={"Content-Type": "application/json"}), 413)
    assert "4 videos" in error(client.post(CHAT, json=body(user(*[part(video())] * 4))), 413)
    assert "longer than 200 frames" in error(client.post(CHAT, json=body(user(part(claims_frames(10**6))))), 413)
    assert "pixels" in error(client.post(CHAT, json=body(user(part(claims_pixels(40_000, 40_000))))), 413)


ASK = user("hello")
BAD: list[tuple[bytes | dict[str, Any], str]] = [
    (b"", "JSON"),
    (b"{", "JSON"),
    (b"\xff\xfe", "JSON"),
    (b"[" * 100_000, "JSON"),
    (b"[]", "body"),
    (b"null", "body"),
    (b'{"model": NaN}', "model"),
    ({"model": "octopi"}, "messages"),
    ({"messages": [ASK]}, "model"),
    (body(), "messages"),
    (body(*[ASK] * 65), "messages"),
    (body({"role": "user"}), "messages.0.content"),
    (body({"role": "tool", "content": "a"}), "messages.0.role"),
    (body(user("x" * 20_001)), "at most 20000 characters"),
    (body(user({"type": "input_audio", "input_audio": {}})), "messages.0.content.0: Input tag 'input_audio'"),
    (body(user({"type": "video_url", "video_url": "data:"})), "messages.0.content.0.video_url.video_url"),
    (body({"role": "user", "content": []}), "messages.0.content"),
    (body(ASK, ASK), "take turns"),
    (body({"role": "assistant", "content": "a"}), "take turns"),
    (body(ASK, {"role": "assistant", "content": "a"}), "take turns"),
    (body({"role": "system", "content": "a"}), "take turns"),
    (body(ASK, {"role": "assistant", "content": [part(video())]}, ASK), "assistant"),
    (body(ASK, n=2), "n:"),
    (body(ASK, tools=[{"type": "function"}]), "tools"),
    (body(ASK, stop=["."]), "stop"),
    (body(ASK, logprobs=True), "logprobs"),
    (body(ASK, response_format={"type": "json_object"}), "response_format"),
    (body(ASK, max_tokens=0), "max_tokens"),
    (body(ASK, max_tokens="many"), "max_tokens"),
    (body(user({"type": "video_url", "video_url": {"url": "file:///etc/passwd"}})), "data URI"),
    (body(user({"type": "video_url", "video_url": {"url": "http://127.0.0.1/a.mp4"}})), "data URI"),
    (body(user({"type": "video_url", "video_url": {"url": "/etc/passwd"}})), "base64"),
    (body(user({"type": "image_url", "image_url": {"url": "data:video/mp4;base64,AAA"}})), "messages.0.content.0"),
    (body(user({"type": "video_url", "video_url": "data:video/mp4;base64,AAAA"})), "messages.0.content"),
    (body(user(part(b"no video at all"))), "video 1: no video"),
    (body(user(text("no mark"), part(b"GIF89a" + bytes(50)))), "video 1: no video"),
    (body(user("one {tactile} and no video")), "{tactile}"),
    (body(user(text("blank"), part(video()))), "video 1: 12 frames show no touch"),
    (body(user(text("{tactile} {tactile}"), part(video()))), "{tactile}"),
]


def send(client: TestClient, bad: bytes | dict[str, Any]) -> Any:
    content = bad if isinstance(bad, bytes) else json.dumps(bad).encode()
    return client.post(CHAT, content=content, headers={"Content-Type": "application/json"})


@pytest.mark.parametrize(("bad", "words"), BAD)
def test_422(client: TestClient, bad: bytes | dict[str, Any], words: str) -> None:
    assert words in error(send(client, bad), 422)


def test_a_thousand_bad_requests_and_a_good_one(client: TestClient) -> None:
    for i in range(1000):
        error(send(client, BAD[i % len(BAD)][0]), 422)
    assert client.get("/health").json()["waiting"] == 0
    answer = client.post(CHAT, json=body(user(text("good"), part(video(3))))).json()
    assert answer["choices"][0]["message"]["content"] == f"{{tactile}} good | {digest(video(3))} "


def test_other_refusals(client: TestClient) -> None:
    error(client.get("/nowhere"), 404)
    error(client.get(CHAT), 405)
    error(client.post(CHAT, content=b"{}", headers={"Content-Type": "text/plain"}), 415)
    assert "octopi" in error(client.post(CHAT, json={**body(ASK), "model": "gpt-4"}), 404)


def test_a_model_that_breaks_is_500_and_goes_on(client: TestClient) -> None:
    assert "log" in error(client.post(CHAT, json=body(user("break"))), 500)
    assert client.post(CHAT, json=body(ASK)).status_code == 200
    streamed = client.post(CHAT, json=body(user("break"), stream=True))
    assert "secret" not in error(streamed, 500)


def test_an_error_late_in_a_stream_is_its_last_event(client: TestClient) -> None:
    *_, last = events(client.post(CHAT, json=body(user("early late never"), stream=True)).text)
    assert last == {"error": {**last["error"], "message": "the touch ended; send another"}}
    assert error(client.post(CHAT, json=body(user("early late never"))), 422) == "the touch ended; send another"


def test_429_when_all_places_are_taken(client: TestClient, fake: FakeOctopi) -> None:
    asked = fake.asked
    fake.gate = threading.Event()
    answers: list[Any] = []
    waiting = [threading.Thread(target=lambda: answers.append(client.post(CHAT, json=body(ASK)))) for _ in range(2)]
    try:
        for thread in waiting:
            thread.start()
        while client.get("/health").json()["waiting"] < 2:
            time.sleep(0.01)
        response = client.post(CHAT, json=body(ASK))
        assert "2 places" in error(response, 429)
        assert 1 <= int(response.headers["retry-after"]) <= 600
    finally:
        fake.gate.set()
        for thread in waiting:
            thread.join(HUNG)
        fake.gate = None
    assert [a.status_code for a in answers] == [200, 200]
    assert fake.asked == asked + 2
    assert client.post(CHAT, json=body(ASK)).status_code == 200


def test_metrics_are_prometheus_text_and_count(client: TestClient) -> None:
    def read() -> dict[str, float]:
        response = client.get("/metrics")
        assert response.headers["content-type"].startswith("text/plain; version=0.0.4")
        lines = [line for line in response.text.splitlines() if not line.startswith("#")]
        # prometheus.io/docs/instrumenting/exposition_formats: name, labels in braces, a number.
        form = r'[a-z_]+(\{[a-z]+="[^"]*"\})? [0-9.]+'
        assert all(re.fullmatch(form, line) for line in lines)
        return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines)}

    before = read()
    client.post(CHAT, json=body(user(part(video(1)), part(video(2)))))
    send(client, b"{")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.use.serve.read_request", lambda _: 1 / 0)
        assert client.post(CHAT, json=body(ASK)).status_code == 500
    after = read()
    grown = {name: after[name] - before.get(name, 0) for name in after}
    assert grown['octopi_requests_total{status="422"}'] == grown["octopi_answer_seconds_count"] == 1
    assert grown['octopi_requests_total{status="500"}'] == 1
    assert grown["octopi_videos_total"] == 2
    assert "octopi_answer_seconds_sum" in after
