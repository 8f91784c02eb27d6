"""`octopi repro`: says how many stages will run, lets DVC run them, and says where the results are."""

from __future__ import annotations

import csv
import logging
import os
import signal
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from graphlib import TopologicalSorter
from multiprocessing import get_context
from pathlib import Path
from shutil import which
from subprocess import run
from typing import TYPE_CHECKING

from pipeline.config.params import CHAIN, load_params
from pipeline.core.io import runs
from pipeline.core.runtime import cores
from pipeline.evaluation.records import ADAPTED
from pipeline.running.errors import UserError
from pipeline.running.parallel import end_with_parent
from pipeline.scales.cost import HOURS
from pipeline.tasks import TASKS
from pipeline.weights import is_random

if TYPE_CHECKING:
    from dvc.repo import Repo

INTERRUPTED = ("exited with 130", "exited with -2")
"""How DVC's error ends for a stage that Ctrl-C ended, the second where it had hardly begun or was at its end."""


SHOWN = ("accuracy", "low", "high", "chance")
"""Shares in scores.csv, of which some are empty where there are too few questions."""


def outdated(root: Path) -> tuple[dict[str, list[str]], int, bool]:
    """The stages that will run at the most, each with those it waits for; how many stages there are; if outputs are.

    A stage runs where its inputs changed, and every stage after it unless its own inputs come out the same.

    Raises:
        UserError: where DVC cannot read its own files: one that is killed while it writes a file leaves half of it.
    """
    import networkx as nx
    from dvc.exceptions import DvcException
    from dvc.repo import Repo
    from dvc.scm import SCMError

    try:
        with Repo(str(root)) as repo:
            _unlock(repo)
            changed, graph = repo.status(targets=[str(CHAIN)]), repo.index.graph
    except SCMError:
        raise UserError(f"{root.resolve()}: no Git repository, which DVC needs; clone it, or `git init`") from None
    except DvcException as error:
        told = " ".join(str(error).split())
        mends = {"RWLock": "delete it", "dvc.lock": "`git checkout dvc.lock` brings back Git's; without one, delete it"}
        raise UserError(f"{told}; {next((mends[name] for name in mends if name in told), 'mend it')}") from None
    started = [stage for stage in graph if stage.addressing in changed]
    waiting = set(started).union(*(nx.ancestors(graph, stage) for stage in started))
    waits = {
        stage.addressing: [before.addressing for before in graph.successors(stage) if before in waiting]
        for stage in nx.dfs_postorder_nodes(graph)
        if stage in waiting
    }
    whole = all(Path(out.fs_path).exists() for stage in graph for out in stage.outs)
    return waits, sum(stage.path_in_repo == str(CHAIN) for stage in graph), whole


def _unlock(repo: Repo) -> None:
    """Remove locks of processes that have ended. To DVC one that nobody has reaped is alive, so it would refuse.

    A killed `octopi repro` leaves its processes of DVC to the first process of a container, and not every one reaps.
    """
    from dvc.fs import localfs
    from dvc.rwlock import _edit_rwlock

    with _edit_rwlock(repo.tmp_dir, localfs, repo.config["core"].get("hardlink_lock", False)) as locks:
        written, read = locks["write"], locks["read"]
        locks["write"] = {path: by for path, by in written.items() if runs(by["pid"])}
        locks["read"] = {path: left for path, by in read.items() if (left := [one for one in by if runs(one["pid"])])}


def side_by_side(waits: Mapping[str, list[str]], at_once: int) -> int:
    """Run stages, each behind those it waits for, by several processes of DVC, as one runs one stage at a time.

    Returns:
        0, or the exit status of a stage that failed, of which it said a line; the others that ran have ended.

    Raises:
        UserError: where a process of DVC's dies.
    """
    order = TopologicalSorter(waits)
    order.prepare()
    pool = ProcessPoolExecutor(at_once, get_context("spawn"), _begin, (os.getpid(),))
    running: dict[Future[int], str] = {}
    try:
        while order.is_active():
            running |= {pool.submit(_reproduce_one, name): name for name in order.get_ready()}
            for ended in wait(running, return_when=FIRST_COMPLETED).done:
                if status := ended.result():
                    return status
                order.done(running.pop(ended))
    except KeyboardInterrupt:
        pool.shutdown(cancel_futures=True)
        if any(not job.cancelled() and job.result() for job in running):
            return 130  # The stage that was stopped has said so.
        raise
    except BrokenProcessPool:
        # The system ends a process where memory is short.
        raise UserError("a process of DVC's was killed; finished stages stay, call `octopi repro` again") from None
    finally:
        pool.shutdown(cancel_futures=True)
    return 0


def _begin(parent: int) -> None:
    end_with_parent(parent)
    # Ctrl-C is for the stage, which gets it too; to ignore it here would have the stage ignore it.
    signal.signal(signal.SIGINT, lambda *_: None)


def _reproduce_one(name: str) -> int:
    """Quiet, as the stage itself says what it does and what goes wrong."""
    from dvc.cli import main as dvc

    return int(dvc(["--wait-for-lock", "repro", "--quiet", "--single-item", name]))


def right_answers(file: Path, at_random: bool) -> Iterator[str]:
    """Lines of scores.csv: what trained models that were asked got right and, unless it is random, the full system."""
    with file.open(newline="", encoding="utf-8") as stream:
        rows = [r for r in csv.DictReader(stream) if r["seed"] == "all" and r["measure"] in ("choice", "combined")]
    asked = dict.fromkeys(r["encoder"] for r in rows if r["touch"] == "touch" and ADAPTED not in r["encoder"])
    whose = {name: (name, "", "all", "touch") for name in asked}
    if not at_random:
        whose["The full system"] = ("finetuned", "with", "all", "real")
    for title, chosen in whose.items():
        found = {r["task"]: r for r in rows if (r["encoder"], r["lora"], r["opd"], r["touch"]) == chosen}
        if found:
            yield f"{title}, with 95 % intervals:"
        for name in (task for task in TASKS if task in found):
            row = {key: f"{100 * float(cell):.0f}" if cell else "" for key, cell in found[name].items() if key in SHOWN}
            interval = f" [{row['low']}, {row['high']}]" if row["low"] else ""
            chance = f", guessing {row['chance']}" if row["chance"] else ""
            yield f"  {TASKS[name].title}: {row['accuracy']} % right{interval} of {found[name]['n']}{chance}"


def reproduce(root: Path, arguments: list[str]) -> int:
    """Run `dvc repro` with these arguments where anything changed; return its exit status."""
    from dvc.cli import main as dvc

    from pipeline.tracking.publish import publish
    from pipeline.tracking.store import MLRUNS, attempt

    stopped: list[BaseException] = []

    def shown(record: logging.LogRecord) -> bool:
        """Whether DVC's words are shown: a stage that Ctrl-C ended has said so itself."""
        error = record.exc_info[1] if record.exc_info else None
        if error and (isinstance(error, KeyboardInterrupt) or str(error.__cause__).endswith(INTERRUPTED)):
            stopped.append(error)
        return not stopped

    params = load_params(root / "params.yaml")
    name, (waits, total, whole) = params.report_name, outdated(root)
    if waits:
        hours = f" (hours of a whole run: {HOURS[params.scale]})" if params.scale in HOURS else ""
        print(f"{name}: up to {len(waits)} of {total} stages will run{hours}", flush=True)
    if not whole and arguments == ["--dry"]:
        # DVC's own ends where a stage that is not run now has left nothing for the next one.
        print("\n".join(waits))
        return 0
    if waits or arguments:
        for handler in logging.getLogger("dvc").handlers:
            handler.addFilter(shown)
        # Not on a GPU, nor where torch chooses how many threads a stage takes.
        runtime, ended = params.runtime, 0
        places = cores() // runtime.threads if runtime.threads and runtime.device == "cpu" and not arguments else 1
        together = min(places, len(waits)) > 1
        if together:
            ended = side_by_side(waits, places)
        quiet = ["--quiet"] * together  # All has run: a line a stage would say so.
        ended = ended or int(dvc(["repro", *quiet, *arguments]))
        if stopped and isinstance(stopped[0], KeyboardInterrupt):
            raise KeyboardInterrupt
        if ended:
            return 130 if stopped else ended
    else:
        print(f"{name}: all {total} stages are up to date")
    if not (arguments or params.tracking.uri or (MLRUNS / "mlflow.db").is_file()):
        # A clone has the lock of a chain that ran elsewhere, so that DVC does not publish it; MLflow has nothing yet.
        attempt(params.tracking, publish, params)
    if (scores := root / "reports" / name / "scores.csv").is_file():
        for line in right_answers(scores, any(map(is_random, (params.encoder.weights, params.language.weights)))):
            print(line)
    print(f"Report: reports/{name}/README.md; all reports on one page: reports/index.html")
    print("Dashboard: make dashboard, then open the link to all variants that it prints after ten seconds")
    print('Ask the shipped model: octopi ask "Which is softer?" examples/soft.mp4 examples/hard.mp4')
    made = ["dvc.lock", "params.yaml", "reports"]
    status = ["git", "status", "--porcelain", *made]
    # A run that gave what is committed leaves nothing to keep; nor is there anything to say without Git.
    if which("git") and run(status, cwd=root, capture_output=True, check=False).stdout:
        kept = f"git add {' '.join(made)} && git commit -m '{name}'"
        print(f"Keep this run, which Git does not know yet: {kept} (docs/dashboard.md: how to go back)")
    return 0
