"""What a trained model takes in use: the first answer of a fresh process, and answers of a server under load."""

from __future__ import annotations

import base64
import json
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.table import Row, machine, make_rows, timed
from pipeline.config.params import load_params
from pipeline.core.layout import SHIPPED
from pipeline.running.errors import UserError
from pipeline.videos.files import video_files

QUESTION = "Describe the touch. {tactile}"
CLIENTS, EACH = 20, 10
"""Clients at once, and requests of each one after another."""
COMMAND = [str(Path(sys.executable).with_name("octopi"))]


def measure(root: Path, clients: int = CLIENTS, each: int = EACH) -> list[Row]:
    """Milliseconds of one answer about a video: alone in a fresh process, from a server, and under load.

    Raises:
        UserError: where there is no trained model or no video.
    """
    place = root / load_params(root / "params.yaml").data.dir
    videos = video_files(place)[0][:clients]
    if not videos:
        raise UserError(f"{place}: holds no video to ask about; `dvc repro` makes or finds some")
    ask = [*COMMAND, "ask", QUESTION, str(videos[0]), "--model", str(SHIPPED)]
    done, first = timed(partial(subprocess.run, ask, capture_output=True, text=True, check=False))
    if done.returncode:
        raise UserError(str(done.stderr).strip() or "octopi ask failed")
    with served() as address:
        bodies = [body(video) for video in videos]
        alone = {b: post(address, b) for b in bodies}
        once = [timed(partial(post, address, b))[1] for b in bodies]

        def client(number: int) -> list[tuple[bool, float]]:
            """For each request, whether its answer differs from the one given alone, and milliseconds."""
            asked = [bodies[(number + i) % len(bodies)] for i in range(each)]
            answers = [timed(partial(post, address, b)) for b in asked]
            return [(said != alone[b], spent) for b, (said, spent) in zip(asked, answers, strict=True)]

        with ThreadPoolExecutor(clients) as pool:
            # In bfloat16 an answer may depend on its neighbours in a batch.
            other, loaded = zip(*(one for found in pool.map(client, range(clients)) for one in found), strict=True)
    costs = {"a fresh process, first answer": first}
    for who, spent in (("one client", once), (f"{clients} clients", loaded)):
        for what, share in (("median", 50), ("95 % are quicker", 95)):
            costs[f"a server, {who}: {what}"] = float(np.percentile(spent, share))
    return make_rows(
        "serving",
        {name: [spent] for name, spent in costs.items()},
        unit="ms an answer",
        baseline="a server, one client: median",
        machine=machine(f"clients on the same; {len(loaded)} requests, none lost, {sum(other)} unlike the one alone"),
    )


def body(video: Path) -> bytes:
    """A request in the form of OpenAI's chat completions."""
    touch = base64.b64encode(video.read_bytes()).decode()
    content = [
        {"type": "text", "text": QUESTION},
        {"type": "video_url", "video_url": {"url": f"data:video/mp4;base64,{touch}"}},
    ]
    return json.dumps({"model": SHIPPED.name, "messages": [{"role": "user", "content": content}]}).encode()


def post(address: str, data: bytes) -> str:
    """The answer; the server has a place for each of the clients."""
    request = urllib.request.Request(
        f"{address}/chat/completions", data, headers={"Content-Type": "application/json"}, method="POST"
    )
    try:
        with urllib.request.urlopen(request, timeout=600) as response:
            return str(json.load(response)["choices"][0]["message"]["content"])
    except urllib.error.HTTPError as error:
        raise UserError(f"the server answers {error.code}: {error.read().decode()[:200]}") from None


@contextmanager
def served() -> Iterator[str]:
    """The address of a server of the shipped model, which ends with the block."""
    running = subprocess.Popen([*COMMAND, "serve", str(SHIPPED), "--port", "0"], stdout=subprocess.PIPE, text=True)
    try:
        assert running.stdout is not None
        line = running.stdout.readline()
        if " answers at " not in line:
            raise UserError(f"octopi serve {SHIPPED}: does not start")
        yield line.split(" answers at ")[1].split(";")[0]
    finally:
        running.send_signal(signal.SIGTERM)
        running.wait(60)
