"""One page over all reports: reports/index.html, drawn from the files in reports/ and from nothing else.

It needs no network, runs no script and opens from disk. Tables come from the registry (`pipeline.report.tables`); this
module adds what stands around them: the five tasks at a glance, the effects, speed against error, numerical stability,
and what is missing.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from pipeline.errors import UserError
from pipeline.io import write_text
from pipeline.report import drawing
from pipeline.report.load import ALL_SEEDS, Report, load_report, read_frame
from pipeline.report.readme import finding
from pipeline.report.tables import CHOICE, COMBINED, CROSS_VALIDATION, FULL, HEADS, TABLES, difference, measured
from pipeline.report.tables import task_title as title
from pipeline.tasks import TASKS

PAGE = Path("reports/index.html")
LARGEST = 1_500_000
"""Bytes of the page at most, so that it opens at once on a phone."""
MODELS = ("7b", "13b")
SPEED = ("question", "setting", "cost", "cost_ratio", "error", "low", "high", "front")
STABILITY = ("part", "case", "format", "finite", "error", "bound", "verdict")
AUDIT = ("check", "item", "measured", "expected", "severity")
EXPECTED = {
    "effects.csv": "no two of its variants differ in one part alone, or it is older than this file",
    "audit.csv": "it is older than this file: `dvc repro report` writes it",
    "samples.json": "it is older than this file: `dvc repro report` writes it",
    "curves.csv": "its trainings' histories were not kept",
    "confusion.csv": "it is older than this file: `dvc repro report` writes it",
    "params.yaml": "it is older than this file: `dvc repro report` writes it",
}
"""Files of a report, and why one may lack."""


class Row(NamedTuple):
    """One task at a glance; places are percent of a line from 0 to 100."""

    title: str
    source: str
    """File and line that the measured figure comes from; empty where nothing was measured."""
    said: str = ""
    counted: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    chance: float | None = None
    published: tuple[tuple[str, str, float], ...] = ()
    """Model, value as printed with its number of questions, place."""


class Effect(NamedTuple):
    """One difference of the figure of effects; places are percent of its line, whose middle is no difference."""

    title: str
    source: str
    said: str
    p: str
    value: float
    low: float | None
    high: float | None


class Block(NamedTuple):
    """A table under its heading."""

    key: str
    title: str
    caption: str
    html: Markup
    open: bool
    file: str


class Chapter(NamedTuple):
    """One report."""

    report: Report
    kind: str
    finding: Sequence[str]
    glance: list[Row]
    effects: list[tuple[str, list[Effect]]]
    points: float
    """Half the width of the figure of effects, in points."""
    blocks: list[Block]
    audit: dict[str, int]
    facts: list[tuple[str, str]]
    files: list[str]


class Gap(NamedTuple):
    """Something that is missing."""

    where: str
    what: str
    why: str


def write_page(root: Path) -> Path:
    """Write the page over all reports below `root`; equal files give an equal page.

    Raises:
        UserError: there is no report, or the page would be larger than `LARGEST`.
    """
    reports = root / PAGE.parent
    gaps: list[Gap] = []
    found = _reports(reports, gaps)
    if not found:
        raise UserError(f"{reports}: no report yet; `make repro` writes one")
    environment = Environment(
        loader=PackageLoader("pipeline.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    style = " ".join(environment.get_template("style.css").render().split())
    text = environment.get_template("page.html").render(
        style=Markup(style),
        digest=base64.b64encode(hashlib.sha256(style.encode()).digest()).decode(),
        chapters=[_chapter(report, gaps) for report in found],
        speed=_speed(reports, gaps),
        stability=_stability(reports, gaps),
        gaps=gaps,
        width=drawing.WIDTH,
        height=drawing.HEIGHT,
        left=drawing.LEFT,
        bottom=drawing.HEIGHT - drawing.BOTTOM,
    )
    text = re.sub(r"\n\s*", "\n", text)
    if len(text.encode()) > LARGEST:
        raise UserError(f"{root / PAGE}: would have {len(text.encode())} bytes, over {LARGEST}; fold tables into CSV")
    write_text(root / PAGE, text)
    return root / PAGE


def _reports(folder: Path, gaps: list[Gap]) -> list[Report]:
    """Real videos first, then scenes, smoke last; a folder that is no whole report is a gap."""
    found = []
    for file in sorted({*folder.glob("*/provenance.json"), *folder.glob("*/scores.csv")}, key=lambda f: f.parent.name):
        if file.name == "scores.csv" and file.with_name("provenance.json").is_file():
            continue
        try:
            found.append(load_report(file.parent))
        except (UserError, ValueError) as error:
            gaps.append(Gap(file.parent.name, "the whole report", str(error).replace(f"{folder}/", "")))
    return sorted(found, key=lambda r: (_kind(r)[0] == "smoke", _kind(r)[1] != "videos", r.name))


def _kind(report: Report) -> tuple[str, str]:
    """Scale and source."""
    scale, _, source = report.name.partition("-")
    return str(report.provenance.get("scale", scale)), str(report.provenance.get("source", source))


def _chapter(report: Report, gaps: list[Gap]) -> Chapter:
    scale, source = _kind(report)
    blocks = []
    for table in TABLES:
        frame = table.build(report.scores, report.effects, report.published)
        if frame.empty:
            gaps.append(Gap(report.name, table.title, "no row of its scores belongs to it: no such variant was run"))
            continue
        file = f"{report.name}/{table.source}.csv"
        lines = [f"{file}:{index + 2}" for index in table.select(report.scores, report.effects).index]
        html = draw(frame, table.title, lines)
        is_open = not table.folded and scale != "smoke"
        blocks.append(Block(f"{report.name}-{table.key}", table.title, table.caption, html, is_open, file))
    audit = _csv(report.folder / "audit.csv", AUDIT)
    if len(audit):
        blocks.append(_audit(report, audit))
    files = sorted(p.relative_to(report.folder.parent).as_posix() for p in report.folder.rglob("*.*") if p.is_file())
    gaps += [
        Gap(report.name, name, why) for name, why in EXPECTED.items() if not (report.folder / name).is_file()
    ]
    glance = list(_glance(report))
    gaps += [Gap(report.name, row.title, "the full system was not asked") for row in glance if not row.source]
    effects, points = _effects(report)
    return Chapter(
        report=report,
        kind=f"{'Real videos' if source == 'videos' else 'Synthetic scenes'}, scale {scale}",
        finding=finding(report),
        glance=glance,
        effects=effects,
        points=points,
        blocks=blocks,
        audit={str(name): int(n) for name, n in sorted(audit["severity"].value_counts().items())},
        facts=list(_facts(report.provenance)),
        files=files,
    )


def _glance(report: Report) -> Iterator[Row]:
    """Every task with the full system's accuracy on real touch over all seeds."""
    scores = report.scores
    full = scores["touch"].eq("real") & scores["seed"].eq(ALL_SEEDS) & scores["measure"].isin([CHOICE, COMBINED])
    for axis, value in FULL.items():
        full &= scores[axis].eq(value)
    rows = scores[full & ~scores["task"].isin([HEADS, CROSS_VALIDATION])]
    for task in dict.fromkeys([*map(str, TASKS), *rows["task"]]):
        found = rows[rows["task"] == task]
        if found.empty:
            yield Row(title(task), "")
            continue
        line, row = int(found.index[0]) + 2, found.iloc[0].to_dict()
        yield Row(
            title(task),
            f"{report.name}/scores.csv:{line}",
            measured(row),
            f"{row['right']:g} of {row['n']:g} right",
            *(drawing.percent(row[name]) for name in ("accuracy", "low", "high", "chance")),
            published=_published(report.published, row),
        )


def _published(cells: pd.DataFrame, row: dict[str, Any]) -> tuple[tuple[str, str, float], ...]:
    """What the paper printed for the task, of each size of its model."""
    same = cells[cells["task"].eq(row["task"]) & cells["measure"].eq(row["measure"])]
    for axis, value in FULL.items():
        same = same[same[axis].eq(value)]
    found = {cell["model"]: cell for cell in same.to_dict("records")}
    return tuple((m, f"{c['value']:.1f} (n {c['n']:.0f})", c["value"]) for m in MODELS if (c := found.get(m)))


def _effects(report: Report) -> tuple[list[tuple[str, list[Effect]]], float]:
    """The effects on whole answers by part, and half the width of their axis in points."""
    rows = report.effects[report.effects["measure"].isin([CHOICE, COMBINED])]
    if rows.empty:
        return [], 0.0
    points = drawing.span(100 * float(rows[["difference", "low", "high"]].abs().max(axis=None)))
    groups: dict[str, list[Effect]] = {}
    for index, row in zip(rows.index, rows.to_dict("records"), strict=True):
        ends = (None if pd.isna(row[k]) else round(50 + 5000 * row[k] / points, 2) for k in ("difference", "low", "high"))
        p = "" if pd.isna(row["p_holm"]) else f"{row['p_holm']:.3f}"
        effect = Effect(title(row["task"]), f"{report.name}/effects.csv:{index + 2}", difference(row), p, *ends)
        groups.setdefault(f"{row['part']}: {row['change']}", []).append(effect)
    return list(groups.items()), points


def _audit(report: Report, audit: pd.DataFrame) -> Block:
    """The audit's findings, counted by check, those that need attention first."""
    rank = {"error": 0, "warning": 1, "info": 2}
    groups = [
        {"Severity": severity, "Check": check, "Findings": str(len(rows)), "First": f"{rows['item'].iloc[0]}: {rows['measured'].iloc[0]}"}
        for (severity, check), rows in audit.groupby(["severity", "check"])
    ]
    frame = pd.DataFrame(sorted(groups, key=lambda g: (rank.get(g["Severity"], 3), -int(g["Findings"]), g["Check"])))
    file = f"{report.name}/audit.csv"
    caption = "What the audit of the data found, counted by check, with the first finding of each."
    html = draw(frame, "Data audit", [file] * len(frame))
    return Block(f"{report.name}-audit", "Data audit", caption, html, False, file)


def _speed(folder: Path, gaps: list[Gap]) -> list[tuple[str, drawing.Scatter | None, list[str], Markup]]:
    """Every question of speed_error.csv: its name, its plot, its front in words, its table."""
    rows = _csv(folder / "speed_error.csv", SPEED)
    if rows.empty:
        gaps.append(Gap("speed against error", "speed_error.csv", "not measured yet: `make bench` measures it"))
    found = []
    rows["front"] = rows["front"].astype(str).str.lower().eq("true")
    for question, group in rows.groupby("question", sort=False):
        shown = group.drop(columns="question").dropna(axis="columns", how="all")
        text = pd.DataFrame({_heading(name): [_plain(v) for v in shown[name]] for name in shown})
        lines = [f"speed_error.csv:{index + 2}" for index in group.index]
        front = group[group["front"]].sort_values("cost_ratio")
        words = [f"{row['setting']} ({_plain(row['cost_ratio'])}×, error {_plain(row['error'])})" for row in front.to_dict("records")]
        found.append((str(question), drawing.scatter(group), words, draw(text, str(question), lines)))
    return found


def _stability(folder: Path, gaps: list[Gap]) -> dict[str, Any]:
    """Verdicts counted by part and format, and the cases that failed."""
    rows = _csv(folder / "stability.csv", STABILITY)
    if rows.empty:
        gaps.append(Gap("numerical stability", "stability.csv", "not measured yet: `make stability` measures it"))
        return {"cases": 0}
    failed = rows[rows["verdict"] != "pass"]
    counts = rows.assign(passed=rows["verdict"].eq("pass")).groupby(["part", "format"])["passed"].agg(["sum", "count"])
    cells = counts.apply(lambda c: f"{c['sum']} of {c['count']}", axis=1).unstack(fill_value="").reset_index()
    cells.columns = ["Part", *cells.columns[1:]]
    lines = [f"stability.csv:{index + 2}" for index in failed.index]
    return {
        "cases": len(rows),
        "failed": len(failed),
        "table": draw(cells, "Cases that passed, by part and number format", ["stability.csv"] * len(cells)),
        "failures": draw(failed.astype(str), "Cases that failed", lines) if len(failed) else "",
    }


def draw(frame: pd.DataFrame, caption: str, sources: Sequence[str]) -> Markup:
    """A table of text as HTML, by great_tables, with the page's own style in place of one style sheet a table.

    Args:
        frame: text in every cell; rows of one task, measure or severity stand together under its name.
        caption: what the table is called.
        sources: the file (and line) that each row comes from.
    """
    from great_tables import GT

    kinds = {name: _class(name, frame[name]) for name in frame}
    words = [name for name, kind in kinds.items() if kind == "words"]
    group = next((n for n in ("Task", "Measure", "Severity") if n in words and len(words) > 1), None)
    head = next((name for name in words if name != group), None)
    html = GT(frame, rowname_col=head, groupname_col=group, id="t").as_raw_html()
    shown = [kinds[n] for n in frame if n not in (group, head)]
    heads = iter([*(["words"] if head else []), *shown])
    cells, rows = itertools.cycle(shown), iter(sources)

    def attributes(match: re.Match[str]) -> str:
        tag, given = match.groups()
        if tag == "tr":
            return "<tr>" if "class=" in given else f'<tr data-source="{escape(next(rows))}">'
        if tag == "td":
            return f'<td class="{next(cells)}">'
        scope = re.search(r'scope="(\w+)"', given)
        if scope and scope[1] == "col":
            return f'<th scope="col" class="{next(heads)}">'
        return f'<th scope="{scope[1]}"{f" colspan={len(shown) + 1}" if scope[1] == "colgroup" else ""}>' if scope else "<th>"

    body = html[html.index("<thead") : html.index("</table>")]
    body = re.sub(r"<(tr|td|th)\b([^>]*)>", attributes, body).replace(' class="gt_table_body"', "")
    return Markup(f"<table><caption>{escape(caption)}</caption>{body}</table>")


def _class(name: str, cells: pd.Series[Any]) -> str:
    """How a column is shown: what was measured here and what the paper printed never look the same."""
    for kind in ("Measured", "Published"):
        if name.startswith(kind):
            return kind.lower()
    return "number" if all(re.match(r"[-+]?\d|nan|$", cell) for cell in cells) else "words"


def _facts(provenance: dict[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Names and values, one level after the other; a hash is cut to what tells it from others."""
    for name, value in provenance.items():
        label = f"{above}{_heading(name)}"
        if isinstance(value, dict):
            yield label, ", ".join(f"{k} {_short(v)}" for k, v in value.items())
        elif isinstance(value, list):
            lines = (", ".join(f"{k} {_short(v)}" for k, v in i.items()) if isinstance(i, dict) else _short(i) for i in value)
            yield label, "; ".join(lines)
        else:
            yield label, _short(value)


def _short(value: Any) -> str:
    text = f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
    return f"{text[:12]}…" if re.fullmatch(r"[0-9a-f]{40,}", text) else text


def _heading(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _plain(value: Any) -> str:
    """A cell of a CSV as text: four digits of a number, nothing for a missing one."""
    if isinstance(value, bool):
        return "front" if value else ""
    return "" if pd.isna(value) else f"{value:,.4g}" if isinstance(value, float | int) else str(value)


def _csv(file: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    return read_frame(file, columns)
