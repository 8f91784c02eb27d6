"""Writes reports/speed_error.csv, the same as Markdown, and a Pareto plot a question.

`octopi page` does so before it shows them. This is no stage: it spans the benchmarks and the reports of all scales,
while a stage knows one scale. Equal files give equal bytes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from pipeline.io import write_text
from pipeline.errors import UserError
from pipeline.reporting.table import Table
from pipeline.speed.pareto import Point, draw_pareto
from pipeline.speed.questions import Answer, Unanswered, gather
from pipeline.speed.rows import SpeedRow

CSV = "speed_error.csv"
MARKDOWN = "speed_error.md"
PICTURES = "speed_error"
"""File and folder names in reports/."""
TITLE = "Speed against error"
RECOMMENDED, UNMEASURED = "Recommended settings", "Not measured yet"
"""Headings of the Markdown that belong to no question."""
RULE = (
    "Recommended is the cheapest setting whose error is at most the question's margin above the lowest error of all. "
    "A ratio is a cost over that of the setting with ratio 1, measured in the same run on the same machine; costs "
    "themselves cannot be compared from question to question. Counts of frames, tokens, floating-point operations and "
    "bytes do not depend on a machine, and are empty where the source does not have them."
)


def write_speed_error(root: Path) -> Path:
    """Gather all that reports/ below `root` has; returns the table. Plots of questions that are gone are deleted.

    Raises:
        UserError: where there is no reports/, or a file in it is not what its name says.
    """
    reports = root / "reports"
    if not reports.is_dir():
        raise UserError("reports: no such folder; `make repro` makes the first report")
    answers, missing = gather(reports)
    drawn = {reports / picture for answer in answers if (picture := _draw(answer, reports))}
    for stale in {*(reports / PICTURES).glob("*.png")} - drawn:
        stale.unlink()
    write_text(reports / CSV, _table([row for answer in answers for row in answer.rows]))
    write_text(reports / MARKDOWN, _markdown(answers, missing, reports))
    return reports / CSV


def slug(key: str) -> str:
    """A question's key as a file name."""
    return re.sub(r"[^a-z0-9]+", "-", key.lower()).strip("-")


def picture_of(key: str) -> str:
    """Where a question's plot lies in reports/, if there is one."""
    return f"{PICTURES}/{slug(key)}.png"


def _draw(answer: Answer, reports: Path) -> str:
    """Draw a question's plot; nothing where no setting has an error."""
    judged = [(row, row.error) for row in answer.rows if row.error is not None]
    grouped = any(", " in row.setting for row, _ in judged)
    points = [_point(row, error, grouped) for row, error in judged]
    if not points:
        return ""
    file, question = picture_of(answer.question.key), answer.question
    cost = f"cost in {answer.rows[0].unit}, as a ratio to: {question.source.baseline}"
    draw_pareto(points, reports / file, question.title, cost, _label(answer, points))
    return file


def _point(row: SpeedRow, error: float, grouped: bool) -> Point:
    group, _, name = row.setting.partition(", ") if grouped else ("", "", row.setting)
    return Point(
        group=group,
        name=name or group,
        cost=row.ratio,
        error=error,
        low=row.low,
        high=row.high,
        recommended=row.recommended,
    )


def _label(answer: Answer, points: Sequence[Point]) -> str:
    spread = any(point.low is not None for point in points)
    return f"{answer.question.error}{', 95 % interval' if spread else ''}"


def _table(rows: Sequence[SpeedRow]) -> str:
    """The CSV; of nothing measured the heading alone."""
    columns = ",".join(SpeedRow.__dataclass_fields__)
    return Table("speed_error", TITLE, "", rows).csv() if rows else f"{columns}\n"


def _markdown(answers: Sequence[Answer], missing: Sequence[Unanswered], reports: Path) -> str:
    parts = [f"# {TITLE}\n", f"{RULE}\n"]
    if answers:
        parts += [f"## {RECOMMENDED}\n", _recommended(answers)]
    for answer in answers:
        question, rows = answer.question, answer.rows
        caption = f"{_sentence(answer)} {question.text} {answer.origin} ([CSV]({CSV}))"
        parts += [f"## {question.title}\n", f"{caption}\n"]
        picture = picture_of(question.key)
        if (reports / picture).is_file():
            parts.append(f"![{question.title} Cost against error, with the recommended setting]({picture})\n")
        parts.append(Table(question.key, question.title, "", rows).markdown())
    if missing:
        lines = "".join(f"- **{m.question.title}** {m.reason[:1].upper()}{m.reason[1:]}.\n" for m in missing)
        parts += [f"## {UNMEASURED}\n", lines]
    return "\n".join(parts)


def _sentence(answer: Answer) -> str:
    """What is recommended, and by what margin."""
    chosen, question = answer.chosen, answer.question
    against = "" if chosen.setting == question.source.baseline else f" the cost of `{question.source.baseline}`"
    cost = f"{chosen.ratio:g} times{against}" if against else "the baseline itself"
    best = min((row for row in answer.rows if row.error is not None), key=lambda row: row.error or 0.0, default=None)
    if best is None or chosen.error is None:
        return f"**Recommended: {chosen.setting}** ({cost}), the cheapest."
    least = ", the lowest" if best.error == chosen.error else f"; the lowest is {best.error:g}, of `{best.setting}`"
    return f"**Recommended: {chosen.setting}** ({cost}): error {chosen.error:g}{least}; margin {question.margin:g}."


def _recommended(answers: Sequence[Answer]) -> str:
    lines = ["| Question | Recommended | Ratio | to | Error |", "|:---|:---|---:|:---|---:|"]
    for answer in answers:
        row, error = answer.chosen, answer.chosen.error
        cells = [
            answer.question.title,
            f"**{row.setting}**",
            f"{row.ratio:.3f}",
            answer.question.source.baseline,
            "" if error is None else f"{error:.3f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
