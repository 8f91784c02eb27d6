"""The report folders as they lie on disk, of whatever age: what a folder lacks is absent, not an error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from pipeline.io import read_json
from pipeline.reporting.encoders import FOLDER as ENCODERS
from pipeline.reporting.samples import FILE, FOLDER
from pipeline.review.readme import Readme, parse, within
from pipeline.review.traced import Grid, Piece, entry, lookup, read_grid

README = "README.md"
BENCH = "bench"


@dataclass(frozen=True)
class Report:
    """One folder of reports/."""

    name: str
    readme: Readme
    tables: Mapping[str, Grid]
    """By file relative to the folder."""
    provenance: Mapping[str, Any]
    encoders: Mapping[str, Any]
    """The provenance of the comparison of encoders; empty where there is none of its own."""
    params: Mapping[str, Any]
    params_text: str
    samples: Mapping[str, Any]
    """The content of samples.json; empty where there is none."""

    def file(self, name: str) -> str:
        """A file of this folder as sources name it."""
        return f"{self.name}/{name}"

    def table(self, name: str) -> Grid | None:
        """The first table with this file name, given without its ending."""
        return next((grid for file, grid in self.tables.items() if Path(file).stem == name), None)

    def origin(self, place: str) -> Piece:
        """A value of provenance.json."""
        return entry(self.file("provenance.json"), self.provenance, place)

    def encoder_origin(self, place: str) -> Piece:
        """A value of the provenance of the comparison of encoders."""
        return entry(self.file(f"{ENCODERS}/provenance.json"), self.encoders, place)

    def param(self, place: str) -> Piece:
        """A value of params.yaml; a list as one text."""
        value = lookup(self.params, place)
        if isinstance(value, list):
            return Piece(", ".join(map(str, value)), f"{self.file('params.yaml')}#{place}")
        return entry(self.file("params.yaml"), self.params, place)

    def count(self, place: str) -> Piece:
        """How many entries a list or mapping of params.yaml has; none where it is not there."""
        return Piece(str(len(lookup(self.params, place) or ())), f"{self.file('params.yaml')}#count:{place}")

    def sample(self, place: str) -> Piece:
        """A value of samples.json."""
        return entry(self.file(f"{FOLDER}/{FILE}"), self.samples, place)


@dataclass(frozen=True)
class Bench:
    """One section of the benchmarks."""

    name: str
    grid: Grid | None
    """None where it has measured nothing yet."""
    pictures: tuple[str, ...]
    """PNGs relative to reports/."""


def read_reports(reports: Path) -> list[Report]:
    """Every folder with a README.md, by name."""
    return [_read(reports, folder.name) for folder in sorted(reports.iterdir()) if (folder / README).is_file()]


def read_benches(reports: Path) -> list[Bench]:
    """Every JSON of reports/bench, by name, with the pictures whose names begin like its own."""
    folder = reports / BENCH
    names = [file.stem for file in sorted(folder.glob("*.json"))]
    pictures = [f"{BENCH}/{file.name}" for file in sorted(folder.glob("*.png"))]
    return [
        Bench(
            name,
            read_grid(reports, f"{BENCH}/{name}.json"),
            tuple(p for p in pictures if Path(p).stem == name or Path(p).stem.startswith(f"{name}_")),
        )
        for name in names
    ]


def find_grids(reports: Path, name: str) -> list[Grid]:
    """The tables of this file name anywhere in reports/, by path."""
    files = sorted(path.relative_to(reports).as_posix() for path in reports.rglob(name))
    return [grid for file in files if (grid := read_grid(reports, file))]


def _read(reports: Path, name: str) -> Report:
    folder = reports / name
    files = sorted(path.relative_to(reports).as_posix() for path in folder.rglob("*.csv"))
    params = folder / "params.yaml"
    text = params.read_text(encoding="utf-8") if params.is_file() else ""
    readme, encoders = parse((folder / README).read_text(encoding="utf-8")), folder / ENCODERS / README
    if encoders.is_file():
        inner = within(parse(encoders.read_text(encoding="utf-8")), ENCODERS)
        readme = replace(readme, sections=(*readme.sections, *inner))
    return Report(
        name=name,
        readme=readme,
        tables={file.removeprefix(f"{name}/"): grid for file in files if (grid := read_grid(reports, file))},
        provenance=_json(folder / "provenance.json"),
        encoders=_json(folder / ENCODERS / "provenance.json"),
        params=yaml.safe_load(text) or {},
        params_text=text,
        samples=_json(folder / FOLDER / FILE),
    )


def _json(file: Path) -> Mapping[str, Any]:
    content = read_json(file) if file.is_file() else {}
    return content if isinstance(content, dict) else {}
