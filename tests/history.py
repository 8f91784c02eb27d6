"""A Git and DVC repository of a few tiny stages that copy made-up results, and its history."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from pipeline.io import write_table
from pipeline.records import Score, Task

REPORT = "reports/smoke-scenes"
CHAIN = {
    "stages": {
        "questions": {
            "cmd": "mkdir -p data/questions && cp made/evaluation.jsonl data/questions/evaluation.jsonl",
            "deps": ["made/evaluation.jsonl"],
            "outs": ["data/questions"],
        },
        "grade": {
            "foreach": ["full", "base"],
            "do": {
                "cmd": "mkdir -p data/scores/${item} && cp made/${item}.parquet data/scores/${item}/scores.parquet",
                "deps": ["made/${item}.parquet", "code.py", "data/questions"],
                "params": ["epochs"],
                "outs": ["data/scores/${item}"],
            },
        },
        "report": {
            "cmd": f"mkdir -p {REPORT}/tables && cp made/metrics.json {REPORT}/ && cp made/*.csv {REPORT}/tables/",
            "deps": ["made", "data/scores"],
            "outs": [{f"{REPORT}/metrics.json": {"cache": False}}, {f"{REPORT}/tables": {"cache": False}}],
        },
    }
}


@dataclass(frozen=True)
class Asked:
    """A question: id, its objects, and which video of them."""

    name: str
    objects: tuple[str, ...]
    video: int = 0
    task: Task = Task.OPD


@dataclass
class History:
    """The repository; every `commit` reproduces before it commits."""

    folder: Path
    commits: dict[str, str] = field(default_factory=dict)

    def begin(self) -> None:
        """An empty repository with the chain."""
        from dvc.repo import Repo

        self.folder.mkdir(parents=True)
        self.git("init", "--quiet")
        Repo.init(str(self.folder))
        (self.folder / ".dvc" / "config").write_text("[core]\n    analytics = false\n")
        (self.folder / "dvc.yaml").write_text(yaml.safe_dump(CHAIN))
        (self.folder / ".gitignore").write_text("/data/\n")
        (self.folder / "code.py").write_text("")

    def git(self, *arguments: str) -> str:
        """Run Git here; return what it says."""
        identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        done = subprocess.run(
            ["git", *identity, *arguments], cwd=self.folder, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    def params(self, **values: object) -> None:
        """Write params.yaml."""
        (self.folder / "params.yaml").write_text(yaml.safe_dump(values))

    def made(self, name: str, text: str) -> None:
        """A file that a stage copies."""
        (self.folder / "made").mkdir(exist_ok=True)
        (self.folder / "made" / name).write_text(text)

    def questions(self, asked: Sequence[Asked]) -> None:
        """What the stage `questions` gives out."""
        rows = [{"question_id": q.name, "videos": [f"{o}_{q.video}" for o in q.objects], "gold": "x"} for q in asked]
        self.made("evaluation.jsonl", "".join(json.dumps(row) + "\n" for row in rows))

    def scores(self, variant: str, asked: Sequence[Asked], right: Mapping[str, bool]) -> None:
        """What grading a variant gives; a description also has a property, which is no test of its own."""
        rows = []
        for q in asked:
            for measure in ("combined", "hardness") if q.task is Task.OPD else ("choice",):
                rows.append(
                    Score(
                        question_id=q.name,
                        task=q.task,
                        measure=measure,
                        correct=right[q.name] or measure == "hardness",
                        parsed=True,
                        truncated=False,
                        expected="a",
                        predicted="",
                        objects=q.objects,
                    )
                )
        (self.folder / "made").mkdir(exist_ok=True)
        write_table(self.folder / "made" / f"{variant}.parquet", Score, rows)

    def reproduce(self) -> None:
        """Run what changed."""
        from dvc.repo import Repo

        # Without targets DVC runs what is in the current folder.
        with chdir(self.folder), Repo() as repo:
            repo.reproduce()

    def commit(self, name: str) -> str:
        """Reproduce, commit everything under a tag, and return its hash."""
        self.reproduce()
        self.git("add", "--all")
        self.git("commit", "--quiet", "--allow-empty", "--message", name)
        self.git("tag", name)
        self.commits[name] = self.git("rev-parse", "HEAD")
        return self.commits[name]
