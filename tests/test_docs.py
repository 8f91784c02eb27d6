"""The documents as a site, as MkDocs builds it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.closure import ROOT


def built(folder: Path, to: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(to)]
    return subprocess.run(command, cwd=folder, text=True, capture_output=True, check=False)


@pytest.mark.slow
def test_the_site_has_every_document_and_no_dead_link(tmp_path: Path) -> None:
    done = built(ROOT, tmp_path)
    assert done.returncode == 0, done.stderr
    pages = {page.parent.name for page in tmp_path.rglob("index.html")}
    assert pages >= {*(file.stem for file in (ROOT / "docs").glob("*.md")), "changelog"}
    assert 'href="use/"' in (tmp_path / "index.html").read_text(), "of the README"
    assert 'href="../reports' not in (tmp_path / "data" / "index.html").read_text()
    assert 'id="pipeline.use.model.Octopi.ask"' in (tmp_path / "api" / "index.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("link", ["../reports/none/README.md", "use.md#no-such-part"])
def test_a_dead_link_fails(link: str, tmp_path: Path) -> None:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, text=True, capture_output=True, check=True).stdout
    for name in tracked.splitlines():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    with (tmp_path / "docs" / "robot.md").open("a") as file:
        file.write(f"\n[here]({link})\n")
    done = built(tmp_path, tmp_path / "site")
    assert done.returncode
    assert link.partition("#")[0] in done.stderr + done.stdout
