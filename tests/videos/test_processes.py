"""What forked processes must do: decode after their parent has, and end with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.closure import ROOT
from tests.conftest import HUNG, encode, moving_square, wait_until_ended
from tests.frame_rules import frames_of


def test_a_fork_decodes_after_its_parent_has(tmp_path: Path) -> None:
    """What converts pixels is kept from frame to frame: a fork would wait for ever for threads that it kept."""
    for name, side in (("parent", 512), ("child", 64)):
        encode(tmp_path / f"{name}.mkv", moving_square(2, 0, side, side), "ffv1", "bgr0")
    assert len(frames_of(tmp_path / "parent.mkv")) == 2
    child = multiprocessing.get_context("fork").Process(target=frames_of, args=(tmp_path / "child.mkv",))
    child.start()
    child.join(HUNG)
    child.kill()
    child.join()
    assert child.exitcode == 0


@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_worker_outlives_its_parent(tmp_path: Path, signal_number: int) -> None:
    (tmp_path / "work.py").write_text(
        "import os, time\nfrom pathlib import Path\nfrom pipeline.running.parallel import run_parallel\n"
        "def work(i):\n    Path(f'{os.getpid()}.pid').touch()\n    time.sleep(10**6)\n"
        "if __name__ == '__main__':\n    list(run_parallel(work, range(4), 'x', 'y'))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "work.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.DEVNULL,
        # What a shell starts in the background ignores it, and so would what is started here.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while not (pids := [int(p.stem) for p in tmp_path.glob("*.pid")]):
        assert process.poll() is None
        time.sleep(0.05)
    workers = [psutil.Process(pid) for pid in pids]
    process.send_signal(signal_number)
    wait_until_ended(workers)
    process.kill()
    process.wait()
