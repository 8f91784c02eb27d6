"""`make drill`: bad inputs, kills, full and read-only disks, a clock that jumps back, two chains at once, bad servers.

After each the chain is run again, and what it made is compared byte for byte with an uninterrupted run.
reports/drill.csv counts, a case a row: tries; what running again could not complete (lost); other bytes (different);
processes that outlived what started them by five seconds (orphaned); tracebacks, and lines that do not say what is
wrong (wrong line). For a bad input `lost` is a wrong exit status, and `different` a file that was touched.
"""

from __future__ import annotations

import argparse
import csv
import http.server
import itertools
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import chdir, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import yaml

from tests.bad_inputs import bad_inputs, contents, prepare_folder, refuse, with_params
from tests.closure import ROOT
from tests.project import REDUCED, copy_project

HOOK = """
import json, os, re, signal, sys, time
if strike := json.loads(os.environ.get("DRILL_STRIKE", "null")):
    event, pattern, command = strike
    def hook(name, arguments, busy=[]):
        if name == event and not busy and re.search(pattern, " ".join(map(str, arguments))):
            busy.append(True)
            try:
                os.close(os.open("struck", os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return
            os.system(command) if command else os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
if late := os.environ.get("DRILL_CLOCK"):
    right, start = time.time, time.time()
    time.time = lambda: right() - 86400 * (right() - start > float(late))
"""
"""What every Python of the copy reads at its start: a hook that strikes once at a chosen moment, and the clock."""
MOMENTS = (
    ("between write and rename", "os.rename", r"\.part (?!.*runs/)", ""),
    ("between checkpoint and removal", "shutil.rmtree", "checkpoints/", "finetune_encoder|align|lora|extract"),
    ("during the adapter's save", "open", r"adapter_config\.json w", "lora"),
    ("while DVC keeps what was made", "os.rename", r"\.dvc/cache", ""),
    ("while a checkpoint is removed", "os.remove", "trainer_state|scheduler", "finetune_encoder|align|lora"),
    ("during the adapter's save", "os.rename", r"adapter_config\.json\.", "lora"),
)
"""When, as an audit event and what its arguments match, and the stages in which it comes."""
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
    """The reduced chain, or its stages up to `goals`, in a copy of the project: run once without interruption."""

    def __init__(self, folder: Path, goals: Sequence[str] = (), overrides: Sequence[str] = ()) -> None:
        self.project, self.folder, self.command = copy_project(folder), folder, ["dvc", "repro", *goals]
        (folder / "sitecustomize.py").write_text(HOOK)
        self.project.run("octopi", "scale", *REDUCED, "runtime.save_steps=2", *overrides)
        status, output = self.run(self.command)
        assert status == 0, output
        self.expected = self.made()
        self.stages: dict[str, dict[str, Any]] = yaml.safe_load((folder / "dvc.lock").read_text())["stages"]
        self.stages.pop("publish", None)  # It makes nothing.
        costs = {name: json.loads((folder / "runs" / f"{name}.json").read_text()) for name in self.stages}
        self.seconds = {name: cost["startup_seconds"] + cost["seconds"] for name, cost in costs.items()}
        shutil.copytree(folder, folder.with_name("pristine"), symlinks=True)

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

    def start(self, command: Sequence[str], log: str, env: Any = (), limit: int = 0) -> subprocess.Popen[str]:
        """Start a command that leads a session of its own; `limit` is the most bytes of a file."""
        limited = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit, limit)) if limit else None
        with self.folder.with_name(log).open("w") as stream:
            return subprocess.Popen(
                [*command],
                cwd=self.folder,
                env={**self.project.environment, **dict(env)},
                stdout=stream,
                stderr=stream,
                start_new_session=True,
                preexec_fn=limited,
            )

    def end(self, process: subprocess.Popen[str], log: str) -> tuple[int, str]:
        """Wait for a command; return status and output."""
        try:
            process.wait(LONGEST)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
        return process.wait(), self.folder.with_name(log).read_text()

    def run(self, command: Sequence[str], **more: Any) -> tuple[int, str]:
        """Run a command to its end; return status and output."""
        return self.end(self.start(command, "run.txt", **more), "run.txt")

    def settle(self, ledger: Ledger, case: str, said: str, **wrong: str) -> None:
        """Run the chain again, as a person does; compare, and count what was wrong."""
        status, output = self.run(self.command)
        made = self.made()
        other = [path for path in sorted({*made, *self.expected}) if made.get(path) != self.expected.get(path)]
        wrong["lost"] = output[-600:] if status else ""
        wrong["wrong_line"] = wrong.get("wrong_line") or (output[-600:] if "Traceback" in output else "")
        wrong["different"] = wrong.get("different") or ", ".join(other)
        ledger.add(case, **{column: text and f"{said}: {text}" for column, text in wrong.items()})
        if status or other:
            shutil.rmtree(self.folder)
            shutil.copytree(self.folder.with_name("pristine"), self.folder, symlinks=True)


def alive(session: int, script: str = "") -> list[psutil.Process]:
    """Processes of a session that are not dead, the oldest first; those that run `script`."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == session and not dead(process):
                found += [process] if not script or script in process.cmdline() else []
        except (psutil.Error, OSError):
            continue
    return sorted(found, key=lambda process: process.pid)


def dead(process: psutil.Process) -> bool:
    """Whether a process has ended, whoever has to take note of that."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def wait_until(true: Callable[[], object], seconds: float = LONGEST) -> bool:
    """Whether it became true in time."""
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.1)
    return True


def left_behind(session: int, but: int) -> str:
    """What is still there of a session after the time that it has, but for one process; it is ended."""
    if wait_until(lambda: all(process.pid == but for process in alive(session)), GRACE):
        return ""
    rest = [process for process in alive(session) if process.pid != but]
    for process in rest:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    return f"{len(rest)} processes"


def kill(chain: Chain, ledger: Ledger, stage: str, rng: random.Random, moment: Sequence[str] | None) -> bool:
    """Let a stage run again, end it on the way, and look; False where it was through before."""
    chain.forget(stage)
    script, struck = f"stages/{stage.partition('@')[0]}.py", chain.folder / "struck"
    strike = {"DRILL_STRIKE": json.dumps([moment[1], moment[2], ""])} if moment else {}
    leader = chain.start(chain.command, "killed.txt", env=strike)
    if moment:
        case, whom = f"kill {moment[0]}", "stage"
        wait_until(lambda: struck.exists() or leader.poll() is not None)
        hit, said = struck.exists(), f"{stage} at {moment[1]} {moment[2]}"
        # It may have been a worker's turn.
        victims = alive(leader.pid, script)[:1]
    else:
        whom = rng.choice(("stage", "stage", "dvc", "group"))
        # DVC does not hear Ctrl-C while a stage runs.
        number = rng.choice((signal.SIGKILL, signal.SIGTERM, *([signal.SIGINT] if whom != "dvc" else [])))
        delay = rng.uniform(0, chain.seconds[stage])
        case, said = f"kill {whom}", f"{stage}, {number.name} to {whom} after {delay:.2f} s"
        wait_until(lambda: alive(leader.pid, script) or leader.poll() is not None)
        victims = alive(leader.pid, script)[:1]
        hit = bool(victims) and not wait_until(lambda: dead(victims[0]), delay)
        if hit and whom == "group":
            os.killpg(leader.pid, number)
        elif hit:
            os.kill(leader.pid if whom == "dvc" else victims[0].pid, number)
    if not hit:
        leader.wait()
        return False
    # A stage whose DVC was killed runs on, and the next `dvc repro` meets it.
    met = chain.run(chain.command)[1] if whom == "dvc" else ""
    wait_until(lambda: all(map(dead, victims)))
    orphaned = left_behind(leader.pid, but=leader.pid)
    output = chain.end(leader, "killed.txt")[1] + met
    # Ctrl-C says where it interrupted.
    wrong = output[-600:] if "Traceback" in output and "KeyboardInterrupt" not in output else ""
    chain.settle(ledger, case, said, orphaned=orphaned, wrong_line=wrong)
    return True


def drill_kills(chains: Sequence[Chain], ledger: Ledger, kills: int, minutes: float, seed: int) -> None:
    """Every second kill at a chosen moment, the others at random, until there are enough or time is over.

    Each chain has a thread of its own: most of a kill is one process that starts.
    """
    numbers, until, lock, done = itertools.count(), time.monotonic() + 60 * minutes, threading.Lock(), 0

    def go(chain: Chain) -> None:
        nonlocal done
        while time.monotonic() < until:
            with lock:
                if done >= kills:
                    return
                number = next(numbers)
                rng, moment = random.Random(f"{seed}/{number}"), MOMENTS[number // 2 % len(MOMENTS)]
                moment = moment if number % 2 else None
                fitting = [name for name in chain.stages if not moment or re.match(moment[3], name)]
                if not fitting:
                    continue
                stage = rng.choice(fitting)
                done += 1
                print(f"kill {done} of {kills} (seed {seed}/{number}): {stage}, {moment or 'at random'}", flush=True)
            hit = kill(chain, ledger, stage, rng, moment)
            with lock:
                done -= not hit

    with ThreadPoolExecutor(len(chains)) as pool:
        list(pool.map(go, chains))


def one_line(status: int, output: str, words: str) -> str:
    """What is wrong with how a command ended; nothing where one line says it."""
    said = [line for line in output.splitlines() if line and not re.match(r"WARNING|\S+: starts|.* s left$", line)]
    return (
        ""
        if status == 1 and len(said) == 1 and re.search(words, said[0], re.IGNORECASE)
        else f"{status}: {output[-600:]}"
    )


def drill_disks(chain: Chain, ledger: Ledger) -> None:
    """A disk with room for half of what a stage makes, a limit on a file's length, a disk that turns read-only."""
    mounts = subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False).returncode == 0
    cases = itertools.cycle(["limit on a file's length", *(["full disk", "read-only disk"] if mounts else [])])
    for stage, entry in chain.stages.items():
        out = chain.folder / entry["outs"][-1]["path"]
        sizes = [file.stat().st_size for file in out.rglob("*") if file.is_file()]
        if sum(sizes) < 2**14:
            continue
        mount = ["unshare", "-rm", "sh", "-c", f"mount -t tmpfs -o size=$0 tmpfs '{out}' && exec {entry['cmd']}"]
        match case := next(cases):
            case "full disk":
                command, words, more = [*mount, f"{sum(sizes) // 2}"], "no space left", {}
            case "read-only disk":
                remount = json.dumps(["os.rename", r"\.part|_config", f"mount -o remount,ro '{out}'"])
                command, words = [*mount, f"{2 * sum(sizes)}"], "Read-only file system"
                more = {"env": {"DRILL_STRIKE": remount}}
            case _:
                # torch does not say what was wrong.
                command, words, more = entry["cmd"].split(), "too large|Input/output", {"limit": max(sizes) // 2}
        chain.forget(stage)
        out.mkdir(parents=True)
        print(f"{case}: {stage}", flush=True)
        ended = chain.run(command, **more)
        left = contents(chain.folder, entry["outs"][-1]["path"])
        half = [path for path, value in left.items() if value != chain.expected.get(path)]
        chain.settle(ledger, case, stage, wrong_line=one_line(*ended, words), different=", ".join(half))


def drill_clock(chain: Chain, ledger: Ledger, stage: str) -> None:
    """The clock goes back by a day while the stage runs, and files lie there that were written tomorrow."""
    chain.forget(stage)
    for file in (chain.folder / "data").rglob("*"):
        os.utime(file, (time.time() + 86400,) * 2)
    status, output = chain.run(chain.command, env={"DRILL_CLOCK": f"{chain.seconds[stage] / 2}"})
    chain.settle(ledger, "clock jumps back", stage, wrong_line=output[-600:] if status else "")


def drill_two(chain: Chain, ledger: Ledger, stage: str) -> None:
    """Two chains at once: one goes on, the other too or it says why not."""
    chain.forget(stage)
    logs, wrong = ("first.txt", "second.txt"), ""
    for process, log in [(chain.start(chain.command, log), log) for log in logs]:
        status, output = chain.end(process, log)
        if "Traceback" in output or output.count("ERROR") != bool(status):
            wrong = output[-600:]
    chain.settle(ledger, "two dvc repro at once", stage, wrong_line=wrong)


@contextmanager
def server(status: int, body: bytes, pause: float) -> Iterator[str]:
    """A tracking server that answers every request so, with a pause before each byte; not at all with status 0."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if status:
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
            for byte in body:
                time.sleep(pause)
                self.wfile.write(bytes([byte]))

        do_POST = do_GET

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listening:
        listening.handle_error = lambda *_: None  # type: ignore[method-assign]
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{listening.server_port}"
        listening.shutdown()


SERVERS = {
    "slowly": (200, b"{}" * 10, 0.5),
    "late": (200, b"{}", 10.0),
    "with an error": (500, b"no", 0.0),
    "with no JSON": (200, b"<html>", 0.0),
    "not at all": (0, b"", 0.0),
}


def drill_servers(chain: Chain, ledger: Ledger, stage: str) -> None:
    """A training that logs to such a server, and publishing to it: one warning each, and the same results."""
    file = chain.folder / "params.yaml"
    before = file.read_bytes()
    for how, answer in SERVERS.items():
        chain.forget(stage)
        print(f"tracking server answers {how}", flush=True)
        wrong = ""
        with server(*answer) as uri:
            with_params(file, tracking__uri=uri, tracking__live=True, tracking__timeout_seconds=3)
            for command in (chain.command, ["python", "stages/publish.py"]):
                status, output = chain.run(command)
                if status or "Traceback" in output or output.count("WARNING") != 1:
                    wrong += f"{command} ended with {status}: {output[-600:]}"
            wrong += one_line(*chain.run(["octopi", "publish"]), "octopi publish` tries again")
        file.write_bytes(before)
        chain.settle(ledger, f"tracking server answers {how}", stage, wrong_line=wrong)


def reduced_kills(folder: Path, kills: int) -> Ledger:
    """A few kills of the chain's first stages."""
    ledger = Ledger()
    chain = Chain(folder, ["extract_frames"], ["scenes.videos_per_object=1"])
    drill_kills([chain], ledger, kills, minutes=10, seed=0)
    return ledger


def drill(kills: int, minutes: float, seed: int) -> int:
    """The whole drill; return how much was wrong."""
    ledger = Ledger()
    with tempfile.TemporaryDirectory() as name:
        try:
            drill_bad_inputs(ledger, Path(name) / "inputs")
            with ThreadPoolExecutor() as pool:
                chains = list(pool.map(Chain, [Path(name) / which / "a project" for which in ("one", "other")]))
            chain = chains[0]
            for stage in [stage for stage in chain.stages if re.match("extract|align|report", stage)]:
                print(f"clock, and two at once: {stage}", flush=True)
                drill_clock(chain, ledger, stage)
                drill_two(chain, ledger, stage)
            drill_servers(chain, ledger, next(stage for stage in chain.stages if stage.startswith("finetune")))
            drill_disks(chain, ledger)
            drill_kills(chains, ledger, kills, minutes, seed)
        finally:
            ledger.write(ROOT / "reports" / "drill.csv")
    return ledger.faults()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=20, help="of killing, after which no kill is begun")
    parser.add_argument("--seed", type=int, default=0)
    sys.exit(min(1, drill(**vars(parser.parse_args()))))
