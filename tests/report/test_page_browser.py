"""The page in a real browser: it opens from disk without an error or a request, fits phone and desk, and unfolds."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pipeline.report.page import write_page
from tests.report.shared import write_reports
from tests.use.browser import BROWSER

pytestmark = pytest.mark.skipif(not BROWSER, reason="needs a browser: install chromium")
PROBE = """<script>addEventListener("load", () => {
  const wide = e => !e.closest(".scroll, svg, caption, .skip") && e.getBoundingClientRect().right > innerWidth + 1;
  const seen = () => ({
    scroll: document.documentElement.scrollWidth,
    wide: [...document.querySelectorAll("body *")].filter(wide).map(e => e.tagName + "." + e.className),
    high: document.documentElement.scrollHeight,
  });
  const folded = [...document.querySelectorAll("details:not([open])")], before = seen();
  folded.forEach(e => e.querySelector("summary").click());
  const clipped = [...document.querySelectorAll(".scroll")].filter(e => e.scrollWidth > e.clientWidth);
  parent.postMessage(JSON.stringify({
    before, after: seen(), folded: folded.length, shut: folded.filter(e => !e.open).length,
    scrolls: clipped.filter(e => getComputedStyle(e).overflowX === "auto").length, clipped: clipped.length,
    ground: getComputedStyle(document.body).backgroundColor,
  }), "*");
});</script>"""
FRAME = """<!doctype html><title>none</title><script>onmessage = e => {{ document.title = e.data; }};</script>
<iframe src="probe.html" style="width: {width}px; height: 900px; border: 0"></iframe>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(write_reports(tmp_path_factory.mktemp("browser"), "small-videos"))


def browse(folder: Path, page: Path, *options: str) -> subprocess.CompletedProcess[str]:
    log = ("--enable-logging=stderr", "--virtual-time-budget=3000", f"--user-data-dir={folder / 'profile'}")
    command = [*BROWSER, *log, *options, page.as_uri()]
    environment = {**os.environ, "HOME": str(folder)}
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment)


def asked(log: Path) -> list[str]:
    """The addresses in a net log that a page asked for, and not the browser on its own account."""
    events = [event.get("params", {}) for event in json.loads(log.read_text())["events"]]
    own = "not an origin"
    return [e["url"] for e in events if e.get("url", "").startswith("http") and e.get("initiator", own) != own]


def test_it_opens_without_an_error_or_a_request(page: Path, tmp_path: Path) -> None:
    log = tmp_path / "net.json"
    done = browse(tmp_path, page, f"--log-net-log={log}", "--dump-dom")
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line or "Refused" in line] == []
    assert "What was measured" in done.stdout
    assert asked(log) == []
    bad = tmp_path / "bad.html"
    bad.write_text(
        '<!doctype html><script>console.error("seen")</script><img src="http://127.0.0.1:9/x.png" alt="none">'
    )
    done = browse(tmp_path, bad, f"--log-net-log={log}", "--dump-dom")
    assert ("CONSOLE" in done.stderr, asked(log)[:1]) == (True, ["http://127.0.0.1:9/x.png"]), (
        "what a bad page does is seen"
    )


@pytest.mark.parametrize(
    ("width", "scheme", "ground"),
    [(390, 0, "rgb(17, 21, 26)"), (1400, 1, "rgb(255, 255, 255)")],
    ids=["phone, dark", "desktop, light"],
)
def test_it_fits_the_window_folded_and_unfolded(
    page: Path, tmp_path: Path, width: int, scheme: int, ground: str
) -> None:
    """In a frame, since browsers open no window as narrow as a phone; by a script, which the page itself forbids."""
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text(encoding="utf-8"))
    (tmp_path / "probe.html").write_text(text.replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    frame = tmp_path / "frame.html"
    frame.write_text(FRAME.format(width=width), encoding="utf-8")
    look = ("--window-size=1500,1000", "--hide-scrollbars", f"--blink-settings=preferredColorScheme={scheme}")
    title = re.search(r"<title>(.*?)</title>", browse(tmp_path, frame, *look, "--dump-dom").stdout)
    assert title is not None
    seen: dict[str, Any] = json.loads(title[1])
    assert seen["ground"] == ground
    for state in ("before", "after"):
        assert (seen[state]["wide"], seen[state]["scroll"]) == ([], width)
    assert (seen["folded"] > 10, seen["shut"]) == (True, 0)
    assert seen["after"]["high"] > seen["before"]["high"]
    assert seen["scrolls"] == seen["clipped"] > 0, "wide tables scroll in their own box"
