"""Reading what was measured, of whatever age: a file may lack columns that are newer, or have others."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.io import read_json
from pipeline.errors import UserError
from pipeline.speed.rows import SpeedRow

BENCH = "bench"


class Line(BaseModel):
    """A row as far as it is wanted here; what the file does not have is None."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


L = TypeVar("L", bound=Line)


@dataclass(frozen=True)
class Found:
    """What a question's sources say."""

    rows: tuple[SpeedRow, ...]
    baseline: str
    """The setting whose ratio is 1."""
    origin: str
    """Where it comes from, in a sentence."""


@dataclass(frozen=True)
class Missing:
    """Why a question cannot be answered, with the command that would measure it."""

    reason: str


def bench_file(section: str) -> str:
    """Where a section of the benchmarks lies, relative to reports/."""
    return f"{BENCH}/{section}.json"


def bench_command(section: str) -> str:
    """What measures a section."""
    return f"`make bench SECTION={section}` measures it"


def read_lines(path: Path, model: type[L]) -> list[L]:
    """The rows of a CSV, or of a JSON list; none where there is no file.

    Raises:
        UserError: for a file that is something else, or a row without what it must have.
    """
    if not path.is_file():
        return []
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as stream:
            content: Any = [{k: v for k, v in row.items() if v != ""} for row in csv.DictReader(stream)]
    else:
        content = read_json(path)
    if not isinstance(content, list) or not all(isinstance(row, Mapping) for row in content):
        raise UserError(f"{path}: not a list of rows; delete it and measure it again")
    found = []
    for number, row in enumerate(content, 1):
        try:
            found.append(model.model_validate(row))
        except ValidationError as error:
            detail = error.errors(include_url=False)[0]
            what = f"{'.'.join(map(str, detail['loc']))}: {detail['msg']}"
            raise UserError(f"{path}, row {number}: {what}; delete the file and measure it again") from None
    return found


def checked(rows: Sequence[SpeedRow], baseline: str, origin: str, file: str, command: str) -> Found | Missing:
    """The rows if they can be compared: two settings or more, the baseline among them."""
    if len(rows) < 2 or baseline not in {row.setting for row in rows}:
        return Missing(f"`reports/{file}` does not have `{baseline}` and a setting to compare with it; {command}")
    return Found(tuple(rows), baseline, origin)
