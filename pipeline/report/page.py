"""One page over all reports: reports/index.html, drawn from the files in reports/ and from nothing else.

It needs no network, runs no script and opens from disk. Its tables are those of the registry
(`pipeline.report.tables`); this module adds what stands around them: all reports side by side, the tasks and effects
as lines, speed against error, numerical stability, and what is missing.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from pipeline.config.params import PARAMS_FILE, load_params
from pipeline.core.errors import UserError
from pipeline.core.io import write_text
from pipeline.report.dataset import dataset_tables
from pipeline.report.drawing import draw_table, share, span
from pipeline.report.load import KEYS, Report, cells, load_report, read_frame
from pipeline.report.readme import OTHER_MODELS, PLUMBING, at_random, finding, looked_at, origin, stands_on
from pipeline.report.tables import (
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
FACTORS = {"language": "Language model", "encoder": "Encoder", "lora": "LoRA", "opd": "OPD", "touch": "Touch"}
RANK = {"error": 0, "warning": 1, "info": 2}
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


class Line(NamedTuple):
    """A figure with its interval, drawn on a line; places are percent of that line's width."""

    task: str
    title: str
    source: str
    """File and line that it comes from."""
    said: str
    note: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    chance: float | None = None
    published: dict[str, tuple[str, str, float]] = {}  # noqa: RUF012
    """By size of its model what the paper printed, of how many questions, and its place."""


class Block(NamedTuple):
    """A table under its heading."""

    key: str
    title: str
    caption: str
    html: Markup
    file: str
    """Below reports/."""
    open: bool = False


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
    environment = Environment(
        loader=PackageLoader("pipeline.report"), autoescape=True, trim_blocks=True, undefined=StrictUndefined
    )
    environment.filters["inline"] = inline
    style = " ".join(environment.get_template("style.css").render().split())
    text = environment.get_template("page.html").render(
        style=Markup(style),
        digest=base64.b64encode(hashlib.sha256(style.encode()).digest()).decode(),
        chapters=chapters,
        paper=[_paper(reports, every=every) for every in (False, True)],
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


def inline(text: str, folder: str = "") -> Markup:
    """A sentence of a README: its bold words, code and links, relative to a folder, as HTML; all else as it is."""
    html = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text)))
    html = re.sub(r"\*(\w[^*]*)\*", r"<em>\1</em>", html)
    html = re.sub(r"`(.+?)`", r"<code>\1</code>", html)
    return Markup(re.sub(r"\[([^]]+)\]\(([\w./-]+)\)", rf'<a href="{escape(folder)}\2">\1</a>', html))


def _chapters(folder: Path, gaps: list[Gap], current: str) -> list[dict[str, Any]]:
    """The current report, then real videos, scenes, looked-at test objects, smoke; a broken report is a gap."""
    found: list[dict[str, Any]] = []
    for place in sorted({file.parent for name in ("scores.csv", "README.md") for file in folder.glob(f"*/{name}")}):
        try:
            found.append(_chapter(load_report(place), gaps))
        except (UserError, ValueError) as error:
            gaps.append((place.name, "the whole report", str(error).replace(f"{folder}/", "")))
        except KeyError as error:
            gaps.append((place.name, "the whole report", f"its provenance.json lacks {error}: {OLDER}"))
    for chapter in found:
        chapter["current"] = chapter["name"] == current

    def order(chapter: dict[str, Any]) -> tuple[bool, bool, bool, bool, str]:
        smoke, filmed = chapter["scale"] == "smoke", chapter["source"] == "videos"
        return not chapter["current"], smoke, bool(chapter["looked_at"]), not filmed, str(chapter["name"])

    return sorted(found, key=order)


def _chapter(report: Report, gaps: list[Gap]) -> dict[str, Any]:
    """What the template shows of one report."""
    name, scale, source = report.name, report.provenance["scale"], report.provenance["source"]
    tasks, (effects, points) = list(_tasks(report)), _effects(report)
    asked = {line.task for line in tasks}
    printed = [task for task in TASKS if task in {*report.published["task"]} - asked]
    gaps += [(name, task_title(task), "the full system was not asked") for task in printed]
    gaps += [(name, file, why) for file, why in EXPECTED.items() if not (report.folder / file).is_file()]
    files = sorted(p.relative_to(report.folder.parent).as_posix() for p in report.folder.rglob("*.*") if p.is_file())
    return {
        "report": report,
        "name": name,
        "scale": scale,
        "source": source,
        "finding": finding(report),
        "shipped": _shipped(report),
        "plumbing": PLUMBING if at_random(report.provenance) else "",
        "looked_at": report.provenance["settings"] if looked_at(report.provenance) else "",
        "tasks": tasks,
        "effects": effects,
        "points": points,
        "stands_on": stands_on(report.provenance),
        "origin": origin(report.provenance),
        "blocks": list(_tables(report, scale != "smoke", gaps)),
        "samples": report.samples,
        "examples": report.samples.get("examples", []),
        "not_asked": _not_asked(report.samples),
        "files": files,
    }


def _shipped(report: Report) -> list[Any]:
    """Heading, caption and table of the shipped model's answers, where it was asked."""
    shown = SHIPPED_TABLE.build(report.scores, report.effects, report.published)
    if not len(shown):
        return []
    table = draw_table(shown, SHIPPED_TABLE.title, f"{report.name}/scores.csv")
    return [SHIPPED_TABLE.title, SHIPPED_TABLE.caption, table]


def left_to_users(reports: Iterable[Report]) -> list[Gap]:
    """What of `BY_USER` no report has."""
    filmed = [r for r in reports if r.provenance["source"] == "videos"]
    known = {name for r in filmed for name in (r.name, *r.scores["task"])}
    known |= {f"{r.provenance['dataset']} {touch}" for r in filmed for touch in r.scores["touch"]}
    return [("paper", what, why) for name, what, why in BY_USER if name not in known]


def _paper(reports: dict[str, Report], *, every: bool) -> Markup:
    if not reports:
        return Markup()
    frame, title = side_by_side(reports, every=every), f"{'Every row' if every else 'Five tasks'} of the paper"
    return draw_table(frame, title, "*/scores.csv", at_lines=False) if len(frame) else Markup()


def _not_asked(samples: dict[str, Any]) -> str:
    if "not_asked" not in samples:
        return "Not asked: the report is older than these questions."
    rest = [f"{name} (of {' and '.join(objects)})" for name, objects in samples["not_asked"].items()]
    return f"Not asked, for want of videos: {', '.join(rest)}." if rest else ""


def _tasks(report: Report) -> Iterator[Line]:
    """The tasks that were asked, with the full system's accuracy on real touch over all seeds."""
    printed, rows = cells(report.published), headline(report.scores)
    for index, row in zip(rows.index, rows.to_dict("records"), strict=True):
        found = {model: printed.get((*(row[k] for k in KEYS), model)) for model in MODELS}
        yield Line(
            row["task"],
            task_title(row["task"]).removesuffix(f" ({row['task']})"),
            f"{report.name}/scores.csv:{index + 2}",
            measured(row),
            f"{row['right']:g} of {row['n']:g} right",
            share(row["accuracy"]),
            share(row["low"]),
            share(row["high"]),
            share(row["chance"]),
            {m: (f"{c[0]:.1f}", f"n {c[1]:.0f}", c[0]) for m, c in found.items() if c},
        )


def _effects(report: Report) -> tuple[dict[str, list[Line]], float]:
    """The effects on whole answers by part, and half the width of their line in points."""
    rows = report.effects[whole(report.effects)]
    points = span(100 * rows[["difference", "low", "high"]].abs().max(axis=None)) if len(rows) else 0.0
    groups: dict[str, list[Line]] = {}
    for index, row in zip(rows.index, rows.to_dict("records"), strict=True):
        value, low, high = (share(0.5 + 50 * row[name] / points) for name in ("difference", "low", "high"))
        source = f"{report.name}/effects.csv:{index + 2}"
        p = number(row["p_holm"], 3)
        line = Line(row["task"], task_title(row["task"]), source, difference(row), p, value, low, high)
        groups.setdefault(f"{FACTORS.get(row['part'], row['part'])}: {row['change']}", []).append(line)
    return groups, points


def _tables(report: Report, unfold: bool, gaps: list[Gap]) -> Iterator[Block]:
    """The registry's tables, then those about data and encoders; one of the registry without a row is a gap."""
    for table in TABLES:
        file, frame = f"{table.source}.csv", table.build(report.scores, report.effects, report.published)
        if len(frame):
            shown = unfold and not table.folded
            yield _block(report, table.key, table.title, table.caption, frame, file)._replace(open=shown)
        else:
            gaps.append((report.name, table.title, f"no row of its {file} belongs there: nothing such was run"))
    for name, title, caption in BESIDE:
        path = report.folder / name
        if path.is_file() and len(frame := _shown(pd.read_csv(path))):
            yield _block(report, path.stem, title, caption, frame, name)
    for title, frame in dataset_tables(report.folder, report.provenance["dataset"]).items():
        file = "audit.csv" if "Measured" in frame else "dataset.csv"
        yield _block(report, re.split("[:,]", title)[0].replace(" ", "-").lower(), title, "", frame, file)
    audit = read_frame(report.folder / "audit.csv", AUDIT)
    if len(audit):
        yield _audit(report, audit.sort_values("severity", key=lambda s: s.map(RANK).fillna(3), kind="stable"))


def _audit(report: Report, audit: pd.DataFrame) -> Block:
    """The audit's findings, counted by check; what needs attention first."""
    groups = audit.groupby(["severity", "check"], sort=False)
    first = groups.first()
    cells = {
        "Findings": groups.size().astype(str),
        "The first of them": first["item"] + ": " + first["measured"].astype(str),
    }
    frame = pd.DataFrame(cells).reset_index().rename(columns=str.capitalize)
    caption = ", ".join(f"{n} {severity}" for severity, n in audit["severity"].value_counts(sort=False).items())
    return _block(report, "audit", "Data audit", f"{caption}; counted by check.", frame, "audit.csv", at_lines=False)


def _block(
    report: Report, key: str, title: str, caption: str, frame: pd.DataFrame, file: str, at_lines: bool = True
) -> Block:
    file = f"{report.name}/{file}"
    return Block(f"{report.name}-{key}", title, caption, draw_table(frame, title, file, at_lines), file)


def _speed(folder: Path, gaps: list[Gap]) -> Iterator[dict[str, Any]]:
    """Each question of speed_error.csv: its figure, as `make bench` drew it, its front in words, its table."""
    rows = _measured(folder / "speed_error.csv", SPEED, gaps)
    if rows.empty:
        gaps.append(("speed", "speed_error.csv", "nothing was measured yet: `make bench` measures it"))
    rows["front"] = rows["front"].astype(str).eq("True")
    for question, group in rows.groupby("question", sort=False):
        figure = f"speed_error/{re.sub(r'[^a-z0-9]+', '-', str(question).lower()).strip('-')}.png"
        shown = group.drop(columns="question").assign(front=group["front"].where(group["error"].notna()))
        yield {
            "question": question,
            "costs": "; ".join(group["unit"].dropna().unique()),
            "errors": "; ".join(group["error_of"].dropna().unique()),
            "figure": figure if (folder / figure).is_file() else "",
            "front": group[group["front"]].sort_values("cost_ratio").map(_said).to_dict("records"),
            "html": draw_table(_shown(shown), str(question), "speed_error.csv"),
        }


def _stability(folder: Path, gaps: list[Gap]) -> dict[str, Any]:
    """How many cases passed by part and number format, and the cases that failed."""
    rows = _measured(folder / "stability.csv", STABILITY, gaps)
    if rows.empty:
        gaps.append(("stability", "stability.csv", "nothing was measured yet: `make stability` measures it"))
        return {"cases": 0}
    failed = rows[rows["verdict"].ne("pass")]
    groups = rows.assign(passed=rows["verdict"].eq("pass")).groupby(["part", "format"])["passed"]
    cells = (groups.sum().astype(str) + "/" + groups.size().astype(str)).unstack(fill_value="")
    cells.insert(0, "Part", cells.index)
    return {
        "cases": len(rows),
        "failed": len(failed),
        "failures": draw_table(_shown(failed), "Cases that failed", "stability.csv") if len(failed) else "",
        "table": draw_table(cells, "Cases that passed, by part and number format", "stability.csv", at_lines=False),
    }


def _measured(file: Path, columns: tuple[str, ...], gaps: list[Gap]) -> pd.DataFrame:
    try:
        return read_frame(file, columns)
    except UserError as error:
        gaps.append((file.stem, file.name, str(error)))
        return pd.DataFrame(columns=list(columns))


def _shown(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of a CSV as text, without empty columns."""
    rows = rows.dropna(axis="columns", how="all").map(_said)
    return rows.rename(columns=lambda name: name.replace("_", " ").capitalize())


def _said(value: Any) -> str:
    """A cell of a CSV in words: four digits of a fraction, nothing for what is missing."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if pd.isna(value) else f"{value:,.4g}"
    return str(value)
