"""A real browser without a window, driven over its DevTools protocol."""

import contextlib
import itertools
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import HUNG

QUIET = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")
BROWSER = next(
    ([found, *QUIET] for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), []
)
"""The command that starts it; empty where there is none."""


class Tab:
    """One page. `events` holds what the browser reported unasked, such as requests and errors."""

    def __init__(self, socket: Any) -> None:
        self.events: list[dict[str, Any]] = []
        self._socket, self._ids = socket, itertools.count()
        for domain in ("Page", "Runtime", "Network", "DOM", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=HUNG))
            if message.get("id") == number:
                assert "error" not in message, message
                return dict(message["result"])
            self.events.append(message)

    def run(self, script: str) -> Any:
        """The value of an expression, awaited where it is a promise."""
        done = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def until(self, script: str) -> None:
        end = time.monotonic() + HUNG
        while not self.run(f"!!({script})"):
            said = self.run("document.body?.innerText")
            assert time.monotonic() < end, f"never true: {script}; the page says {said!r}"
            time.sleep(0.1)

    def choose(self, selector: str, *files: Path) -> None:
        """Put files into a file input, as its dialogue does."""
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        node = self.call("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.call("DOM.setFileInputFiles", nodeId=node, files=[str(file) for file in files])

    def type(self, selector: str, text: str) -> None:
        self.run(f"document.querySelector({json.dumps(selector)}).focus()")
        self.call("Input.insertText", text=text)
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13)

    def requests(self) -> list[str]:
        return [e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"]

    def complaints(self) -> list[str]:
        """Errors of scripts and what the page's policy refused."""
        found = []
        for event in self.events:
            if event["method"] == "Runtime.exceptionThrown":
                found.append(str(event["params"]["exceptionDetails"]))
            elif event["method"] == "Log.entryAdded" and event["params"]["entry"]["source"] != "network":
                found.append(event["params"]["entry"]["text"])
        return found


@contextlib.contextmanager
def tab(folder: Path, width: int = 1280, height: int = 900) -> Iterator[Tab]:
    """A browser with one empty tab, its profile below `folder`; skips where there is no browser."""
    if not BROWSER:
        pytest.skip("needs a browser: install chromium")
    from websockets.sync.client import connect

    profile = folder / "profile"
    command = [*BROWSER, f"--window-size={width},{height}", "--remote-debugging-port=0"]
    process = subprocess.Popen(
        [*command, f"--user-data-dir={profile}", "about:blank"],
        env={**os.environ, "HOME": str(folder)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        noted = profile / "DevToolsActivePort"
        while not (noted.exists() and noted.read_text().count("\n")):
            assert process.poll() is None, "the browser ended"
            time.sleep(0.1)
        port, path = noted.read_text().split()
        with connect(f"ws://127.0.0.1:{port}{path}") as socket:
            browser = Tab.__new__(Tab)
            browser.events, browser._socket, browser._ids = [], socket, itertools.count()
            (target,) = [t for t in browser.call("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        page = f"ws://127.0.0.1:{port}/devtools/page/{target['targetId']}"
        with connect(page, max_size=None, ping_interval=None) as socket:  # A busy browser answers late.
            yield Tab(socket)
    finally:
        process.terminate()
        process.wait(HUNG)
