"""What differs between two commits, or a commit and what lies on disk: `octopi diff`.

Parameters and metrics are DVC's own comparison. What DVC lacks is the paired test of the answers to the same questions.
DVC reads both states: Git's files and, by the hashes in dvc.lock, what its cache holds. Nothing is checked out or run.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow.parquet as pq
from dvc.api import DVCFileSystem
from dvc.exceptions import DvcException
from dvc.repo import Repo
from dvc.scm import RevError
from scmrepo.exceptions import SCMError

from pipeline.core.layout import GRADED, QUESTIONS
from pipeline.evaluation.records import Graded
from pipeline.evaluation.rows import EffectRow
from pipeline.evaluation.scores import difference, grouped, with_holm
from pipeline.running.errors import UserError, without_secrets
from pipeline.tasks import TASKS
from pipeline.weights import first_words

SHOWN = 40
Rows = list[dict[str, Any]]


class State(NamedTuple):
    """The project at one point of its history: its files as Git, the disk and DVC's cache have them."""

    name: str
    """The revision as the person wrote it, with its hash."""
    files: DVCFileSystem

    @classmethod
    def of(cls, root: Path, revision: str) -> State:
        """What a revision (a hash, a tag, a branch, `HEAD~1`, a DVC experiment) names; the working tree for none."""
        try:
            repo = Repo(str(root), rev=revision or None)
            name = f"{revision} ({repo.get_rev()[:8]})" if revision else "working tree"
            return cls(name, DVCFileSystem(repo=repo))
        except (RevError, SCMError, AttributeError):  # SCMError without any commit; the last for a file of a commit.
            there = f"no commit of a Git repository in {root.resolve()}"
            raise UserError(f"{revision}: {there}; `git log` and `dvc exp list` list them") from None
        except DvcException as error:
            raise UserError(f"{root.resolve()}: {error}; go to a clone of the project") from None

    def read(self, path: str) -> bytes | None:
        """A file; None where it is not at hand."""
        try:
            return bytes(self.files.read_bytes(path))
        except (OSError, DvcException):
            return None

    def answers(self) -> list[Graded] | None:
        """Graded answers; None where they are not at hand."""
        content = self.read(str(GRADED))
        rows = None if content is None else pq.read_table(io.BytesIO(content)).to_pylist()
        return None if rows is None else [Graded.model_validate(row) for row in rows]

    def asked(self) -> dict[str, object]:
        """By question id, over all seeds, what identifies a question's content: its videos and its right answer."""
        files = self.files.glob(f"{QUESTIONS}/*/evaluation.jsonl")
        rows = (json.loads(line) for file in files for line in (self.read(file) or b"").splitlines())
        return {row["question_id"]: (row["videos"], row["gold"]) for row in rows}


def compare(root: Path, old: str, new: str = "") -> dict[str, Any]:
    """Compare two Git revisions of the project in `root`; an empty `new` is the working tree.

    Returns:
        `old` and `new`, the names of both; `differs`; rows of what differs in `parameters` and `metrics`; `tested`, as
        in effects.csv; `notes`, why something could not be compared.

    Raises:
        UserError: for an unknown revision, a folder outside Git and DVC, or a broken file.
    """
    one, two = State.of(root, old or "HEAD"), State.of(root, new)
    found: dict[str, Rows] = {}
    with Repo(str(root)) as repo:
        for kind, differences in (("parameters", repo.params.diff), ("metrics", repo.metrics.diff)):
            said = differences(old or "HEAD", new or "workspace")
            for revision, error in said.get("errors", {}).items():
                # An error, or one by file.
                each = error if isinstance(error, dict) else {"": error}
                if broken := [e for e in each.values() if not isinstance(e, FileNotFoundError)]:
                    raise UserError(f"{revision}: {' '.join(str(broken[0]).split())}; restore it from Git")
            found[kind] = [
                {
                    # Two scales have a report each, with metrics of the same names.
                    "name": f"{Path(file).parent.name}.{name}".lstrip("."),
                    **{side: without_secrets(str(change[side])) for side in ("old", "new") if side in change},
                }
                for file, changes in said.get("diff", {}).items()
                for name, change in changes.items()
            ]
        answers = [stage.addressing for stage in repo.index.stages if stage.name == "grade"]
        stale = repo.status(targets=answers, with_deps=True) if answers and not new else {}
    found["tested"], notes = _tested(one, two)
    if stale:
        first = f"{min(stale)}{' and more' if len(stale) > 1 else ''}"
        notes.append(f"The answers on disk are stale ({first} changed since); `octopi repro` makes them anew.")
    return {"old": one.name, "new": two.name, "differs": any(found.values()), **found, "notes": notes}


def describe(found: dict[str, Any]) -> str:
    """A comparison for a terminal; long lists are cut."""
    parts = [f"{found['old']} -> {found['new']}" if found["differs"] else "No parameter, metric or answer differs"]
    for title in ("parameters", "metrics", "tested"):
        if rows := found[title]:
            table = pd.DataFrame(rows[:SHOWN]).fillna("").to_string(index=False, max_colwidth=72)
            rest = f"\n... and {len(rows) - SHOWN} more; --json FILE has them all" if len(rows) > SHOWN else ""
            parts.append(f"{title.capitalize()}\n{table}{rest}")
    return "\n\n".join([*parts, *found["notes"]])


def _tested(one: State, two: State) -> tuple[Rows, list[str]]:
    """Each system against itself on the questions that both asked, pooled over the seeds that both have; notes."""
    try:
        graded = [one.answers(), two.answers()]
    except ValueError as error:
        return [], [f"No paired test: {GRADED} is not as grading writes it today ({first_words(error)})."]
    if lacking := " and ".join(state.name for state, found in zip((one, two), graded, strict=True) if found is None):
        return [], [f"No paired test: {GRADED} of {lacking} is not at hand; `dvc pull` or `dvc repro` there brings it."]
    asked = [one.asked(), two.asked()]
    # Where one side's questions are not at hand, only the objects can tell whether a question is the same.
    meant = [
        {g.question_id: (all(asked) and own.get(g.question_id), g.objects) for g in found or ()}
        for own, found in zip(asked, graded, strict=True)
    ]
    same = {question for question, meaning in meant[0].items() if meaning == meant[1].get(question)}
    before, after = (grouped(g for g in found or () if g.question_id in same) for found in graded)
    rows = []
    for (task, measure), settings in after.items():
        for setting, runs in settings.items() if task in TASKS and measure == TASKS[task].measure else ():
            earlier = before.get((task, measure), {}).get(setting, {})
            if runs != earlier and (gap := difference(runs, earlier)):
                part = " ".join(filter(None, setting))  # Heads and rules have no language model to name.
                rows.append(EffectRow(part=part, change="new - old", task=task, measure=measure, **vars(gap)))
    other = len(meant[0].keys() | meant[1].keys()) - len(same)
    notes = [f"{len(same)} questions are compared; {other} were asked by one side only, or differ."] if other else []
    return [row.model_dump(mode="json") for row in with_holm(rows)], notes
