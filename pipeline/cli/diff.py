"""What differs between two commits, or a commit and what lies on disk: `octopi diff`.

DVC reads both states: Git's files and, by the hashes in dvc.lock, what its cache holds. Nothing is checked out or run.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq

from pipeline.cli.revisions import State, find_state
from pipeline.core.errors import UserError, without_secrets
from pipeline.core.records import EffectRow, Graded
from pipeline.evaluation.scores import difference, grouped, with_holm
from pipeline.tasks import TASKS

GRADED, QUESTIONS = "data/graded.parquet", "data/questions"
KEY = ("task", "measure", "encoder", "lora", "opd", "touch", "seed")
SHOWN = 40
Rows = list[dict[str, Any]]


def compare(root: Path, old: str, new: str = "") -> dict[str, Any]:
    """Compare two Git revisions of the project in `root`; an empty `new` is the working tree.

    Returns:
        `old` and `new`, the names of both; `differs`; rows of what differs in `parameters`, `stages` (by dvc.lock),
        `metrics`, `losses` and `scores`; `tested`, as in effects.csv; `notes`, why something could not be compared.

    Raises:
        UserError: for an unknown revision, a folder outside Git and DVC, or a broken file.
    """
    one, two = find_state(root, old), find_state(root, new or None)
    tested, notes = _tested(one, two)
    found: dict[str, Rows] = {
        "parameters": _changes(_flat(one.mapping("params.yaml")), _flat(two.mapping("params.yaml"))),
        "stages": _stages(_locked(one), _locked(two)),
        "metrics": _changes(_metrics(one), _metrics(two)),
        "losses": _changes(_losses(one), _losses(two)),
        "scores": _changes(_scores(one), _scores(two)),
        "tested": tested,
    }
    same = bool(found["stages"]) and bool(_scores(one)) and not (found["scores"] or notes or tested)
    notes += ["No accuracy changed."] if same else []
    return {"old": one.name, "new": two.name, "differs": any(found.values()), **found, "notes": notes}


def describe(found: dict[str, Any]) -> str:
    """A comparison for a terminal; long lists are cut."""
    parts = [f"{found['old']} -> {found['new']}" if found["differs"] else "Nothing differs"]
    for title, rows in found.items():
        if isinstance(rows, list) and rows and title != "notes":
            table = pd.DataFrame(rows[:SHOWN]).fillna("").to_string(index=False, max_colwidth=72)
            rest = f"\n... and {len(rows) - SHOWN} more; --json FILE has them all" if len(rows) > SHOWN else ""
            parts.append(f"{title.capitalize()}\n{table}{rest}")
    return "\n\n".join([*parts, *found["notes"]])


def _locked(state: State) -> dict[str, Any]:
    stages = state.mapping("dvc.lock").get("stages") or {}
    if not isinstance(stages, dict) or not all(isinstance(entry, dict) for entry in stages.values()):
        raise UserError(f"dvc.lock of {state.name}: its stages are no mapping; restore it from Git")
    return stages


def _stages(old: dict[str, Any], new: dict[str, Any]) -> Rows:
    rows: Rows = []
    for name in [name for name in dict.fromkeys([*new, *old]) if old.get(name) != new.get(name)]:
        one, two = old.get(name, {}), new.get(name, {})
        deps, outs = (
            [c["name"] for c in _changes(*({d["path"]: d.get("md5") for d in e.get(kind, ())} for e in (one, two)))]
            for kind in ("deps", "outs")
        )
        why = [*deps, *(kind for kind in ("params", "cmd") if one.get(kind) != two.get(kind))]
        because = ", ".join(why) if one and two else f"only in the {'new' if two else 'old'}"
        rows.append({"stage": name, "because of": because, "made": ", ".join(outs)})
    return rows


def _tested(one: State, two: State) -> tuple[Rows, list[str]]:
    """Each system against itself on the questions that both asked, pooled over the seeds that both have."""
    try:
        answers = [_answers(state) for state in (one, two)]
    except ValueError as error:
        return [], [
            f"No paired test: {GRADED} is not as grading writes it today ({' '.join(str(error).split())[:200]})."
        ]
    if lacking := " and ".join(state.name for state, found in zip((one, two), answers, strict=True) if found is None):
        return [], [f"No paired test: {GRADED} of {lacking} is not at hand; `dvc pull` or `dvc repro` there brings it."]
    asked = [_questions(state) for state in (one, two)]
    if not all(asked):  # Then objects alone must tell whether a question is the same.
        asked = [{}, {}]
    meant = [
        {g.question_id: (videos.get(g.question_id), g.objects) for g in found or ()}
        for found, videos in zip(answers, asked, strict=True)
    ]
    same = {question for question, meaning in meant[0].items() if meaning == meant[1].get(question)}
    before, after = (grouped(g for g in found or () if g.question_id in same) for found in answers)
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


def _metrics(state: State) -> dict[str, str]:
    return _flat({Path(folder).name: state.mapping(f"{folder}/metrics.json") for folder in state.folders("reports")})


def _losses(state: State) -> dict[str, str]:
    """By report and training: its last loss."""
    found = {}
    for folder in state.folders("reports"):
        for row in _rows(state, f"{folder}/curves.csv"):
            if row["name"] == "loss":  # Of each training by rising step.
                found[f"{Path(folder).name} {row['stage']}"] = row["value"]
    return found


def _rows(state: State, file: str) -> Rows:
    """Of a CSV file; none where there is no such file."""
    rows: Rows = pd.read_csv(io.BytesIO(state.read(file) or b"nothing"), dtype=str).fillna("").to_dict("records")
    return rows


def _scores(state: State) -> dict[str, str]:
    """By key: the accuracy and its interval."""
    found = {}
    for folder in state.folders("reports"):
        for row in _rows(state, f"{folder}/scores.csv"):
            name = " ".join([Path(folder).name, *filter(None, map(row.get, KEY))])
            found[name] = f"{row.get('accuracy')} [{row.get('low')}, {row.get('high')}]"
    return found


def _answers(state: State) -> list[Graded] | None:
    content = state.read(GRADED)
    return (
        None
        if content is None
        else [Graded.model_validate(row) for row in pq.read_table(io.BytesIO(content)).to_pylist()]
    )


def _questions(state: State) -> dict[str, object]:
    """By id, over all seeds, what makes a question this one: its videos and its right answer."""
    seeds = (state.mapping("params.yaml").get("ablation") or {}).get("seeds", [0])
    files = [state.read(f"{QUESTIONS}/{seed}/evaluation.jsonl") or b"" for seed in seeds]
    rows = (json.loads(line) for file in files for line in file.splitlines())
    return {row["question_id"]: (row["videos"], row["gold"]) for row in rows}


def _changes(old: dict[str, Any], new: dict[str, Any]) -> Rows:
    names = [name for name in dict.fromkeys([*new, *old]) if old.get(name) != new.get(name)]
    return [{"name": name, "old": old.get(name), "new": new.get(name)} for name in names]


def _flat(nested: dict[str, Any]) -> dict[str, str]:
    """Dotted key to value, as text."""
    rows = pd.json_normalize(nested).to_dict("records")
    return {str(k): without_secrets(str(v)) for row in rows for k, v in row.items()}
