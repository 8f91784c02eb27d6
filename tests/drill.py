"""`make drill`: bad inputs, and kills of the reduced chain at chosen moments and at random.

After each kill the chain is run again, and what it made is compared byte for byte with an uninterrupted run.
reports/drill.csv counts, a case a row: tries; what running again could not complete (lost); other bytes (different);
processes that outlived what started them by five seconds (orphaned); tracebacks, and lines that do not say what is
wrong (wrong line). For a bad input `lost` is a wrong exit status, and `different` a file that was touched.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import chdir, suppress
from pathlib import Path
from typing import Any

import psutil
import yaml

from tests.bad_inputs import bad_inputs, contents, prepare_folder, refuse
from tests.closure import ROOT
from tests.project import REDUCED, Project, copy_project

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
REPRO = ("dvc", "repro")
COLUMNS = ("tries", "lost", "different", "orphaned", "wrong line")
GRACE, LONGEST = 5.0, 600.0
"""Seconds after which nothing may be left of what was killed, and in which every command is through."""


class Ledger(dict[str, Counter[str]]):
    """What was wrong, by case; it is also said at once."""

    def add(self, case: str, **wrong: str) -> None:
        """One more try, with a word on each thing that was wrong."""
        found = {column.replace("_", " "): text for column, text in wrong.items() if text}
        self.setdefault(case, Counter()).update(["tries", *found])
        for column, text in found.items():
            print(f"  {case}: {column}: {text}", flush=True)

    def faults(self) -> int:
        return sum(count.total() - count["tries"] for count in self.values())

    def write(self, path: Path) -> None:
        with path.open("w", encoding="utf-8", newline="") as stream:
            rows = [[case, *(count[column] for column in COLUMNS)] for case, count in self.items()]
            csv.writer(stream, lineterminator="\n").writerows([["case", *COLUMNS], *rows])


def drill_bad_inputs(ledger: Ledger, folder: Path) -> None:
    """Each row of the table, in a folder of its own."""
    for row in bad_inputs():
        prepare_folder(folder)
        with chdir(folder):
            wrong = refuse(row)
        name = row.command.split()[0]
        said = f"{row.command} {' '.join(row.arguments)}: "
        wrong = {column: said + text for column, text in wrong.items() if text}
        ledger.add(f"bad input: {name if name.endswith('.py') else f'octopi {name}'}", **wrong)
        shutil.rmtree(folder)


class Chain:
    """A project whose chain has run once without interruption."""

    def __init__(self, project: Project) -> None:
        self.project, self.folder = project, project.folder
        (self.folder / "sitecustomize.py").write_text(HOOK)
        self.expected = self.made()
        self.stages: dict[str, dict[str, Any]] = yaml.safe_load((self.folder / "dvc.lock").read_text())["stages"]
        self.stages.pop("publish", None)  # It makes nothing.
        costs = {name: json.loads((self.folder / "runs" / f"{name}.json").read_text()) for name in self.stages}
        self.seconds = {name: cost["startup_seconds"] + cost["seconds"] for name, cost in costs.items()}
        shutil.copytree(self.folder, self.folder.with_name("pristine"), symlinks=True)

    def made(self) -> dict[str, str]:
        """Hash of everything that the chain makes, dvc.lock included, and of what else lies there."""
        return contents(self.folder, "dvc.lock", "data", "models", "reports")

    def forget(self, stage: str) -> None:
        """Take away what a stage made, here and from DVC's cache: it alone has to run again."""
        (self.folder / "struck").unlink(missing_ok=True)
        for entry in self.stages[stage]["outs"]:
            copy = self.folder / ".dvc/cache/files/md5" / entry["md5"][:2] / entry["md5"][2:]
            copy.unlink(missing_ok=True)
            out = self.folder / entry["path"]
            shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)

    def start(self, log: Path, **environment: str) -> subprocess.Popen[str]:
        """Start the chain in a session of its own, with its output in a file."""
        with log.open("w") as stream:
            environment = {**self.project.environment, **environment}
            return subprocess.Popen(
                REPRO, cwd=self.folder, env=environment, stdout=stream, stderr=stream, start_new_session=True
            )

    def run(self) -> tuple[int, str]:
        """Run the chain as a person does; return status and output."""
        log = self.folder.with_name("run.txt")
        return ended(self.start(log)), log.read_text()


def ended(process: subprocess.Popen[str]) -> int:
    """The status of a process and, where it takes too long, the end of its session."""
    if not wait_until(lambda: process.poll() is not None):
        os.killpg(process.pid, signal.SIGKILL)
    return process.wait()


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


def kill(chain: Chain, ledger: Ledger, stage: str, rng: random.Random, moment: Sequence[str] | None) -> bool:
    """Let a stage run again, end it on the way, and look; False where it was through before."""
    chain.forget(stage)
    log = chain.folder.with_name("killed.txt")
    leader = chain.start(log, **({"DRILL_STRIKE": json.dumps(moment[1:3])} if moment else {}))

    def running() -> list[psutil.Process]:
        """The stage's process, once there is one."""
        return alive(leader.pid, f"stages/{stage.partition('@')[0]}.py")[:1]

    met = ""
    if moment:
        case, said = f"kill {moment[0]}", f"{stage} at {moment[1]} {moment[2]}"
        struck = chain.folder / "struck"
        wait_until(lambda: struck.exists() or leader.poll() is not None)
        hit, victims = struck.exists(), running()
    else:
        whom = rng.choice(("stage", "stage", "dvc", "group"))
        # DVC does not hear Ctrl-C while a stage runs.
        number = rng.choice((signal.SIGKILL, signal.SIGTERM, *([signal.SIGINT] if whom != "dvc" else [])))
        delay = rng.uniform(0, chain.seconds[stage])
        case, said = f"kill {whom}", f"{stage}, {number.name} to {whom} after {delay:.2f} s"
        wait_until(lambda: running() or leader.poll() is not None)
        victims = running()
        hit = bool(victims) and not wait_until(lambda: running() != victims, delay)
        if hit and whom == "group":
            os.killpg(leader.pid, number)
        elif hit:
            os.kill(leader.pid if whom == "dvc" else victims[0].pid, number)
        if hit and whom == "dvc":
            # A stage whose DVC was killed runs on, and the next `dvc repro` meets it.
            met = chain.run()[1]
    if not hit:
        ended(leader)
        return False
    wait_until(lambda: not victims or running() != victims)
    wait_until(lambda: all(process.pid == leader.pid for process in alive(leader.pid)), GRACE)
    orphans = [process for process in alive(leader.pid) if process.pid != leader.pid]
    for process in orphans:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    ended(leader)
    output = log.read_text() + met

    # Run the chain again, as a person does, and compare.
    status, again = chain.run()
    made = chain.made()
    other = [path for path in sorted({*made, *chain.expected}) if made.get(path) != chain.expected.get(path)]
    # Ctrl-C says where it interrupted.
    traced = "Traceback" in again or ("Traceback" in output and "KeyboardInterrupt" not in output)
    wrong = {
        "lost": again[-600:] if status else "",
        "different": ", ".join(other),
        "orphaned": f"{len(orphans)} processes" if orphans else "",
        "wrong_line": (output + again)[-600:] if traced else "",
    }
    ledger.add(case, **{column: text and f"{said}: {text}" for column, text in wrong.items()})
    if status or other:
        shutil.rmtree(chain.folder)
        shutil.copytree(chain.folder.with_name("pristine"), chain.folder, symlinks=True)
    return True


def drill_kills(chain: Chain, ledger: Ledger, kills: int, minutes: float, seed: int) -> None:
    """Every second kill at a chosen moment, the others at random, until there are enough or time is over."""
    until, done = time.monotonic() + 60 * minutes, 0
    for number in itertools.count():
        if done >= kills or time.monotonic() > until:
            return
        rng, moment = random.Random(f"{seed}/{number}"), MOMENTS[number // 2 % len(MOMENTS)] if number % 2 else None
        stage = rng.choice([name for name in chain.stages if not moment or re.match(moment[3], name)])
        print(f"kill {done + 1} of {kills} (seed {seed}/{number}): {stage}, {moment or 'at random'}", flush=True)
        done += kill(chain, ledger, stage, rng, moment)


def drill(kills: int, minutes: float, seed: int) -> int:
    """The whole drill; return how much was wrong."""
    ledger = Ledger()
    with tempfile.TemporaryDirectory() as name:
        try:
            drill_bad_inputs(ledger, Path(name) / "inputs")
            project = copy_project(Path(name) / "a project")
            project.run("octopi", "scale", *REDUCED, "runtime.save_steps=2")
            project.run(*REPRO)
            drill_kills(Chain(project), ledger, kills, minutes, seed)
        finally:
            ledger.write(ROOT / "reports" / "drill.csv")
    return ledger.faults()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=20, help="of killing, after which no kill is begun")
    parser.add_argument("--seed", type=int, default=0)
    sys.exit(min(1, drill(**vars(parser.parse_args()))))
