"""One page over all reports: reports/index.html, drawn from the files in reports/ and from nothing else.

It needs no network, runs no script and opens from disk. Its tables are those of the registry
(`pipeline.report.tables`), as in each README; this module adds what stands around them: all reports side by side, speed
against error, numerical stability, and what is missing.
"""

from __future__ import annotations

import base64
import hashlib
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
from pipeline.report.load import Report, load_report, read_frame
from pipeline.report.readme import OTHER_MODELS, sections
from pipeline.report.render import draw_table, render
from pipeline.report.tables import FIVE_TASKS, SHIPPED_TABLE, TABLES, Table, side_by_side

PAGE = Path("reports/index.html")
LARGEST = 1_500_000
"""Bytes of the page at most, so that it opens at once on a phone."""
SPEED = ("question", "setting", "cost", "unit", "cost_ratio", "error", "error_of", "low", "high", "front")
STABILITY = ("part", "case", "format", "finite", "error", "bound", "verdict")
UNFOLDED = {table.key for table in TABLES if not table.folded}
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
            paper.append(draw_table(frame, title))
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
            gaps.append((place.name, "the whole report", f"its provenance.json lacks {error}; write it anew"))

    def later(c: dict[str, Any]) -> tuple[bool, bool, bool, bool]:
        return not c["current"], c["scale"] == "smoke", c["looked_at"] != "", c["source"] != "videos"

    return sorted(found, key=later)


def _chapter(report: Report, gaps: list[Gap]) -> dict[str, Any]:
    """What the template shows of one report."""
    return {
        **sections(report),
        "report": report,
        "scale": report.provenance["scale"],
        "source": report.provenance["source"],
        "shipped": _table(report, SHIPPED_TABLE),
        "tasks": _table(report, FIVE_TASKS),
        "blocks": _blocks(report, gaps),
        "figures": sorted((report.folder / "figures").glob("*.png")),
        "files": sorted(p.relative_to(report.folder).as_posix() for p in report.folder.rglob("*.*") if p.is_file()),
    }


def left_to_users(reports: Iterable[Report]) -> list[Gap]:
    """The entries of `BY_USER` that no report covers."""
    filmed = [r for r in reports if r.provenance["source"] == "videos"]
    known = {name for r in filmed for name in (r.name, *r.scores["task"])}
    known |= {f"{r.provenance['dataset']} {touch}" for r in filmed for touch in r.scores["touch"]}
    return [("paper", what, why) for name, what, why in BY_USER if name not in known]


def _table(report: Report, table: Table) -> dict[str, Any]:
    """One of the registry's tables; empty where it has no row."""
    return _block(report, table.key, table.title, table.caption, table.build(report), f"{table.source}.csv")


def _block(report: Report, key: str, title: str, caption: str, frame: pd.DataFrame, file: str) -> dict[str, Any]:
    """A table as the template shows it; empty where it has no row."""
    source = f"{report.name}/{file}"
    # A row of the audit's table stands for many lines of the file.
    html = draw_table(frame, title, "" if key == "audit" else source)
    shown = key in UNFOLDED and report.provenance["scale"] != "smoke"
    block = {"key": key, "title": title, "caption": caption, "file": source, "open": shown, "html": html}
    return block if len(frame) else {}


def _blocks(report: Report, gaps: list[Gap]) -> list[dict[str, Any]]:
    """The registry's tables, then those about data and encoders; one of the registry without a row is a gap."""
    found = [_table(report, table) for table in TABLES]
    gaps += [
        (report.name, table.title, f"no row of its {table.source}.csv belongs there: nothing such was run")
        for table, block in zip(TABLES, found, strict=True)
        if not block
    ]
    for file, title, caption in BESIDE:
        if (report.folder / file).is_file():
            frame = _shown(pd.read_csv(report.folder / file))
            found.append(_block(report, Path(file).stem, title, caption, frame, file))
    found += [_block(report, *told) for told in dataset_tables(report.folder, report.provenance["dataset"])]
    return [block for block in found if block]


def _speed(folder: Path, gaps: list[Gap]) -> Iterator[dict[str, Any]]:
    """Each question of speed_error.csv: its figure, as `make bench` drew it, and its table."""
    for question, group in _measured(folder / "speed_error.csv", SPEED, gaps).groupby("question", sort=False):
        figure = f"speed_error/{re.sub(r'[^a-z0-9]+', '-', str(question).lower()).strip('-')}.png"
        yield {
            "question": question,
            "costs": "; ".join(group["unit"].dropna().unique()),
            "errors": "; ".join(group["error_of"].dropna().unique()),
            "figure": figure if (folder / figure).is_file() else "",
            "html": draw_table(_shown(group.drop(columns="question")), str(question), "speed_error.csv"),
        }


def _stability(folder: Path, gaps: list[Gap]) -> dict[str, Any]:
    """How many cases were run, and those that failed."""
    rows = _measured(folder / "stability.csv", STABILITY, gaps)
    failed = rows[rows["verdict"].ne("pass")]
    table = draw_table(_shown(failed), "Cases that failed", "stability.csv") if len(failed) else ""
    return {"cases": len(rows), "failed": len(failed), "table": table}


def _measured(file: Path, columns: tuple[str, ...], gaps: list[Gap]) -> pd.DataFrame:
    """The rows of a file of reports/, none where there is no such file; a broken one is a gap."""
    try:
        return read_frame(file, columns)
    except UserError as error:
        gaps.append((file.stem.partition("_")[0], file.name, str(error)))
        return pd.DataFrame(columns=list(columns))


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
