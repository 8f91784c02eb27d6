"""One page over all reports: reports/index.html, drawn from the files in reports/ and from nothing else.

It needs no network, runs no script and opens from disk. Its tables are those of the registry (`pipeline.report.tables`);
this module adds what stands around them: the tasks and effects as lines, speed against error, numerical stability, and
what is missing.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pipeline.errors import UserError
from pipeline.io import write_text
from pipeline.report.drawing import SIZE, draw_table, place_points, share, span
from pipeline.report.load import Report, load_report, read_frame
from pipeline.report.readme import finding
from pipeline.report.tables import FULL, TABLES, answers, difference, measured, number, task_title, whole
from pipeline.tasks import TASKS

PAGE = Path("reports/index.html")
LARGEST = 1_500_000
"""Bytes of the page at most, so that it opens at once on a phone."""
SPEED = ("question", "setting", "cost", "cost_ratio", "error", "low", "high", "front")
STABILITY = ("part", "case", "format", "finite", "error", "bound", "verdict")
AUDIT = ("check", "item", "measured", "expected", "severity")
OLDER = "the report is older than this file: `dvc repro report` at its scale writes it"
EXPECTED = {
    "effects.csv": f"no two of its variants differ in one part alone, or {OLDER}",
    "audit.csv": OLDER,
    "samples.json": OLDER,
    "curves.csv": f"its trainings kept no histories, or {OLDER}",
    "confusion.csv": OLDER,
}
"""Files of a report, and why it may lack one."""
Gap = tuple[str, str, str]
"""Where something is missing, what, and why."""


class Line(NamedTuple):
    """A figure with its interval, drawn on a line; places are percent of that line's width."""

    task: str
    title: str
    source: str = ""
    """File and line that it comes from; empty where nothing was measured."""
    said: str = ""
    note: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    chance: float | None = None
    published: dict[str, tuple[str, float]] = {}  # noqa: RUF012
    """What the paper printed for each size of its model, and its place."""


class Block(NamedTuple):
    """A table under its heading."""

    key: str
    title: str
    caption: str
    html: Markup
    file: str
    open: bool = False


def write_page(root: Path) -> Path:
    """Write the page over all reports below `root`; equal files give an equal page.

    Raises:
        UserError: there is no report, or the page would be larger than `LARGEST`.
    """
    folder, gaps = root / PAGE.parent, list[Gap]()
    reports = _reports(folder, gaps)
    if not reports:
        raise UserError(f"{folder}: no report yet; `make repro` writes one")
    environment = Environment(
        loader=PackageLoader("pipeline.report"), autoescape=True, trim_blocks=True, undefined=StrictUndefined
    )
    style = " ".join(environment.get_template("style.css").render().split())
    text = environment.get_template("page.html").render(
        style=Markup(style),
        digest=base64.b64encode(hashlib.sha256(style.encode()).digest()).decode(),
        chapters=[_chapter(report, gaps) for report in reports],
        speed=list(_speed(folder, gaps)),
        stability=_stability(folder, gaps),
        gaps=gaps,
        size=SIZE,
    )
    text = re.sub(r"\n\s*", "\n", text)
    if len(text.encode()) > LARGEST:
        raise UserError(f"{root / PAGE}: would have {len(text.encode())} bytes, over {LARGEST}; remove an old report")
    write_text(root / PAGE, text)
    return root / PAGE


def _reports(folder: Path, gaps: list[Gap]) -> list[Report]:
    """Real videos first, then scenes, smoke last; a folder that holds no whole report is a gap."""
    found = []
    for name in sorted({file.parent for pattern in ("scores.csv", "provenance.json") for file in folder.glob(f"*/{pattern}")}):
        try:
            found.append(load_report(name))
        except (UserError, ValueError) as error:
            gaps.append((name.name, "the whole report", str(error)))
    return sorted(found, key=lambda r: (_kind(r)[0] == "smoke", _kind(r)[1] != "videos", r.name))


def _kind(report: Report) -> tuple[str, str]:
    """Scale and source."""
    scale, _, source = report.name.partition("-")
    return str(report.provenance.get("scale", scale)), str(report.provenance.get("source", source))


def _chapter(report: Report, gaps: list[Gap]) -> dict[str, Any]:
    """What the template shows of one report."""
    scale, source = _kind(report)
    tasks, (effects, points) = list(_tasks(report)), _effects(report)
    gaps += [(report.name, line.title, "the full system was not asked it") for line in tasks if not line.source]
    gaps += [(report.name, name, why) for name, why in EXPECTED.items() if not (report.folder / name).is_file()]
    files = sorted(p.relative_to(report.folder.parent).as_posix() for p in report.folder.rglob("*.*") if p.is_file())
    return {
        "report": report,
        "kind": f"{'Real videos' if source == 'videos' else 'Synthetic scenes'}, scale {scale}",
        "finding": finding(report),
        "tasks": tasks,
        "effects": effects,
        "points": points,
        "blocks": [*_tables(report, scale != "smoke", gaps), *_audit(report)],
        "facts": list(_facts(report.provenance)),
        "files": files,
    }


def _tasks(report: Report) -> Iterator[Line]:
    """Every task with the full system's accuracy on real touch over all seeds."""
    rows = _full(report.scores[answers(report.scores) & whole(report.scores)])
    printed = _full(report.published[whole(report.published)])
    for task in dict.fromkeys([*TASKS, *rows["task"]]):
        title = task_title(task).removesuffix(f" ({task})")
        for index, row in zip(rows.index, rows.to_dict("records"), strict=True):
            if row["task"] == task:
                models = printed[printed["task"].eq(task) & printed["measure"].eq(row["measure"])].to_dict("records")
                yield Line(
                    task,
                    title,
                    f"{report.name}/scores.csv:{index + 2}",
                    measured(row),
                    f"{row['right']:g} of {row['n']:g} right",
                    *(share(row[name]) for name in ("accuracy", "low", "high", "chance")),
                    {cell["model"]: (f"{cell['value']:.1f} (n {cell['n']:.0f})", cell["value"]) for cell in models},
                )
                break
        else:
            yield Line(task, title)


def _full(rows: pd.DataFrame) -> pd.DataFrame:
    """Those of the full system."""
    for axis, value in FULL.items():
        rows = rows[rows[axis].eq(value)]
    return rows


def _effects(report: Report) -> tuple[dict[str, list[Line]], float]:
    """The effects on whole answers by part, and half the width of their line in points."""
    rows = report.effects[whole(report.effects)]
    points = span(100 * rows[["difference", "low", "high"]].abs().max(axis=None)) if len(rows) else 0.0
    groups: dict[str, list[Line]] = {}
    for index, row in zip(rows.index, rows.to_dict("records"), strict=True):
        ends = (share(0.5 + 50 * row[name] / points) for name in ("difference", "low", "high"))
        source = f"{report.name}/effects.csv:{index + 2}"
        line = Line(row["task"], task_title(row["task"]), source, difference(row), number(row["p_holm"], 3), *ends)
        groups.setdefault(f"{row['part']}: {row['change']}", []).append(line)
    return groups, points


def _tables(report: Report, unfold: bool, gaps: list[Gap]) -> Iterator[Block]:
    """The registry's tables; one without a row is a gap."""
    for table in TABLES:
        frame = table.build(report.scores, report.effects, report.published)
        if frame.empty:
            gaps.append((report.name, table.title, f"no row of its {table.source}.csv belongs there: nothing such was run"))
            continue
        file = f"{report.name}/{table.source}.csv"
        lines = [f"{file}:{index + 2}" for index in table.select(report.scores, report.effects).index]
        html = draw_table(frame, table.title, lines)
        yield Block(f"{report.name}-{table.key}", table.title, table.caption, html, file, unfold and not table.folded)


def _audit(report: Report) -> Iterator[Block]:
    """The audit's findings, counted by check; what needs attention first."""
    audit = read_frame(report.folder / "audit.csv", AUDIT)
    if len(audit):
        file, counts = f"{report.name}/audit.csv", audit["severity"].value_counts().sort_index()
        groups = audit.groupby(["severity", "check"]).agg(n=("item", "size"), item=("item", "first"), said=("measured", "first"))
        groups = groups.reset_index().sort_values(["severity", "n"], ascending=[False, False], kind="stable")
        groups = groups.sort_values("severity", key=lambda s: s.map({"error": 0, "warning": 1, "info": 2}), kind="stable")
        shown = pd.DataFrame(
            {
                "Severity": groups["severity"],
                "Check": groups["check"],
                "Findings": groups["n"].astype(str),
                "The first of them": groups["item"] + ": " + groups["said"].astype(str),
            }
        )
        caption = f"{', '.join(f'{count} {name}' for name, count in counts.items())}; counted by check."
        yield Block(f"{report.name}-audit", "Data audit", caption, draw_table(shown, "Data audit", [file] * len(shown)), file)


def _speed(folder: Path, gaps: list[Gap]) -> Iterator[dict[str, Any]]:
    """Each question of speed_error.csv: its points, its front in words, its table."""
    rows = read_frame(folder / "speed_error.csv", SPEED)
    if rows.empty:
        gaps.append(("speed", "speed_error.csv", "nothing was measured yet: `make bench` measures it"))
    rows["front"] = rows["front"].astype(str).eq("True")
    for question, group in rows.groupby("question", sort=False):
        shown = group.drop(columns="question").dropna(axis="columns", how="all").map(_said)
        shown.columns = [_label(name) for name in shown]
        lines = [f"speed_error.csv:{index + 2}" for index in group.index]
        yield {
            "question": question,
            "measures": sorted({*group.get("unit", pd.Series(dtype=str)).dropna(), *group.get("error_of", pd.Series(dtype=str)).dropna()}),
            "points": place_points(group),
            "front": group[group["front"]].sort_values("cost_ratio").map(_said).to_dict("records"),
            "html": draw_table(shown, str(question), lines),
        }


def _stability(folder: Path, gaps: list[Gap]) -> dict[str, Any]:
    """How many cases passed by part and number format, and the cases that failed."""
    rows = read_frame(folder / "stability.csv", STABILITY)
    if rows.empty:
        gaps.append(("stability", "stability.csv", "nothing was measured yet: `make stability` measures it"))
        return {"cases": 0}
    failed = rows[rows["verdict"].ne("pass")]
    groups = rows.assign(passed=rows["verdict"].eq("pass")).groupby(["part", "format"])["passed"]
    cells = (groups.sum().astype(str) + " of " + groups.size().astype(str)).unstack(fill_value="")
    cells.insert(0, "Part", cells.index)
    return {
        "cases": len(rows),
        "failed": len(failed),
        "failures": draw_table(failed.map(_said), "Failed", [f"stability.csv:{i + 2}" for i in failed.index]) if len(failed) else "",
        "table": draw_table(cells, "Cases that passed, by part and number format", ["stability.csv"] * len(cells)),
    }


def _facts(provenance: dict[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Names and values; of what holds further names, each its own."""
    for name, value in provenance.items():
        if isinstance(value, dict) and any(isinstance(inner, dict) for inner in value.values()):
            yield from _facts(value, f"{_label(name)}, ")
        elif value not in ("", [], {}):
            yield f"{above}{_label(name) if not above else _label(name).lower()}", _said(value)


def _said(value: Any) -> str:
    """A value in words: four digits of a fraction, the beginning of a hash, nothing for what is missing."""
    if isinstance(value, dict):
        return ", ".join(f"{_label(k).lower()} {_said(v)}" for k, v in value.items() if v not in ("", False))
    if isinstance(value, list):
        return ", ".join(map(_said, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if pd.isna(value) else f"{value:,.4g}"
    text = f"{value:,}" if isinstance(value, int) else str(value)
    return f"{text[:12]}…" if re.fullmatch(r"[0-9a-f]{40,}", text) else text


def _label(name: str) -> str:
    return name.replace("_", " ").capitalize()
