"""What a report's README.md says about its tables and figures: the titles, captions and alternative texts."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

TABLE = re.compile(r"^(?P<caption>.*?) ?\(\[CSV\]\((?P<file>[^)]+)\)\)$", re.DOTALL)
IMAGE = re.compile(r"^!\[(?P<alt>[^\]]*)\]\((?P<file>[^)]+)\)$")
NOT_DRAWN = "Not drawn: "
FRAME = ("Contents", "How to read it", "Provenance")
"""Headings that are about the page itself."""


@dataclass(frozen=True)
class Section:
    """One table or figure."""

    title: str
    caption: str
    file: str
    """CSV or PNG relative to the report's folder; empty for a figure that was not drawn."""
    alt: str = ""
    missing: str = ""
    """Why a figure was not drawn."""
    told: str = "README.md"
    """The file that says so, relative to the report's folder."""

    @property
    def name(self) -> str:
        """The file's name without folder and ending."""
        return self.file.rsplit("/", 1)[-1].rsplit(".", 1)[0]


@dataclass(frozen=True)
class Readme:
    """What stands in the file."""

    title: str
    warning: str
    """What speaks against reading anything into the figures; empty where nothing does."""
    tested: str
    """On what, and with which models."""
    sections: tuple[Section, ...]


def parse(text: str) -> Readme:
    """Read what `pipeline.reporting.page` writes; paragraphs that are neither table nor figure are left out."""
    head, *parts = re.split(r"^## ", text, flags=re.MULTILINE)
    paragraphs = [" ".join(p.split()) for p in head.split("\n\n") if p.strip()]
    title = paragraphs[0].removeprefix("# ").removeprefix("Report: ") if paragraphs else ""
    warnings = [p.removeprefix("> ").strip("* ") for p in paragraphs if p.startswith(">")]
    tested = [p for p in paragraphs[1:] if not p.startswith(">")]
    sections = [_section(*part.split("\n", 1)) for part in parts if "\n" in part]
    return Readme(title, " ".join(warnings), " ".join(tested), tuple(s for s in sections if s and s.title not in FRAME))


def within(readme: Readme, folder: str) -> tuple[Section, ...]:
    """The sections of a README.md in a folder of the report's, as the report's own."""
    return tuple(replace(s, file=s.file and f"{folder}/{s.file}", told=f"{folder}/{s.told}") for s in readme.sections)


def _section(title: str, body: str) -> Section | None:
    paragraphs = [p.strip() for p in body.split("\n\n") if p.strip()]
    for place, paragraph in enumerate(paragraphs):
        if table := TABLE.match(paragraph):
            return Section(title, table["caption"], table["file"])
        if image := IMAGE.match(paragraph):
            caption = paragraphs[place + 1] if place + 1 < len(paragraphs) else ""
            return Section(title, caption, image["file"], alt=image["alt"])
        if paragraph.startswith(NOT_DRAWN):
            return Section(title, " ".join(paragraphs[:place]), "", missing=paragraph.removeprefix(NOT_DRAWN))
    return None
