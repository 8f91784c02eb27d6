"""The page in a real browser: it renders from disk without an error, asks nobody for anything, fits phone and desk."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.review import PAGE
from tests.closure import ROOT

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
pytestmark = pytest.mark.skipif(not BROWSER, reason="needs a browser: install chromium")
PROBE = """<script>addEventListener("load", () => {
  const outside = [...document.querySelectorAll("main *, header *")].filter(e => !e.closest(".scroll, svg, caption"));
  const wide = outside.filter(e => e.getBoundingClientRect().right > innerWidth + 1);
  parent.postMessage(JSON.stringify({
    width: innerWidth,
    scroll: document.documentElement.scrollWidth,
    wide: wide.map(e => e.tagName + "." + e.className),
    broken: [...document.images].filter(e => !e.naturalWidth).length,
    ground: getComputedStyle(document.body).backgroundColor,
    folded: document.querySelectorAll("details:not([open])").length,
  }), "*");
});</script>"""

FRAME = """<!doctype html><title>none</title>
<script>onmessage = event => {{ document.title = event.data; }};</script>
<iframe src="probe.html" style="width: {width}px; height: 900px; border: 0"></iframe>"""
NOBODY = "not an origin"
"""Who the browser says has asked where it asks on its own account, for the time or a dictionary, say."""


@dataclass(frozen=True)
class Seen:
    """What a script in the page found."""

    width: int
    scroll: int
    wide: list[str]
    broken: int
    ground: str
    folded: int


def browse(folder: Path, page: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    quiet = [
        "--disable-background-networking",
        "--no-first-run",
        "--enable-logging=stderr",
        "--virtual-time-budget=3000",
    ]
    environment = {**os.environ, "HOME": str(folder)}
    return subprocess.run(
        [*command, *quiet, *options, page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
        env=environment,
    )


def asked(log: Path) -> list[str]:
    """The addresses in a net log that a page asked for."""
    events = [event.get("params", {}) for event in json.loads(log.read_text())["events"]]
    return [e["url"] for e in events if e.get("url", "").startswith("http") and e.get("initiator", NOBODY) != NOBODY]


def probe(folder: Path, width: int, *options: str) -> Seen:
    """Open a copy of the page that has a script to measure with, which the page itself forbids.

    It stands in a frame, since browsers allow no window as narrow as a phone.
    """
    text = (ROOT / PAGE).read_text(encoding="utf-8")
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text).replace("</body>", f"{PROBE}</body>")
    (folder / "probe.html").write_text(text, encoding="utf-8")
    frame = folder / "frame.html"
    frame.write_text(FRAME.format(width=width), encoding="utf-8")
    title = re.search(r"<title>(.*?)</title>", browse(folder, frame, "--dump-dom", *options).stdout)
    assert title is not None
    return Seen(**json.loads(title[1]))


def test_it_renders_without_an_error_or_a_request(tmp_path: Path) -> None:
    log, shot = tmp_path / "net.json", tmp_path / "shot.png"
    size = "--window-size=1400,1600"
    done = browse(tmp_path, ROOT / PAGE, size, "--hide-scrollbars", f"--log-net-log={log}", f"--screenshot={shot}")
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line or "Refused" in line]
    assert console == []
    assert struct.unpack(">II", shot.read_bytes()[16:24]) == (1400, 1600)
    assert shot.stat().st_size > 50_000, "an empty window compresses to less"
    assert asked(log) == []


def test_a_request_of_a_page_would_be_seen(tmp_path: Path) -> None:
    log, page = tmp_path / "net.json", tmp_path / "page.html"
    page.write_text('<!doctype html><img src="http://127.0.0.1:9/x.png" alt="none">')
    browse(tmp_path, page, f"--log-net-log={log}", "--dump-dom")
    assert set(asked(log)) == {"http://127.0.0.1:9/x.png"}


@pytest.mark.parametrize(
    ("width", "scheme", "ground"),
    [(390, 0, "rgb(17, 21, 26)"), (1400, 1, "rgb(255, 255, 255)")],
    ids=["phone", "desktop"],
)
def test_it_fits_the_window_in_dark_and_light(tmp_path: Path, width: int, scheme: int, ground: str) -> None:
    seen = probe(tmp_path, width, "--window-size=1500,1000", f"--blink-settings=preferredColorScheme={scheme}")
    assert seen.width == width
    assert seen.scroll <= width, seen.wide
    assert seen.wide == []
    assert seen.broken == 0
    assert seen.folded > 3
    assert seen.ground == ground
