"""One page over all reports: reports/index.html, drawn from the files in reports/ and from nothing else.

It needs no network, runs no script and opens from disk. What it says of a report is what its README says, with all of
its tables; this module adds what stands around them: all reports side by side, speed against error, numerical
stability, and what is missing.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import UndefinedError
from markupsafe import Markup

from pipeline.config.params import PARAMS_FILE, load_params
from pipeline.core.io import write_text
from pipeline.report.load import Report, load_report, published, read_frame
from pipeline.report.readme import sections
from pipeline.report.render import WORDS, Block, render
from pipeline.report.tables import TABLES, side_by_side
from pipeline.running.errors import UserError

PAGE = Path("reports/index.html")
LARGEST = 1_500_000
"""Bytes of the page at most, so that it opens at once on a phone."""
SPEED = ("question", "setting", "cost", "unit", "cost_ratio", "error", "error_of", "low", "high", "front")
STABILITY = ("part", "case", "format", "finite", "error", "bound", "verdict")
AUDIT = ("check", "item", "measured", "expected", "severity")
Gap = tuple[str, str, str]
"""Where something is missing, what, and why."""


def write_page(root: Path) -> Path:
    """Write the page over all reports below `root`; equal files give an equal page.

    Raises:
        UserError: there is no report, or the page would be larger than `LARGEST`.
    """
    folder, gaps, chapters = root / PAGE.parent, list[Gap](), list[dict[str, Any]]()
    current = load_params(root / PARAMS_FILE).report_name if (root / PARAMS_FILE).is_file() else ""
    for place in sorted({file.parent for name in ("scores.csv", "README.md") for file in folder.glob(f"*/{name}")}):
        try:
            chapters.append({**_chapter(load_report(place), gaps), "current": place.name == current})
        except (UserError, ValueError) as error:
            gaps.append((place.name, "the whole report", str(error).replace(f"{folder}/", "")))
        except (KeyError, UndefinedError) as error:
            gaps.append((place.name, "the whole report", f"its provenance.json lacks {error}; write it anew"))
    if not chapters:
        raise UserError(f"{folder}: no whole report yet; `make repro` writes one")
    # The current report, then real videos, scenes, smoke.
    chapters.sort(key=lambda c: (not c["current"], c["scale"] == "smoke", c["source"] != "videos"))
    gaps += left_to_users([c["report"] for c in chapters])
    # What random models answer is chance, and nothing to hold against the paper.
    reports = {c["name"]: c["report"] for c in chapters if not c["plumbing"]}
    stability = _measured(folder / "stability.csv", STABILITY, gaps)
    style = " ".join(render("style.css").split())
    text = render(
        "page.html",
        style=Markup(style),
        digest=base64.b64encode(hashlib.sha256(style.encode()).digest()).decode(),
        chapters=chapters,
        paper=[side_by_side(reports, every=every) for every in (False, True)] if reports else [],
        other_models=WORDS["other_models"],
        speed=list(_speed(folder, gaps)),
        cases=len(stability),
        failed=_shown(stability[stability["verdict"] != "pass"]),
        gaps=gaps,
    )
    text = re.sub(r"\n\s*", "\n", text)
    if len(text.encode()) > LARGEST:
        raise UserError(f"{root / PAGE}: would have {len(text.encode())} bytes, over {LARGEST}; remove an old report")
    write_text(root / PAGE, text)
    return root / PAGE


def _chapter(report: Report, gaps: list[Gap]) -> dict[str, Any]:
    """What the template shows of one report; a table of the registry without a row is a gap."""
    told, folder, scale = sections(report), report.folder, report.provenance["scale"]
    known = {block.key for block in told["tables"]}
    gaps += [
        (folder.name, table.title, f"no row of its {table.source}.csv belongs there: nothing such was run")
        for table in TABLES
        if table.key not in known
    ]
    return {
        **told,
        "tables": [*told["tables"], *data_tables(folder, report.provenance["dataset"])],
        "report": report,
        "scale": scale,
        "source": report.provenance["source"],
        "figures": sorted((folder / "figures").glob("*.png")),
        "files": sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*.*") if p.is_file()),
    }


def data_tables(folder: Path, dataset: str) -> Iterator[Block]:
    """The tables about encoders and data, of those of a report's files that are there and have rows."""
    if (file := folder / "calibration.csv").is_file() and len(frame := pd.read_csv(file)):
        caption = "Expected calibration error on test videos; the temperature is fitted on validation objects."
        yield Block("calibration", "Calibration of the heads' probabilities", caption, _shown(frame), file.name)
    if (folder / "dataset.csv").is_file():
        frame = pd.read_csv(folder / "dataset.csv", dtype=str).fillna("")
        for key, rows in frame.groupby("table", sort=False):
            shown = rows.drop(columns="table").loc[:, lambda f: (f != "").any()]
            shown = _named(shown).rename(columns={"Row": ""})
            yield Block(str(key), WORDS["dataset"][str(key)], "", shown, "dataset.csv")
    audit = read_frame(folder / "audit.csv", AUDIT)
    audit["measured"] = audit["measured"].astype(str)
    rows = audit[audit["check"] == "agreement, ICC(3,k)"]
    if len(rows):
        printed = published(dataset).query("task == 'annotator_agreement'").set_index("measure")["value"]
        shown = pd.DataFrame({"": rows["item"], "Measured": rows["measured"]})
        if len(printed):
            shown["Published"] = rows["item"].map(printed.map("{:.3f}".format))
        title = "Annotator agreement, ICC(3,k) with its 95 % interval"
        said = "Above 0.75 it counts as good or excellent, as the paper says."
        yield Block("annotator_agreement", title, said, shown, "audit.csv")
    if len(audit):
        # Counted by check, with what needs attention first.
        rank = {"error": 0, "warning": 1, "info": 2}
        audit = audit.sort_values("severity", key=lambda s: s.map(rank).fillna(3), kind="stable")
        checks = (audit["item"] + ": " + audit["measured"]).groupby([audit["severity"], audit["check"]], sort=False)
        columns = {"Findings": checks.size().astype(str), "The first of them": checks.first()}
        counts = ", ".join(f"{n} {severity}" for severity, n in audit["severity"].value_counts(sort=False).items())
        shown = _named(pd.DataFrame(columns).reset_index())
        yield Block("audit", "Data audit", f"{counts}; counted by check.", shown, "audit.csv")


def left_to_users(reports: Iterable[Report]) -> list[Gap]:
    """What only users can measure and no report covers, of `by_user` in words.yaml."""
    filmed = [r for r in reports if r.provenance["source"] == "videos"]
    known = {name for r in filmed for name in (r.folder.name, *r.scores["task"])}
    known |= {f"{r.provenance['dataset']} {touch}" for r in filmed for touch in r.scores["touch"]}
    return [("paper", what, why) for name, what, why in WORDS["by_user"] if name not in known]


def _speed(folder: Path, gaps: list[Gap]) -> Iterator[dict[str, Any]]:
    """Each question of speed_error.csv: its figure, as `make bench` drew it, and its table."""
    for question, group in _measured(folder / "speed_error.csv", SPEED, gaps).groupby("question", sort=False):
        figure = f"speed_error/{re.sub(r'[^a-z0-9]+', '-', str(question).lower()).strip('-')}.png"
        yield {
            "question": question,
            "costs": "; ".join(group["unit"].dropna().unique()),
            "errors": "; ".join(group["error_of"].dropna().unique()),
            "figure": figure if (folder / figure).is_file() else "",
            "frame": _shown(group.drop(columns="question")),
        }


def _measured(file: Path, columns: tuple[str, ...], gaps: list[Gap]) -> pd.DataFrame:
    """The rows of a file of reports/, none where there is no such file; a broken one is a gap."""
    try:
        return read_frame(file, columns)
    except UserError as error:
        gaps.append((file.stem.partition("_")[0], file.name, str(error)))
        return pd.DataFrame(columns=list(columns))


def _shown(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of a CSV as text, without empty columns: four digits of a fraction, nothing for what is missing."""

    def text(value: object) -> str:
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, float):
            return "" if pd.isna(value) else f"{value:,.4g}"
        return str(value)

    return _named(rows.dropna(axis="columns", how="all").map(text))


def _named(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.rename(columns=lambda name: name.replace("_", " ").capitalize())
