"""`octopi serve` on a real socket: many clients, slow ones, rude ones, and its end; and the demo's command."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import httpx2
import psutil
import pytest

from pipeline.use.serve import make_app
from pipeline.videos.catalogue import load_catalogue
from tests.conftest import HUNG, ROOT, wait_for, wait_until_ended
from tests.project import ENVIRONMENT
from tests.use.fake import CHAT, FakeOctopi, Running, body, digest, events, part, running, said, text, user
from tests.use.shared import Made
from tests.use.videos import video


@contextmanager
def serving(fake: FakeOctopi, **options: Any) -> Iterator[str]:
    with running(make_app(fake, "octopi", **options)) as port:
        yield f"http://127.0.0.1:{port}"


def ask(address: str, content: dict[str, Any] | bytes) -> httpx2.Response:
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    headers = {"Content-Type": "application/json"}
    return httpx2.post(f"{address}{CHAT}", content=data, headers=headers, timeout=HUNG)


def waiting(address: str) -> int:
    return int(httpx2.get(f"{address}/health", timeout=HUNG).json()["waiting"])


def listens(address: str) -> bool:
    """Asks nothing: a request that comes just as the server stops may be dropped without an answer."""
    try:
        socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])), HUNG).close()
    except ConnectionError:
        return False
    return True


def test_no_answer_of_many_clients_is_lost_or_mixed_up() -> None:
    jobs = [(i, video(i % 10, 4 + i // 10)) for i in range(60)]
    assert len({digest(data) for _, data in jobs}) == 60

    def client(number: int) -> list[str]:
        found = []
        for i, data in jobs[number::10]:
            content = body(user(text(f"number {i}"), part(data)), stream=bool(i % 2))
            while (answer := ask(address, content)).status_code == 429:
                time.sleep(0.05)
            assert answer.status_code == 200, answer.text
            found.append(said(answer.text if i % 2 else answer.json()))
        return found

    fake = FakeOctopi()
    with serving(fake, places=6) as address, ThreadPoolExecutor(10) as pool:
        answers = list(pool.map(client, range(10)))
    for number, found in enumerate(answers):
        assert found == [f"{{tactile}} number {i} | {digest(data)} " for i, data in jobs[number::10]]
    assert fake.asked == 60
    assert len(fake.threads) == 1


def test_a_refused_body_is_read_so_that_the_answer_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.use.serve.MOST_BYTES", 100_000)
    with serving(FakeOctopi()) as address:
        assert ask(address, b"x" * 300_000).status_code == 413
        assert ask(address, body(user("hello"))).status_code == 200


@pytest.mark.parametrize("stream", [False, True])
def test_who_hangs_up_frees_the_place_and_stops_the_model(stream: bool) -> None:
    fake = FakeOctopi(0.01)
    with serving(fake, places=1) as address:
        data = json.dumps(body(user("endless"), stream=stream)).encode()
        head = f"POST {CHAT} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: "
        with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as client:
            client.sendall(f"{head}{len(data)}\r\n\r\n".encode() + data)
            wait_for(lambda: fake.asked == 1)
        # An answer without end leaves its place only where it is given up.
        wait_for(lambda: waiting(address) == 0)
        assert ask(address, body(user("hello"))).status_code == 200


SCRIPT = """
import sys, threading
from pipeline.use.serve import make_app
from pipeline.use.server import listen, make_server
from tests.use.fake import FakeOctopi
fake = FakeOctopi()
fake.gate = threading.Event()
threading.Thread(target=lambda: sys.stdin.readline() and fake.gate.set(), daemon=True).start()
with listen("127.0.0.1", 0) as listening:
    print(listening.getsockname()[1], flush=True)
    make_server(make_app(fake, "octopi")).run(sockets=[listening])
"""


@contextmanager
def started() -> Iterator[tuple[Any, str]]:
    """A server in a process of its own, and its address. It answers after a line on its standard input."""
    command = [sys.executable, "-c", SCRIPT]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
    try:
        yield process, f"http://127.0.0.1:{int(process.stdout.readline())}"
    finally:
        process.kill()
        process.communicate()


def test_stopping_finishes_what_was_asked_and_leaves_no_process() -> None:
    """No answer begins before the server has been told to stop and listens no more."""
    with started() as (process, address), ThreadPoolExecutor(4) as pool:
        contents = [body(user(text(f"{i} " + "x " * 15), part(video(i))), stream=i == 3) for i in range(4)]
        answers = [pool.submit(ask, address, content) for content in contents]
        # Beside the process that checks videos, multiprocessing has one of its own.
        wait_for(lambda: waiting(address) == 4 and len(psutil.Process(process.pid).children()) == 2)
        children = psutil.Process(process.pid).children()
        process.send_signal(signal.SIGTERM)
        wait_for(lambda: not listens(address))
        print(file=process.stdin, flush=True)
        assert [a.result().status_code for a in answers] == [200] * 4
        for i, answer in enumerate(answers[:3]):
            assert said(answer.result().json()).split() == ["{tactile}", str(i), *"x" * 15, "|", digest(video(i))]
        assert events(answers[3].result().text)[-1] == "[DONE]"
        process.wait(HUNG)
        wait_until_ended(children)


def test_no_checking_process_outlives_a_killed_server() -> None:
    with started() as (process, address):
        print(file=process.stdin, flush=True)
        assert ask(address, body(user(part(video())))).status_code == 200
        children = psutil.Process(process.pid).children()
    assert len(children) == 2
    wait_until_ended(children)


def test_the_demo_is_shown_until_it_is_interrupted(made: Made) -> None:
    catalogue = ROOT / "pipeline" / "physiclear"
    demo = Running("demo", made.folder, "--catalogue", catalogue, folder=made.folder.parents[1])
    try:
        assert demo.rest == "shows the demo; Ctrl-C ends it\n"
        about = httpx2.get(f"{demo.address}/api/about", timeout=HUNG).json()
        assert about["model"] == "finetuned-with-all-0"
        assert len(about["scenes"]) == len(load_catalogue(catalogue).objects)
    finally:
        demo.process.send_signal(signal.SIGINT)
    assert demo.process.wait(HUNG) == 0
