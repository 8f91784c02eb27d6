"""Kills of the reduced chain at chosen moments and at random, for tests/chain/test_chain.py.

After each kill the chain is run again, and dvc.lock, which has the hash of all that it made, is compared with that of
an uninterrupted run. Nothing may outlive what started it by five seconds, and nothing but Ctrl-C has a traceback.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import yaml

from tests.project import Project

HOOK = """
import json, os, re, signal, sys
if strike := json.loads(os.environ.get("DRILL_STRIKE", "null")):
    event, pattern = strike
    def hook(name, arguments, busy=[]):
        if name == event and not busy and re.search(pattern, " ".join(map(str, arguments))):
            busy.append(True)
            try:
                os.close(os.open("struck", os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return
            os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
"""
"""What every Python of the copy reads at its start: a hook that kills once, at a chosen moment."""
MOMENTS = (
    ("between write and rename", "os.rename", r"\.part (?!.*runs/)", ""),
    ("between checkpoint and removal", "shutil.rmtree", "checkpoints/", "finetune_encoder|align|lora|extract"),
    ("during the adapter's save", "open", r"adapter_config\.json w", "lora"),
    ("while DVC keeps what was made", "os.rename", r"\.dvc/cache", ""),
    ("while a checkpoint is removed", "os.remove", "trainer_state|scheduler", "finetune_encoder|align|lora"),
)
"""When, as an audit event and what its arguments match, and the stages in which it comes."""
GRACE, LONGEST = 5.0, 600.0
"""Seconds after which nothing may be left of what was killed, and in which every command is through."""


def wait_until(true: Callable[[], object], seconds: float = LONGEST) -> bool:
    """Whether it became true in time."""
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.1)
    return True


def alive(session: int, script: str = "") -> list[psutil.Process]:
    """Processes of a session that have not ended, the oldest first; those that run `script`."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            # A zombie has ended, whoever has to take note of that.
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found += [process] if not script or script in process.cmdline() else []
    return sorted(found, key=lambda process: process.pid)


class Drill:
    """Kills in a project whose chain has run once without interruption."""

    def __init__(self, project: Project) -> None:
        self.project, self.folder = project, project.folder
        (self.folder / "sitecustomize.py").write_text(HOOK)
        self.expected = yaml.safe_load((self.folder / "dvc.lock").read_text())["stages"]
        runs = {file.stem: json.loads(file.read_text()) for file in (self.folder / "runs").glob("*.json")}
        self.seconds = {stage: run["startup_seconds"] + run["seconds"] for stage, run in runs.items()}

    def start(self, log: Path, **environment: str) -> subprocess.Popen[str]:
        """Start the chain in a session of its own, with its output in a file."""
        own = {**self.project.environment, **environment}
        with log.open("w") as out:
            return subprocess.Popen(
                ("dvc", "repro"), cwd=self.folder, env=own, stdout=out, stderr=out, start_new_session=True
            )

    def run(self) -> tuple[int, str]:
        log = self.folder.with_name("run.txt")
        return self.start(log).wait(LONGEST), log.read_text()

    def kill(self, seed: str) -> bool:
        """Let a stage run again, kill something on the way, and look; False where it was through before.

        Every second seed is of a chosen moment.
        """
        rng, number = random.Random(seed), int(seed.rpartition("/")[2])
        name, event, pattern, where = MOMENTS[number // 2 % len(MOMENTS)] if number % 2 else ("at random", "", "", "")
        stage = rng.choice([title for title in self.expected if title != "publish" and re.match(where, title)])
        (struck := self.folder / "struck").unlink(missing_ok=True)
        # Without what it made, here and in DVC's cache, this stage alone has to run again.
        for entry in self.expected[stage]["outs"]:
            (self.folder / ".dvc/cache/files/md5" / entry["md5"][:2] / entry["md5"][2:]).unlink(missing_ok=True)
            out = self.folder / entry["path"]
            shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)
        log = self.folder.with_name("killed.txt")
        leader = self.start(log, DRILL_STRIKE=json.dumps([event, pattern] if event else None))

        def running() -> list[psutil.Process]:
            return alive(leader.pid, f"stages/{stage.partition('@')[0]}.py")[:1]

        output, whom = "", rng.choice(("stage", "stage", "dvc", "group"))
        # DVC does not hear Ctrl-C while a stage runs.
        how = rng.choice((signal.SIGKILL, signal.SIGTERM, *([signal.SIGINT] if whom != "dvc" else [])))
        wait_until(lambda: (struck.exists() if event else running()) or leader.poll() is not None)
        victims = running()
        if event:
            hit = struck.exists()
        else:
            name = f"{how.name} to {whom}"
            delay = rng.uniform(0, self.seconds[stage])
            hit = bool(victims) and not wait_until(lambda: running() != victims, delay)
            if hit and whom == "group":
                os.killpg(leader.pid, how)
            elif hit:
                os.kill(leader.pid if whom == "dvc" else victims[0].pid, how)
            if hit and whom == "dvc":
                # A stage whose DVC was killed runs on, and the next `dvc repro` meets it.
                output = self.run()[1]
        if hit:
            wait_until(lambda: not victims or running() != victims)
            wait_until(lambda: all(process.pid == leader.pid for process in alive(leader.pid)), GRACE)
        orphans = [process for process in alive(leader.pid) if hit and process.pid != leader.pid]
        for process in orphans:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        leader.wait(LONGEST)
        if not hit:
            return False
        output, case, (status, again) = output + log.read_text(), f"seed {seed}: {name}, {stage}", self.run()
        assert status == 0, f"{case}: lost: {again[-3000:]}"
        made = yaml.safe_load((self.folder / "dvc.lock").read_text())["stages"]
        assert made == self.expected, f"{case}: other bytes"
        assert not orphans, f"{case}: {len(orphans)} processes outlived it"
        # Ctrl-C says where it interrupted.
        traced = "Traceback" in again or ("Traceback" in output and "KeyboardInterrupt" not in output)
        assert not traced, f"{case}: {(output + again)[-3000:]}"
        return True
