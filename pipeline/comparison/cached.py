"""Per-question scores of either state, by the hashes in its dvc.lock, from DVC's cache. DVC is imported where used."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.comparison.locked import Locked
from pipeline.errors import UserError

SCORES, QUESTIONS = "data/scores/", "data/questions"
SCORE_FILE, QUESTION_FILE = "scores.parquet", "evaluation.jsonl"
READ = ("question_id", "task", "measure", "correct", "expected", "objects")
"""All that a comparison reads of a score; older scores may lack other columns."""


@dataclass(frozen=True)
class Graded:
    """One measure of one answer."""

    question: str
    task: str
    measure: str
    correct: bool
    expected: str
    objects: tuple[str, ...]


class NotCachedError(Exception):
    """DVC's cache on this machine lacks a file, or there is no cache."""


@dataclass(frozen=True)
class Cache:
    """DVC's cache of the project in `root`."""

    root: Path

    @cached_property
    def _local(self) -> Any:
        from dvc.exceptions import DvcException
        from dvc.repo import Repo

        try:
            return Repo(str(self.root)).cache.local
        except DvcException as error:
            raise NotCachedError(str(error)) from None

    def read(self, folder: str, name: str) -> bytes:
        """The file `name` of a folder whose hash is `folder`.

        Raises:
            NotCachedError: where the cache lacks the folder or the file.
        """
        listing = json.loads(self._bytes(folder))
        oid = next((entry["md5"] for entry in listing if entry["relpath"] == name), "")
        return self._bytes(oid)

    def _bytes(self, oid: str) -> bytes:
        if not oid:
            raise NotCachedError("no hash")
        try:
            return Path(self._local.oid_to_path(oid)).read_bytes()
        except OSError as error:
            raise NotCachedError(str(error)) from None


def score_hashes(stages: Mapping[str, Locked]) -> dict[str, str]:
    """Variant to the hash of its folder of scores."""
    outs = ((path, oid) for stage in stages.values() for path, oid in stage.outs.items())
    return {path.removeprefix(SCORES): oid for path, oid in outs if path.startswith(SCORES)}


def questions_hash(stages: Mapping[str, Locked]) -> str:
    """The hash of the folder of questions; empty where the stage has not run."""
    return next((oid for stage in stages.values() for path, oid in stage.outs.items() if path == QUESTIONS), "")


def read_scores(cache: Cache, oid: str, where: str) -> list[Graded]:
    """All scores of a variant.

    Raises:
        NotCachedError: where they are not there.
        UserError: where they are no scores; `where` says whose they are.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(io.BytesIO(cache.read(oid, SCORE_FILE)), columns=list(READ))
        columns = [table.column(name).to_pylist() for name in READ]
    except (pa.ArrowException, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"scores of {where}: not a table of scores ({reason}); `dvc repro` makes it anew") from None
    return [
        Graded(question, task, measure, correct, expected, tuple(objects))
        for question, task, measure, correct, expected, objects in zip(*columns, strict=True)
    ]


def read_questions(cache: Cache, oid: str, where: str) -> dict[str, str]:
    """By id, what makes a question this one and no other: its videos and its right answer.

    Raises:
        NotCachedError: where they are not there.
        UserError: where they are no questions; `where` says whose they are.
    """
    try:
        rows = [json.loads(line) for line in cache.read(oid, QUESTION_FILE).decode().splitlines()]
        return {row["question_id"]: json.dumps([row["videos"], row["gold"]], sort_keys=True) for row in rows}
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"questions of {where}: not as the chain writes them ({error}); run `dvc repro`") from None
