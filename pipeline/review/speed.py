"""Speed against error on the page: what is recommended, then each question with its plot and its table."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.review.blocks import Block, Picture
from pipeline.review.missing import Gap
from pipeline.review.readme import Section, parse
from pipeline.review.tables import Shown, show
from pipeline.review.traced import Grid, Piece
from pipeline.review.views import Column, Kind, View
from pipeline.speed.gather import CSV, MARKDOWN, RECOMMENDED, UNMEASURED, picture_of, slug
from pipeline.speed.questions import QUESTIONS

COSTS = (
    Column("Ratio|cost", "{ratio:.3f}", Kind.MEASURED, "{cost} {unit}"),
    Column("Error|95 %", "{error:.3f}", Kind.MEASURED, "{low:.3f} to {high:.3f}"),
)
COUNTS = (
    Column("Frames", "{frames:g}"),
    Column("Tokens", "{tokens:g}"),
    Column("FLOPs", "{flops}"),
    Column("Bytes", "{bytes}"),
)
SETTINGS = View(
    (
        Column("Setting", "{setting}", Kind.HEAD),
        *COSTS,
        Column("Recommended", "{recommended}", Kind.FLAG),
        *COUNTS,
    ),
    hidden=("question",),
)
CHOSEN = View(
    (Column("Question", "{question}", Kind.HEAD), Column("Recommended", "{setting}", Kind.WORDS), *COSTS, *COUNTS),
    hidden=("recommended",),
)
UNANSWERED = re.compile(r"^- \*\*(?P<title>.+?)\*\* (?P<reason>.+)$", re.MULTILINE)


def speed_blocks(reports: Path, grid: Grid) -> list[Block]:
    """The blocks of a table over all parts; titles and captions are those of the Markdown beside it."""
    folder = grid.file.removesuffix(CSV)
    file = f"{folder}{MARKDOWN}"
    told = parse(_text(reports / file))
    sections = {section.title: section for section in told.sections}
    titles = {question.key: question.title for question in QUESTIONS}
    rows = range(len(grid.rows))
    chosen = [row for row in rows if grid.value(row, "recommended") == "True"]
    blocks = []
    if chosen:
        table = _table(grid, CHOSEN, RECOMMENDED, chosen, "recommended")
        blocks.append(Block(RECOMMENDED, told.tested, file if told.tested else "", table=table))
    for key in dict.fromkeys(grid.value(row, "question") for row in rows):
        title = titles.get(key, key)
        section = sections.get(title, Section(title, "", ""))
        own = [row for row in rows if grid.value(row, "question") == key]
        pictures = [Picture(f"{folder}{picture_of(key)}", f"Plot of cost against error. {title}")]
        blocks.append(
            Block(
                title,
                section.caption,
                file if section.caption else "",
                table=_table(grid, SETTINGS, title, own, slug(key)),
                pictures=tuple(p for p in pictures if (reports / p.file).is_file()),
            )
        )
    return blocks


def speed_gaps(reports: Path) -> list[Gap]:
    """The questions that nothing has measured yet, and what would."""
    _, _, text = _text(reports / MARKDOWN).partition(f"## {UNMEASURED}\n")
    return [
        Gap("speed", (Piece(found["title"]),), Piece(found["reason"].replace("`", ""), f"{MARKDOWN}#"))
        for found in UNANSWERED.finditer(text)
    ]


def _table(grid: Grid, view: View, title: str, rows: Sequence[int], name: str) -> Shown:
    """These rows of the file; never folded, since they are what the section is about."""
    return replace(show(grid, view, title, only=rows, name=f"speed-{name}"), folded=False)


def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8") if file.is_file() else ""
