"""One page over all reports: reports/index.html, drawn from the files in reports/ and from nothing else.

It needs no network, runs no script and opens from disk. Its tables are those of the registry
(`pipeline.report.tables`); this module adds what stands around them: all reports side by side, the tasks and effects
as lines, speed against error, numerical stability, and what is missing.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup

from pipeline.config.params import PARAMS_FILE, load_params
from pipeline.core.errors import UserError
from pipeline.core.io import write_text
from pipeline.report.dataset import dataset_tables
from pipeline.report.load import KEYS, Report, cells, load_report, read_frame
from pipeline.report.readme import OTHER_MODELS, sections
from pipeline.report.render import draw_table, render
from pipeline.report.tables import (
    PARTS,
    SHIPPED_TABLE,
    TABLES,
    difference,
    headline,
    measured,
    number,
    side_by_side,
    task_title,
    whole,
)
from pipeline.tasks import TASKS

PAGE = Path("reports/index.html")
LARGEST = 1_500_000
"""Bytes of the page at most, so that it opens at once on a phone."""
SPEED = ("question", "setting", "cost", "unit", "cost_ratio", "error", "error_of", "low", "high", "front")
STABILITY = ("part", "case", "format", "finite", "error", "bound", "verdict")
MODELS = ("7b", "13b")
EXPECTED = ("effects.csv", "audit.csv", "samples.json", "curves.csv", "confusion.csv")
OLDER = "the report is older than this file: `dvc repro report` at its scale writes it"
BESIDE = (
    (
        "encoder_errors.csv",
        "How far encoders are off",
        "Classes are ordinal: classes that an answer is off on average, and Cohen's quadratically weighted kappa.",
    ),
    (
        "calibration.csv",
        "Calibration of the heads' probabilities",
        "Test videos, by the probability of the likeliest class; the row of all has the expected calibration error "
        "with its interval over objects. The temperature is fitted on validation objects.",
    ),
)
"""Files that are tables as they are, with title and caption."""
Gap = tuple[str, str, str]
"""Where something is missing, what, and why."""
BY_USER = (
    ("paper-7b-videos", "Octopi with Vicuna 7b", "needs a GPU of 48 GB, the videos and the weights (`README.md`)"),
    ("paper-13b-videos", "Octopi with Vicuna 13b", "needs two such GPUs, the videos and the weights (`README.md`)"),
    ("RIPE", "avocados, described and compared", "needs videos of ten and their ranks of ripeness (`docs/avocado.md`)"),
    (
        "avocados photos",
        "a model that only sees them, in place of PG-InstructBLIP",
        "needs photos of the avocados and a model's endpoint (`octopi answer-with`)",
    ),
    ("robot", "the arm that sorts avocados", "needs one with such a sensor; it asks a trained model (`docs/robot.md`)"),
)
"""What of the paper only a user can measure: what in a report on real videos would show it (its name, a task, the data
set and what was there in place of touch), what it is, and what it needs."""


def write_page(root: Path) -> Path:
    """Write the page over all reports below `root`; equal files give an equal page.

    Raises:
        UserError: there is no report, or the page would be larger than `LARGEST`.
    """
    folder, gaps = root / PAGE.parent, list[Gap]()
    own = root / PARAMS_FILE
    current = load_params(own).report_name if own.is_file() else ""
    chapters = _chapters(folder, gaps, current)
    if not chapters:
        raise UserError(f"{folder}: no whole report yet; `make repro` writes one")
    gaps += left_to_users([c["report"] for c in chapters])
    # What random models answer is chance, and nothing to hold against the paper.
    reports = {c["name"] + ("†" if c["looked_at"] else ""): c["report"] for c in chapters if not c["plumbing"]}
    paper = []
    for title, every in (("Five tasks of the paper", False), ("Every row of the paper", True)):
        if reports and len(frame := side_by_side(reports, every=every)):
            paper.append(draw_table(frame, title, "*/scores.csv", at_lines=False))
    style = " ".join(render("style.css").split())
    text = render(
        "page.html",
        style=Markup(style),
        digest=base64.b64encode(hashlib.sha256(style.encode()).digest()).decode(),
        chapters=chapters,
        paper=paper,
        other_models=OTHER_MODELS,
        speed=list(_speed(folder, gaps)),
        stability=_stability(folder, gaps),
        gaps=gaps,
    )
    text = re.sub(r"\n\s*", "\n", text)
    if len(text.encode()) > LARGEST:
        raise UserError(f"{root / PAGE}: would have {len(text.encode())} bytes, over {LARGEST}; remove an old report")
    write_text(root / PAGE, text)
    return root / PAGE


def _chapters(folder: Path, gaps: list[Gap], current: str) -> list[dict[str, Any]]:
    """The current report, then real videos, scenes, looked-at test objects, smoke; a broken report is a gap."""
    found: list[dict[str, Any]] = []
    for place in sorted({file.parent for name in ("scores.csv", "README.md") for file in folder.glob(f"*/{name}")}):
        try:
            found.append({**_chapter(load_report(place), gaps), "current": place.name == current})
        except (UserError, ValueError) as error:
            gaps.append((place.name, "the whole report", str(error).replace(f"{folder}/", "")))
        except KeyError as error:
            gaps.append((place.name, "the whole report", f"its provenance.json lacks {error}: {OLDER}"))

    def later(c: dict[str, Any]) -> tuple[bool, bool, bool, bool]:
        return not c["current"], c["scale"] == "smoke", c["looked_at"] != "", c["source"] != "videos"

    return sorted(found, key=later)


def _chapter(report: Report, gaps: list[Gap]) -> dict[str, Any]:
    """What the template shows of one report."""
    name, said = report.name, report.provenance
    tasks, (effects, points) = _tasks(report), _effects(report)
    unasked = {*report.published["task"]} - {line["task"] for line in tasks}
    gaps += [(name, task_title(task), "the full system was not asked") for task in TASKS if task in unasked]
    gaps += [(name, file, OLDER) for file in EXPECTED if not (report.folder / file).is_file()]
    shipped, title, frame = {}, SHIPPED_TABLE.title, SHIPPED_TABLE.build(report)
    if len(frame):
        html = draw_table(frame, title, f"{name}/scores.csv")
        shipped = {"title": title, "caption": SHIPPED_TABLE.caption, "html": html}
    return {
        **sections(report),
        "report": report,
        "scale": said["scale"],
        "source": said["source"],
        "shipped": shipped,
        "tasks": tasks,
        "effects": effects,
        "points": points,
        "blocks": _blocks(report, gaps),
        "files": sorted(p.relative_to(report.folder).as_posix() for p in report.folder.rglob("*.*") if p.is_file()),
    }


def left_to_users(reports: Iterable[Report]) -> list[Gap]:
    """The entries of `BY_USER` that no report covers."""
    filmed = [r for r in reports if r.provenance["source"] == "videos"]
    known = {name for r in filmed for name in (r.name, *r.scores["task"])}
    known |= {f"{r.provenance['dataset']} {touch}" for r in filmed for touch in r.scores["touch"]}
    return [("paper", what, why) for name, what, why in BY_USER if name not in known]


def _line(row: dict[str, Any], file: str, index: int, said: str, note: str, **places: float) -> dict[str, Any]:
    """What the template draws of a row: dot, interval and chance, at `places` in percent of the line's width.

    A place that the row lacks is None. `index` is that of the row in its file.
    """
    found = {name: None if pd.isna(place) else round(float(place), 2) for name, place in places.items()}
    title = task_title(row["task"]).removesuffix(f" ({row['task']})")
    words = {"task": row["task"], "title": title, "source": f"{file}:{index + 2}", "said": said, "note": note}
    return {"chance": None, "published": {}, **words, **found}


def _tasks(report: Report) -> list[dict[str, Any]]:
    """The tasks that were asked, with the full system's accuracy on real touch over all seeds."""
    printed, rows, lines = cells(report.published), headline(report.scores), []
    for index, row in zip(rows.index, rows.to_dict("records"), strict=True):
        places = {name: 100 * row[name] for name in ("low", "high", "chance")}
        note, value = f"{row['right']:g} of {row['n']:g} right", 100 * row["accuracy"]
        line = _line(row, f"{report.name}/scores.csv", index, measured(row), note, value=value, **places)
        found = {model: printed.get((*(row[k] for k in KEYS), model)) for model in MODELS}
        line["published"] = {m: (f"{c[0]:.1f}", f"n {c[1]:.0f}", c[0]) for m, c in found.items() if c}
        lines.append(line)
    return lines


def _effects(report: Report) -> tuple[dict[str, list[dict[str, Any]]], float]:
    """The effects on whole answers by part, and half the width of their line in points: the next 25, at most 100."""
    rows = report.effects[whole(report.effects)]
    largest = 100 * rows[["difference", "low", "high"]].abs().max(axis=None) if len(rows) else 0.0
    points = min(100.0, 25.0 * max(1, math.ceil(largest / 25)))
    groups: dict[str, list[dict[str, Any]]] = {}
    for index, row in zip(rows.index, rows.to_dict("records"), strict=True):
        places = {
            n: 50 + 5000 * row[c] / points for n, c in (("value", "difference"), ("low", "low"), ("high", "high"))
        }
        line = _line(row, f"{report.name}/effects.csv", index, difference(row), number(row["p_holm"], 3), **places)
        part = PARTS.get(row["part"], row["part"])
        groups.setdefault(f"{part[:1].upper()}{part[1:]}: {row['change']}", []).append(line)
    return groups, points


def _blocks(report: Report, gaps: list[Gap]) -> list[dict[str, Any]]:
    """The registry's tables, then those about data and encoders; one of the registry without a row is a gap."""
    found = [(t.title, t.caption, t.build(report), f"{t.source}.csv", t.key) for t in TABLES]
    gaps += [
        (report.name, title, f"no row of its {file} belongs there: nothing such was run")
        for title, _, frame, file, _ in found
        if frame.empty
    ]
    for file, title, caption in BESIDE:
        if (report.folder / file).is_file():
            found.append((title, caption, _shown(pd.read_csv(report.folder / file)), file, Path(file).stem))
    for title, caption, frame, file in dataset_tables(report.folder, report.provenance["dataset"]):
        key = "audit" if title == "Data audit" else re.split("[:,]", title)[0].replace(" ", "-").lower()
        found.append((title, caption, frame, file, key))
    smoke = report.provenance["scale"] == "smoke"
    unfolded = {table.key for table in TABLES if not (table.folded or smoke)}
    return [
        {
            "key": f"{report.name}-{key}",
            "title": title,
            "caption": caption,
            "file": f"{report.name}/{file}",
            "open": key in unfolded,
            # A row of the audit's table stands for many lines of the file.
            "html": draw_table(frame, title, f"{report.name}/{file}", at_lines=key != "audit"),
        }
        for title, caption, frame, file, key in found
        if len(frame)
    ]


def _speed(folder: Path, gaps: list[Gap]) -> Iterator[dict[str, Any]]:
    """Each question of speed_error.csv: its figure, as `make bench` drew it, its front in words, its table."""
    rows = _measured(folder / "speed_error.csv", SPEED, "make bench", gaps)
    rows["front"] = rows["front"].astype(str).eq("True")
    for question, group in rows.groupby("question", sort=False):
        figure = f"speed_error/{re.sub(r'[^a-z0-9]+', '-', str(question).lower()).strip('-')}.png"
        shown = group.drop(columns="question").assign(front=group["front"].where(group["error"].notna()))
        yield {
            "question": question,
            "costs": "; ".join(group["unit"].dropna().unique()),
            "errors": "; ".join(group["error_of"].dropna().unique()),
            "figure": figure if (folder / figure).is_file() else "",
            "front": group[group["front"]].sort_values("cost_ratio").map(_cell_text).to_dict("records"),
            "html": draw_table(_shown(shown), str(question), "speed_error.csv"),
        }


def _stability(folder: Path, gaps: list[Gap]) -> dict[str, Any]:
    """How many cases passed by part and number format, and the cases that failed."""
    rows = _measured(folder / "stability.csv", STABILITY, "make stability", gaps)
    if rows.empty:
        return {"cases": 0}
    failed = rows[rows["verdict"].ne("pass")]
    groups = rows.assign(passed=rows["verdict"].eq("pass")).groupby(["part", "format"])["passed"]
    counts = (groups.sum().astype(str) + "/" + groups.size().astype(str)).unstack(fill_value="")
    counts.insert(0, "Part", counts.index)
    return {
        "cases": len(rows),
        "failed": len(failed),
        "failures": draw_table(_shown(failed), "Cases that failed", "stability.csv") if len(failed) else "",
        "table": draw_table(counts, "Cases that passed, by part and number format", "stability.csv", at_lines=False),
    }


def _measured(file: Path, columns: tuple[str, ...], command: str, gaps: list[Gap]) -> pd.DataFrame:
    """The rows of a file of reports/; where it has none or is broken, that is a gap."""
    try:
        rows, why = read_frame(file, columns), f"nothing was measured yet: `{command}` measures it"
    except UserError as error:
        rows, why = pd.DataFrame(columns=list(columns)), str(error)
    if rows.empty:
        gaps.append((file.stem.partition("_")[0], file.name, why))
    return rows


def _shown(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of a CSV as text, without empty columns."""
    rows = rows.dropna(axis="columns", how="all").map(_cell_text)
    return rows.rename(columns=lambda name: name.replace("_", " ").capitalize())


def _cell_text(value: Any) -> str:
    """A cell of a CSV in words: four digits of a fraction, nothing for what is missing."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if pd.isna(value) else f"{value:,.4g}"
    return str(value)
