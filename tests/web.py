"""An HTML page as tests walk it: elements, texts with where they stand, and the files that figures come from."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import yaml

VOID = {"meta", "link", "img", "br", "hr", "path", "circle", "rect", "input"}


@dataclass
class Element:
    """One element; `parent` leads to the root."""

    tag: str
    attributes: dict[str, str]
    parent: Element | None
    children: list[Element | str] = field(default_factory=list)

    @property
    def text(self) -> str:
        return "".join(c if isinstance(c, str) else c.text for c in self.children)

    @property
    def words(self) -> str:
        """Its text with single spaces, and one between elements."""
        return " ".join(" ".join(text for text, _ in self.texts()).split())

    @property
    def above(self) -> Iterator[Element]:
        """Itself and everything that it stands in."""
        element: Element | None = self
        while element is not None:
            yield element
            element = element.parent

    def walk(self) -> Iterator[Element]:
        yield self
        for child in self.children:
            if isinstance(child, Element):
                yield from child.walk()

    def find(self, *tags: str) -> list[Element]:
        return [e for e in self.walk() if e.tag in tags]

    def texts(self) -> Iterator[tuple[str, Element]]:
        """Runs of text with the element that they stand in."""
        for element in self.walk():
            for child in element.children:
                if isinstance(child, str) and child.strip():
                    yield child, element

    def within(self, attribute: str) -> bool:
        return any(attribute in e.attributes for e in self.above)


class _Parser(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.root = self.place = Element("", {}, None)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = Element(tag, {name: value or "" for name, value in attrs}, self.place)
        self.place.children.append(element)
        if tag not in VOID:
            self.place = element

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.place.children.append(Element(tag, {name: value or "" for name, value in attrs}, self.place))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.place.tag == tag, f"</{tag}> closes <{self.place.tag}>"
            assert self.place.parent is not None
            self.place = self.place.parent

    def handle_data(self, data: str) -> None:
        self.place.children.append(data)


def parse_html(text: str) -> Element:
    """The root; an element that is closed in the wrong place fails."""
    parser = _Parser()
    parser.feed(text)
    parser.close()
    assert parser.place is parser.root, f"<{parser.place.tag}> is never closed"
    return parser.root


def plain(text: str) -> str:
    """A text without Markdown's marks, and with single spaces."""
    return " ".join(re.sub(r"[*`>]", "", text).split())


class Sources:
    """Looks up `FILE#PLACE` below a folder, on its own terms: it shares no code with what wrote the page."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._read: dict[str, Any] = {}

    def value(self, source: str) -> Any:
        """What stands at a place; for an empty place the file's whole text, plain."""
        name, place = source.split("#", 1)
        content = self._content(name)
        if not place:
            return plain((self.folder / name).read_text())
        if place.startswith("count"):
            return self._count(content, place)
        if cell := re.fullmatch(r"(\d+):(\w+)", place):
            return content[int(cell[1]) - 1][cell[2]]
        for part in place.split("."):
            content = content[int(part)] if isinstance(content, list) else content[part]
        return content

    def _count(self, content: Any, place: str) -> int:
        _, _, what = place.partition(":")
        if "=" in what:
            column, value = what.split("=", 1)
            return sum(row[column] == value for row in content)
        for part in what.split(".") if what else ():
            content = content.get(part, ())
        return len(content)

    def _content(self, name: str) -> Any:
        if name not in self._read:
            text = (self.folder / name).read_text()
            if name.endswith(".csv"):
                self._read[name] = list(csv.DictReader(text.splitlines()))
            elif name.endswith(".json"):
                self._read[name] = json.loads(text)
            else:
                self._read[name] = yaml.safe_load(text) if name.endswith(".yaml") else text
        return self._read[name]


def says(shown: str, value: Any, factor: float = 1) -> bool:
    """Whether a text shows a value: the same words, or the figure rounded to the digits that are shown."""
    if isinstance(value, list):
        said = [str(v) for v in value if v != ""]
        return shown in {", ".join(said), "\n".join(said)}
    if isinstance(value, bool):
        return shown == str(value).lower()
    try:
        figure = factor * float(value)
        digits = len(shown.partition(".")[2])
        return abs(float(shown) - figure) <= 0.5000001 * 10**-digits
    except ValueError:
        return plain(shown) == plain(str(value))
