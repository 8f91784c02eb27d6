"""`octopi serve` on a real socket: many clients, slow ones, rude ones, and its end."""

from __future__ import annotations

import gc
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from typer.testing import CliRunner

from pipeline.cli import app as cli
from pipeline.core.errors import UserError
from pipeline.use import serve, server
from pipeline.use.media import Limits
from pipeline.use.serve import make_app
from pipeline.use.server import listen, read_token
from tests.closure import ROOT
from tests.conftest import HUNG, refused, wait_until_ended
from tests.use.fake import CHAT, FakeOctopi, body, digest, events, part, running, said, text, user
from tests.use.videos import video


def serving(fake: FakeOctopi, **options: Any) -> Any:
    return running(make_app(fake, "octopi", **options))


def call(port: int, method: str, path: str, content: bytes = b"") -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=HUNG)
    try:
        connection.request(method, path, content, {"Content-Type": "application/json"})
        response = connection.getresponse()
        return response.status, response.read().decode()
    finally:
        connection.close()


def ask(port: int, content: dict[str, Any] | bytes) -> tuple[int, Any]:
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    status, found = call(port, "POST", CHAT, data)
    return status, found if found.startswith("data:") else json.loads(found)


def waiting(port: int) -> int:
    return int(json.loads(call(port, "GET", "/health")[1])["waiting"])


def wait_for(condition: Any) -> None:
    end = time.monotonic() + HUNG
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_twenty_clients_ten_requests_none_lost_none_mixed_up() -> None:
    """Each of 200 questions and videos is its own, so any answer that went astray shows."""
    jobs = [(i, video(i % 10, 4 + i // 10)) for i in range(200)]
    assert len({digest(data) for _, data in jobs}) == 200

    def client(number: int) -> list[str]:
        found = []
        for i, data in jobs[number::20]:
            content = body(user(text(f"number {i}"), part(data)), stream=bool(i % 2))
            while (answer := ask(port, content))[0] == 429:
                time.sleep(0.05)
            assert answer[0] == 200, answer
            found.append(said(answer[1]))
        return found

    fake = FakeOctopi()
    with serving(fake, places=12) as port, ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(client, range(20)))
    for number, found in enumerate(answers):
        assert found == [f"{{tactile}} number {i} | {digest(data)} " for i, data in jobs[number::20]]
    assert fake.asked == 200
    assert len(fake.threads) == 1


def test_a_refused_body_is_read_so_that_the_answer_is_seen() -> None:
    with serving(FakeOctopi(), limits=Limits(body_bytes=100_000)) as port:
        assert ask(port, b"x" * 300_000)[0] == 413
        assert ask(port, body(user("hello")))[0] == 200


def test_slow_clients_are_hung_up_on_and_others_are_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits are short only while nobody is meant to keep them."""
    monkeypatch.setattr(server, "HEADER_SECONDS", HUNG)
    monkeypatch.setattr(serve, "UPLOAD_SECONDS", 0.1)
    head = b"POST /v1/chat/completions HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    kept = b"GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"

    def received(client: socket.socket, end: bytes = b"") -> bytes:
        """What comes until it ends so, or until the server hangs up."""
        found = b""
        while (piece := client.recv(10_000)) and not (end and (found + piece).endswith(end)):
            found += piece
        return found + piece

    with serving(FakeOctopi(), places=1) as port, ExitStack() as stack:

        def connect() -> socket.socket:
            return stack.enter_context(socket.create_connection(("127.0.0.1", port), HUNG))

        slow_body, second = connect(), connect()
        slow_body.sendall(head + b"Content-Type: application/json\r\nContent-Length: 50\r\n\r\n{")
        assert b" 408 " in received(slow_body).split(b"\r\n")[0]
        second.sendall(kept)
        assert b"200 OK" in received(second, b"}")
        monkeypatch.setattr(server, "HEADER_SECONDS", 0.1)
        silent, slow_head = connect(), connect()
        slow_head.sendall(head)
        second.sendall(kept[:-2])
        assert [received(client) for client in (silent, slow_head, second)] == [b""] * 3
        monkeypatch.setattr(server, "HEADER_SECONDS", HUNG)
        monkeypatch.setattr(serve, "UPLOAD_SECONDS", HUNG)
        # The place is free again.
        assert ask(port, body(user("hello")))[0] == 200


@pytest.mark.parametrize("stream", [False, True])
def test_who_hangs_up_frees_the_place_and_stops_the_model(stream: bool) -> None:
    fake = FakeOctopi(0.01)
    with serving(fake, places=1) as port:
        data = json.dumps(body(user("endless"), stream=stream)).encode()
        client = socket.create_connection(("127.0.0.1", port))
        head = (
            f"POST {CHAT} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {len(data)}"
        )
        client.sendall(f"{head}\r\n\r\n".encode() + data)
        wait_for(lambda: fake.asked == 1)
        client.close()
        # An answer without end leaves its place only where it is given up.
        wait_for(lambda: waiting(port) == 0)
        assert "octopi_answer_seconds_count 0" in call(port, "GET", "/metrics")[1]
        assert ask(port, body(user("hello")))[0] == 200


SCRIPT = """
import sys, threading
from pipeline.use.serve import make_app
from pipeline.use.server import listen, make_server
from tests.use.fake import FakeOctopi
fake = FakeOctopi()
fake.gate = threading.Event()
threading.Thread(target=lambda: sys.stdin.readline() and fake.gate.set(), daemon=True).start()
with listen("127.0.0.1", 0, "") as listening:
    print(listening.getsockname()[1], flush=True)
    make_server(make_app(fake, "octopi")).run(sockets=[listening])
"""


@contextmanager
def started() -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A server in a process of its own, and its port. It answers after a line on its standard input."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", SCRIPT]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env)
    try:
        assert process.stdout is not None
        yield process, int(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


def answer_now(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    print(file=process.stdin, flush=True)


def listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), HUNG).close()
    except ConnectionRefusedError:
        return False
    return True


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_stopping_finishes_what_was_asked_and_leaves_no_process() -> None:
    """No answer begins before the server has been told to stop and listens no more."""
    with started() as (process, port), ThreadPoolExecutor(4) as pool:
        contents = [body(user(text(f"{i} " + "x " * 15), part(video(i))), stream=i == 3) for i in range(4)]
        answers = [pool.submit(ask, port, content) for content in contents]
        # A busy machine takes longer to start the process that checks videos than to count who waits.
        wait_for(lambda: waiting(port) == 4 and len(psutil.Process(process.pid).children()) > 0)
        children = psutil.Process(process.pid).children()
        process.send_signal(signal.SIGTERM)
        wait_for(lambda: not listens(port))
        answer_now(process)
        assert [a.result()[0] for a in answers] == [200] * 4
        for i, answer in enumerate(answers[:3]):
            assert said(answer.result()[1]).split() == ["{tactile}", str(i), *"x" * 15, "|", digest(video(i))]
        assert events(answers[3].result()[1])[-1] == "[DONE]"
        process.wait(HUNG)
        assert len(children) == 1
        wait_until_ended(children)


def test_no_checking_process_outlives_a_killed_server() -> None:
    with started() as (process, port):
        answer_now(process)
        assert ask(port, body(user(part(video()))))[0] == 200
        children = psutil.Process(process.pid).children()
    assert len(children) == 1
    wait_until_ended(children)


def test_answers_take_no_memory() -> None:
    """A hundred requests of 0.4 MB leave less behind than two of them brought; Python counts what it has given out."""
    padding = json.dumps({**body(user(text("hello"), part(video()))), "x": "y" * 400_000}).encode()
    with serving(FakeOctopi()) as port:

        def ask_often(times: int) -> int:
            for _ in range(times):
                assert ask(port, padding)[0] == 200
            gc.collect()
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            ask_often(30)
            before = ask_often(1)
            assert ask_often(100) - before < 2 * len(padding)
        finally:
            tracemalloc.stop()


# ---- the command ----


def test_addresses() -> None:
    """Others than this machine's need a token."""
    for host, token in (("127.0.0.1", ""), ("localhost", ""), ("0.0.0.0", "x" * 16)):
        listen(host, 0, token).close()
    with listen("127.0.0.1", 0, "") as taken:
        for host, port, token, words in (
            ("0.0.0.0", 0, "", "OCTOPI_TOKEN"),
            ("127.0.0.1", taken.getsockname()[1], "", "choose another"),
            ("localhost", 70_000, "", "cannot be had"),
            ("300.1.1.1", 0, "x" * 16, "cannot be had"),
            ("no such name.invalid", 0, "x" * 16, "cannot be had"),
        ):
            with refused(words):
                listen(host, port, token)


def test_tokens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCTOPI_TOKEN", " \n")
    assert read_token(None) == ""
    (file := tmp_path / "token").write_text(f" {'x' * 16}\n")
    assert read_token(file) == "x" * 16
    for weak in ("short", "x" * 15, "ü" * 20, "a b\nc" * 5):
        file.write_text(weak, encoding="utf-8")
        with refused("openssl"):
            read_token(file)


def test_the_command_says_what_is_wrong_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OCTOPI_TOKEN", raising=False)
    (tmp_path / "empty").write_text("\n")
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    for options, words in {
        ("--host", "0.0.0.0"): "OCTOPI_TOKEN",
        ("--token-file", str(tmp_path / "none")): "--token-file",
        ("--token-file", str(tmp_path / "empty")): "empty",
        ("--token-file", str(tmp_path / "binary")): "--token-file",
        ("--token-file", str(tmp_path)): "--token-file",
    }.items():
        result = CliRunner().invoke(cli, ["serve", str(tmp_path), "--port", "0", *options])
        assert isinstance(result.exception, UserError)
        assert words in str(result.exception)
        assert "\n" not in str(result.exception)
