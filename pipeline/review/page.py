"""What stands on the page, put together from the files; the templates only say how it looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.records import Severity
from pipeline.reporting.results import OCTOPI
from pipeline.reporting.samples import FOLDER
from pipeline.review.blocks import Block, Picture
from pipeline.review.folders import Bench, Report, find_grids, read_benches, read_reports
from pipeline.review.graph import Drawing, draw_chain
from pipeline.review.known import ACCURACY, BENCH, VIEWS, view_of
from pipeline.review.matrices import matrices
from pipeline.review.missing import Gap, gaps
from pipeline.review.readme import Section
from pipeline.review.speed import speed_blocks, speed_gaps
from pipeline.review.tables import Drawn, draw, show
from pipeline.review.themes import BENCHES, EVERYWHERE, ORIGIN, OTHERS, SAMPLES, THEMES, BenchText, Theme
from pipeline.review.traced import Grid, Piece, fill
from pipeline.stability.record import Judgement

HEADLINE = (
    ("PC", "understanding", "Property comparison"),
    ("PSS", "understanding", "Superlative selection"),
    ("POM", "understanding", "Object matching"),
    ("PSR", "scenario_reasoning", "Scenario reasoning"),
    ("combined", "property_description", "Description, all properties right"),
)
"""Row, table and name of the figures at a glance."""


@dataclass(frozen=True)
class Group:
    """The blocks of one theme."""

    theme: Theme
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Chapter:
    """One report."""

    report: Report
    groups: tuple[Group, ...]

    @property
    def themes(self) -> tuple[Theme, ...]:
        """All that stands in the chapter, for the contents."""
        return (*(group.theme for group in self.groups), SAMPLES, ORIGIN)


@dataclass(frozen=True)
class Glance:
    """What one report has measured in one task."""

    value: tuple[Piece, ...]
    interval: tuple[Piece, ...]
    counted: tuple[Piece, ...]
    note: Piece
    drawn: Drawn | None


@dataclass(frozen=True)
class GlanceRow:
    """One task: what a guess reaches, what the paper printed, what each report measured."""

    task: str
    name: str
    chance: tuple[Piece, ...]
    published: tuple[tuple[Piece, ...], ...]
    measured: tuple[Glance | None, ...]


@dataclass(frozen=True)
class Page:
    """Everything."""

    chapters: tuple[Chapter, ...]
    glance: tuple[GlanceRow, ...]
    chain: Drawing
    speed: tuple[Block, ...]
    stability: tuple[Block, ...]
    missing: tuple[Gap, ...]


def compose(root: Path) -> Page:
    """Read reports/ and dvc.yaml below `root`."""
    reports_dir = root / "reports"
    reports, benches = read_reports(reports_dir), read_benches(reports_dir)
    told = {report.file(s.file): (report, s) for report in reports for s in report.readme.sections if s.file}
    grids = {e.name: find_grids(reports_dir, f"{e.name}.csv") for e in EVERYWHERE}
    title = next(e.title for e in EVERYWHERE if e.name == "stability")
    speed = [block for grid in grids["speed_error"] for block in speed_blocks(reports_dir, grid)]
    missing = gaps(reports, benches, [name for name, found in grids.items() if found])
    return Page(
        chapters=tuple(_chapter(report) for report in reports),
        glance=_glance(reports),
        chain=draw_chain(root / "dvc.yaml"),
        speed=(*speed, *(_bench(bench) for bench in benches if bench.grid)),
        stability=tuple(_shared(same, title, *told.get(same[0].file, ())) for same in _equal(grids["stability"])),
        missing=(*missing, *speed_gaps(reports_dir)),
    )


def _chapter(report: Report) -> Chapter:
    shared = {e.name for e in EVERYWHERE}
    sections: dict[str, list[Section]] = {}
    for section in report.readme.sections:
        if section.file:
            sections.setdefault(section.name, []).append(section)
    told = {section.file for section in report.readme.sections}
    for file in report.tables:
        name = Path(file).stem
        if file not in told and name not in shared:
            sections.setdefault(name, []).append(Section(name.replace("_", " ").capitalize(), "", file))
    themed = {name for theme in THEMES for name in theme.names}
    others = Theme(OTHERS.key, OTHERS.title, tuple(name for name in sections if name not in themed | shared))
    groups = []
    for theme in (*THEMES, others):
        blocks = [block for name in theme.names for block in _blocks(report, sections.get(name, ()))]
        if blocks:
            groups.append(Group(theme, tuple(blocks)))
    return Chapter(report, tuple(groups))


def _blocks(report: Report, sections: Sequence[Section]) -> list[Block]:
    """What is written under one name: the table first, and the figure where the table does not show the same."""
    blocks: list[Block] = []
    for section in sections:
        grid, readme = report.tables.get(section.file), report.file(section.told)
        if section.file.endswith(".png"):
            if not any(block.matrices for block in blocks):
                picture = Picture(report.file(section.file), section.alt)
                blocks.append(Block(section.title, section.caption, readme, pictures=(picture,)))
        elif grid is None:
            continue
        elif section.name == "confusion_matrices" and (found := matrices(grid)):
            blocks.append(Block(section.title, section.caption, readme, matrices=tuple(found)))
        elif section.name == "audit":
            blocks.append(_audit(grid, section, readme))
        elif section.name == "ablation" and len({grid.value(row, "seed") for row in range(len(grid.rows))}) > 1:
            # Every variant is in the table over seeds, and hundreds of rows that say it seed by seed hide the others.
            blocks.append(Block(section.title, section.caption, readme, left=grid))
        else:
            shown = show(grid, view_of(section.name), section.title)
            blocks.append(Block(section.title, section.caption, readme, table=shown))
    return blocks


def _audit(grid: Grid, section: Section, readme: str) -> Block:
    """What needs attention; the rest is counted, and in the file."""
    urgent = [row for row in range(len(grid.rows)) if grid.value(row, "severity") != Severity.INFO]
    urgent.sort(key=lambda row: grid.value(row, "severity"))
    counts = tuple((severity.value, grid.where("severity", severity.value)) for severity in Severity)
    shown = show(grid, view_of("audit"), section.title, only=urgent, part="what needs attention")
    return Block(section.title, section.caption, readme, table=shown if urgent else None, counts=counts)


def _equal(grids: Sequence[Grid]) -> list[list[Grid]]:
    """Tables in groups of those that say the same, in order."""
    groups: list[list[Grid]] = []
    for grid in grids:
        group = next((g for g in groups if (g[0].columns, g[0].rows) == (grid.columns, grid.rows)), None)
        if group is None:
            groups.append([grid])
        else:
            group.append(grid)
    return groups


def _shared(same: Sequence[Grid], title: str, report: Report | None = None, section: Section | None = None) -> Block:
    """A table over all parts, and where else it lies; what its report says about it, where that does."""
    grid = same[0]
    name, view = grid.file.replace("/", "-")[:-4], view_of(Path(grid.file).stem)
    counts = tuple((v.value, grid.where("verdict", v.value)) for v in Judgement) if "verdict" in grid.columns else ()
    caption, source = (section.caption, report.file(section.told)) if report and section else ("", "")
    table = show(grid, view, title, name=name)
    return Block(title, caption, source, table=table, counts=counts, same=tuple(g.file for g in same[1:]))


def _bench(bench: Bench) -> Block:
    assert bench.grid is not None, "sections without figures are among what is missing"
    text = BENCHES.get(bench.name, BenchText(bench.name.replace("_", " ").capitalize(), ""))
    alt = f"Plot of the table {text.title}: cost against error, with intervals."
    pictures = tuple(Picture(file, alt) for file in bench.pictures)
    view, name = VIEWS.get(bench.name, BENCH), f"bench-{bench.name}"
    table = show(bench.grid, view, text.title, only=_used(bench.grid), part="what the reports use", name=name)
    return Block(text.title, text.caption, "", table=table, pictures=pictures)


def _used(grid: Grid) -> Sequence[int] | None:
    """Of methods that are compared those that the reports use, where they fall short first; None for other tables."""
    if "reported" not in grid.columns:
        return None
    used = [row for row in range(len(grid.rows)) if grid.value(row, "reported") == "true"]
    return sorted(used, key=lambda row: "liberal" not in grid.value(row, "verdict"))


def _glance(reports: Sequence[Report]) -> tuple[GlanceRow, ...]:
    rows = []
    for row, table, name in HEADLINE:
        found = [_find(report.table(table), row) for report in reports]
        some = next((f for f in found if f), None)
        if some:
            grid, place = some
            printed = tuple(fill(f"{{published_{model}:.2f}}", grid, place) for model in ("7b", "13b"))
            measured = tuple(_measured(*f) if f else None for f in found)
            rows.append(GlanceRow(row, name, fill("{chance:.2f}", grid, place), printed, measured))
    return tuple(rows)


def _find(grid: Grid | None, row: str) -> tuple[Grid, int] | None:
    """Where the full system's figure stands."""
    places = range(len(grid.rows)) if grid else ()
    at = (i for i in places if grid and (grid.value(i, "row"), grid.value(i, "system")) == (row, OCTOPI.label))
    place = next(at, None)
    return (grid, place) if grid and place is not None else None


def _measured(grid: Grid, row: int) -> Glance:
    assert ACCURACY.bar is not None, "accuracies are drawn"
    return Glance(
        fill("{value:.2f}", grid, row),
        fill("{clustered_low:.1f} to {clustered_high:.1f}", grid, row),
        fill("{k:g}/{n}", grid, row),
        grid.piece(row, "note"),
        draw(grid, row, ACCURACY.bar),
    )


def strip_file(report: Report, strip: str) -> str:
    """A sample's strip of frames, relative to reports/."""
    return report.file(f"{FOLDER}/{strip}")
