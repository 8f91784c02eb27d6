"""`octopi repro`: says how many stages will run, lets DVC run them, and says where the results are."""

from __future__ import annotations

import csv
import logging
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.config.params import CHAIN, load_params
from pipeline.core.runtime import cores
from pipeline.running.errors import UserError
from pipeline.tasks import TASKS

INTERRUPTED = ("exited with 130", "exited with -2")
"""How DVC's error ends for a stage that Ctrl-C ended, the second where it had hardly begun or was at its end."""


TAKES = {"smoke": "six minutes on two cores, and 50 MB of disk"}
"""By scale, what a whole run was measured to take."""
TRUNK, APART = ("embed", "questions"), ("align", "lora", "answer", "evaluate")
"""What runs before any stage of which several may run at once, and those."""


def outdated(root: Path) -> tuple[int, int, list[list[str]]]:
    """How many stages will run at the most, how many there are, and branches: none needs a stage of another.

    A stage runs where its inputs changed, and every stage after it unless its own inputs come out the same.

    Raises:
        UserError: where DVC cannot read its own files: one that is killed while it writes dvc.lock leaves half of it.
    """
    import networkx as nx
    from dvc.exceptions import DvcException
    from dvc.repo import Repo
    from dvc.scm import SCMError

    try:
        with Repo(str(root)) as repo:
            changed, graph = repo.status(targets=[str(CHAIN)]), repo.index.graph
    except SCMError:
        raise UserError(f"{root.resolve()}: no Git repository, which DVC needs; clone it, or `git init`") from None
    except DvcException as error:
        back = "`git checkout dvc.lock` brings back the last one of Git; without one, delete it"
        raise UserError(f"{' '.join(str(error).split())}; {back if 'dvc.lock' in str(error) else 'mend it'}") from None
    started = [stage for stage in graph if stage.addressing in changed]
    waiting = set(started).union(*(nx.ancestors(graph, stage) for stage in started))
    own = [s for s in nx.dfs_postorder_nodes(graph) if s in waiting and s.name.partition("@")[0] in APART]
    parts = nx.weakly_connected_components(graph.subgraph(own))
    branches = sorted(([s.addressing for s in own if s in part] for part in parts), key=len, reverse=True)
    return len(waiting), sum(stage.path_in_repo == str(CHAIN) for stage in graph), branches


def run_branches(branches: Sequence[Sequence[str]], at_once: int) -> None:
    """Run each branch by a `dvc` of its own, as DVC runs one stage at a time; what fails is left to who comes next."""
    # Quiet: of what goes wrong the stage itself says a line, and the whole chain is looked through behind.
    command = [sys.executable, "-m", "dvc", "--wait-for-lock", "repro", "--quiet", "--single-item"]
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(lambda branch: subprocess.run([*command, *branch], check=False), branches))


def right_answers(file: Path, model: str | None) -> Iterator[str]:
    """A line a task of scores.csv: what a trained model that was asked got right; without one, the full system."""
    whose = (model, "", "touch") if model else ("finetuned", "with", "real")
    with file.open(newline="", encoding="utf-8") as stream:
        rows = [r for r in csv.DictReader(stream) if (r["encoder"], r["lora"], r["touch"]) == whose]
    found = {r["task"]: r for r in rows if r["seed"] == "all" and r["measure"] in ("choice", "combined")}
    for name in (task for task in TASKS if task in found):
        right, low, high, chance = (f"{100 * float(found[name][k]):.0f}" for k in ("accuracy", "low", "high", "chance"))
        yield f"  {TASKS[name].title}: {right} % right [{low}, {high}] of {found[name]['n']}, guessing {chance}"


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
    name, (waiting, total, branches) = params.report_name, outdated(root)
    if waiting:
        takes = f"; all take {TAKES[params.scale]}" if params.scale in TAKES else ""
        print(f"{name}: up to {waiting} of {total} stages will run{takes}", flush=True)
    if waiting or arguments:
        for handler in logging.getLogger("dvc").handlers:
            handler.addFilter(shown)
        # Side by side only where each takes so many threads of the processor, not a GPU nor what threads torch chooses.
        runtime, status = params.runtime, 0
        places = cores() // runtime.threads if runtime.threads and runtime.device == "cpu" and not arguments else 1
        if min(places, len(branches)) > 1:
            status = int(dvc(["repro", *TRUNK]))
            if not status:
                run_branches(branches, places)
        status = status or int(dvc(["repro", *arguments]))
        if stopped and isinstance(stopped[0], KeyboardInterrupt):
            raise KeyboardInterrupt
        if status:
            return 130 if stopped else status
    else:
        print(f"{name}: all {total} stages are up to date")
    if not (arguments or params.tracking.uri or (MLRUNS / "mlflow.db").is_file()):
        # A clone has the lock of a chain that ran elsewhere, so that DVC does not publish it; MLflow has nothing yet.
        attempt(params.tracking, publish, params)
    if (scores := root / "reports" / name / "scores.csv").is_file():
        model = next(iter(params.evaluate.models), None)
        print(f"{model or 'The full system'}, with 95 % intervals:", *right_answers(scores, model), sep="\n")
    print(f"Report: reports/{name}/README.md; all reports on one page: reports/index.html")
    print("Dashboard: make dashboard, then open http://127.0.0.1:5000")
    print('Ask the shipped model: octopi ask "Which is softer?" examples/soft.mp4 examples/hard.mp4')
    return 0
