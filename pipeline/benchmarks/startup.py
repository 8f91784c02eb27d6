"""What stages pay for starting, against importing everything that the project uses.

A stage's cost is a fresh Python process that runs the import statements at the top of its script, and so loads every
module that these load in turn; what is imported inside functions is paid by those who call them. Publishing is measured
whole, into a database of its own.
"""

from __future__ import annotations

import ast
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from pipeline.benchmarks import BenchRow
from pipeline.errors import UserError

REPEATS = 3
EVERYTHING = "import torch, peft, open_clip, mlflow\nfrom transformers import Trainer"
BASELINE = "importing torch, Trainer, peft, open_clip and mlflow"
PUBLISH = """\
import sys
from pathlib import Path
from pipeline.params import load_params
from pipeline.tracking.publishing import publish
params = load_params()
tracking = params.tracking.model_copy(update={"uri": f"sqlite:///{sys.argv[1]}/mlflow.db"})
publish(params.model_copy(update={"tracking": tracking}), Path())
"""


def measure(root: Path, repeats: int = REPEATS, everything: str = EVERYTHING) -> list[BenchRow]:
    """Time the start of every script in stages/, and publishing where there is something to publish.

    Args:
        everything: the imports of the baseline.

    Raises:
        UserError: where stages/ has no script or a script's imports fail.
    """
    scripts = sorted((root / "stages").glob("*.py"))
    if not scripts:
        raise UserError(f"{root / 'stages'}: no script; run from the repository's root")
    times = {BASELINE: _times(everything, root, repeats), "starting Python": _times("pass", root, repeats)}
    times |= {f"stages/{s.name}": _times(top_imports(s), root, repeats) for s in scripts}
    if (root / "dvc.lock").is_file():
        times |= _publishing(root, repeats)
    whole = median(times[BASELINE])
    return [
        BenchRow(
            case=case,
            cost=round(median(costs), 3),
            unit="s",
            baseline=BASELINE,
            ratio=round(median(costs) / whole, 4),
            low=round(min(costs), 3),
            high=round(max(costs), 3),
        )
        for case, costs in times.items()
    ]


def top_imports(script: Path) -> str:
    """The import statements at the top level of a script, alone: running the script would run the stage."""
    nodes = ast.parse(script.read_text(encoding="utf-8")).body
    return "\n".join(ast.unparse(node) for node in nodes if isinstance(node, ast.Import | ast.ImportFrom))


def _publishing(root: Path, repeats: int) -> dict[str, list[float]]:
    """Publishing into a new database, and into one that has it all already."""
    first, again = [], []
    for _ in range(repeats):
        with TemporaryDirectory() as folder:
            first += _times(PUBLISH, root, 1, folder)
            again += _times(PUBLISH, root, 1, folder)
    return {"publishing, new database": first, "publishing, nothing new": again}


def _times(code: str, root: Path, repeats: int, *arguments: str) -> list[float]:
    """Wall-clock seconds of fresh processes that run `code` in `root`."""
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", code, *arguments], cwd=root, capture_output=True, text=True)
        seconds.append(time.perf_counter() - started)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise UserError(f"bench startup: {code.splitlines()[0]} ...: {reason}")
    return seconds
