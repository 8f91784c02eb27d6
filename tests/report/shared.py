"""Small reports from the contract of reports/, and a page as tests walk it. Nothing here is shared with the page."""

from __future__ import annotations

import csv
import itertools
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

from tests.closure import ROOT

VOID = {"meta", "link", "br", "path", "line", "circle", "polyline"}
SCALES = ("smoke-scenes", "small-scenes", "small-videos")
SCORES = ("task", "measure", "encoder", "lora", "opd", "touch", "seed", "n", "right", "unread")


@dataclass
class Element:
    """One element of a page; `parent` leads to the root."""

    tag: str
    attributes: dict[str, str]
    parent: Element | None
    children: list[Element | str] = field(default_factory=list)

    @property
    def text(self) -> str:
        return " ".join(" ".join(c if isinstance(c, str) else c.text for c in self.children).split())

    def walk(self) -> Iterator[Element]:
        yield self
        for child in self.children:
            if isinstance(child, Element):
                yield from child.walk()

    def find(self, *tags: str) -> list[Element]:
        return [e for e in self.walk() if e.tag in tags]

    def above(self) -> Iterator[Element]:
        element: Element | None = self
        while element is not None:
            yield element
            element = element.parent

    def kinds(self) -> set[str]:
        return set(self.attributes.get("class", "").split())


class Page(HTMLParser):
    """A file's elements; one that is closed in the wrong place, or never, fails."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.root = self.place = Element("", {}, None)
        self.feed(file.read_text(encoding="utf-8"))
        self.close()
        assert self.place is self.root, f"<{self.place.tag}> is never closed"

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


def named(page: Element, name: str) -> Element:
    """The element with an id."""
    (found,) = [e for e in page.walk() if e.attributes.get("id") == name]
    return found


def write_csv(file: Path, rows: list[dict[str, object]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_csv(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def score(task: str, place: int, **changed: object) -> dict[str, object]:
    """A row of scores.csv; another place is another accuracy."""
    right = 3 + place % 7
    row = dict(
        zip(SCORES, (task, "combined" if task == "OPD" else "choice", "finetuned", "with", "all", "real", "all", 13, right, place % 3), strict=True)
    )
    return {**row, "accuracy": right / 13, "low": right / 31, "high": right / 11, "chance": 1 / 3, **changed}


def write_reports(root: Path) -> Path:
    """reports/ of three scales, with everything that the page shows."""
    tasks = ("OPD", "PC", "PSS", "POM", "PSR")
    for name in SCALES:
        folder = root / "reports" / name
        folder.mkdir(parents=True)
        systems = [{}, {"opd": "none"}, {"encoder": "base"}, {"lora": "without"}, {"touch": "swapped"}, {"seed": "0"}]
        cells = itertools.product(tasks, systems)
        scores = [score(task, place, **system) for place, (task, system) in enumerate(cells)]
        outside = {"lora": "", "opd": "", "chance": 1 / 27}
        scores += [score("heads", 5, measure="combined", **outside), score("cross_validation", 6, measure="combined", **{**outside, "encoder": "trees", "touch": ""})]
        write_csv(folder / "scores.csv", scores)
        parts = {"encoder": "finetuned - base", "lora": "with - without", "opd": "all - none", "touch": "real - swapped"}
        write_csv(
            folder / "effects.csv",
            [
                {"part": part, "change": change, "task": task, "measure": "combined" if task == "OPD" else "choice", "difference": place / 51, "low": place / 51 - 0.21, "high": place / 51 + 0.32}
                | {"p": 0.125, "p_holm": 0.875, "smallest_effect": 0.33, "n": 13, "objects": 7, "seeds": 1}
                for place, ((part, change), task) in enumerate(itertools.product(parts.items(), tasks))
            ],
        )
        finding = {"check": "contact", "item": "baseball_0", "measured": "0.4", "expected": "1", "severity": "warning"}
        write_csv(folder / "audit.csv", [finding, finding, {**finding, "check": "lost", "severity": "error"}])
        sample = {"question_id": "PC-test-1", "task": "PC", "right": True, "asked": ["Harder?"], "answered": ["Yes."]}
        samples = {"rule": "The first.", "samples": [{**sample, "reference": ["Yes."], "expected": "yes", "predicted": "yes"}]}
        (folder / "samples.json").write_text(json.dumps(samples))
        scale, source = name.split("-")
        said = json.loads((ROOT / "reports" / "small-videos" / "provenance.json").read_text())
        (folder / "provenance.json").write_text(json.dumps({**said, "report": name, "scale": scale, "source": source}))
        (folder / "README.md").write_text(f"# {name}\n")
        for file in ("curves.csv", "confusion.csv", "dataset.csv"):
            shutil.copy(ROOT / "reports" / "small-videos" / file, folder)
    settings = [(2.0, 0.25), (1.0, 0.5), (4.0, 0.75)]
    write_csv(
        root / "reports" / "speed_error.csv",
        [
            {"question": "frames", "setting": f"{place} frames", "cost": 10 * ratio, "unit": "ms a video", "cost_ratio": ratio, "flops": 3e9 * ratio}
            | {"error": error, "error_of": "share wrong", "low": error - 0.2, "high": error + 0.125, "front": place < 2}
            for place, (ratio, error) in enumerate(settings)
        ],
    )
    verdicts = {"float64": "pass", "bfloat16": "fail"}
    write_csv(
        root / "reports" / "stability.csv",
        [
            {"part": "loss", "case": "large logits", "format": f, "finite": True, "error": 0.5, "bound": 0.25, "verdict": v}
            for f, v in verdicts.items()
        ],
    )
    return root
