"""`octopi repro`: says how many stages will run, lets DVC run them, and says where the results are."""

from __future__ import annotations

import logging
from pathlib import Path

from pipeline.config.params import CHAIN, load_params
from pipeline.running.errors import UserError

INTERRUPTED = ("exited with 130", "exited with -2")
"""How DVC's error ends for a stage that Ctrl-C ended, the second where it had hardly begun or was at its end."""


def outdated(root: Path) -> tuple[list[str], int, bool]:
    """The stages that will run at the most, in their order, how many there are, and whether all outputs are there.

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
    order = [stage.addressing for stage in nx.dfs_postorder_nodes(graph) if stage in waiting]
    whole = all(Path(out.fs_path).exists() for stage in graph for out in stage.outs)
    return order, sum(stage.path_in_repo == str(CHAIN) for stage in graph), whole


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
    name, (waiting, total, whole) = params.report_name, outdated(root)
    if waiting:
        print(f"{name}: up to {len(waiting)} of {total} stages will run", flush=True)
    if not whole and arguments == ["--dry"]:
        # DVC's own ends where a stage that is not run now has left nothing for the next one.
        print("\n".join(waiting))
        return 0
    if waiting or arguments:
        for handler in logging.getLogger("dvc").handlers:
            handler.addFilter(shown)
        status = int(dvc(["repro", *arguments]))
        if stopped and isinstance(stopped[0], KeyboardInterrupt):
            raise KeyboardInterrupt
        if status:
            return 130 if stopped else status
    else:
        print(f"{name}: all {total} stages are up to date")
    if not (arguments or params.tracking.uri or (MLRUNS / "mlflow.db").is_file()):
        # A clone has the lock of a chain that ran elsewhere, so that DVC does not publish it; MLflow has nothing yet.
        attempt(params.tracking, publish, params)
    print(f"Report: reports/{name}/README.md; all reports on one page: reports/index.html")
    print("Dashboard: make dashboard, then open the link to all variants that it prints after ten seconds")
    if waiting:
        kept = f"git add dvc.lock params.yaml reports && git commit -m '{name}'"
        print(f"Keep this run, which Git does not know yet: {kept} (docs/dashboard.md: how to go back)")
    return 0
