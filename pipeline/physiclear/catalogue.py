"""The catalogue of a data set: its properties, its objects, the annotators' ratings and the words for all of it.

A catalogue is a folder with `objects.csv` and `properties.yaml`. The one beside this module is PhysiCLeAR's, from
the tables of the paper (names, ratings, materials, parts, splits).
"""

from __future__ import annotations

import csv
import math
from functools import cached_property
from pathlib import Path
from typing import Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pipeline.errors import UserError
from pipeline.records import Part
from pipeline.runtime import derive_seed

FIXED_COLUMNS = ("object_id", "name", "material", "part_of", "part", "split_paper", "split_release")


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Property(_Entry):
    """One physical property with its ordered classes and the words for them."""

    name: str = Field(pattern=r"^[a-z][a-z_]*$")
    levels: tuple[str, ...] = Field(min_length=2)
    more: str
    less: str
    most: str
    least: str
    alone: str
    phrases: tuple[tuple[str, ...], ...]

    @model_validator(mode="after")
    def _phrases_fit(self) -> Self:
        if len(self.phrases) != len(self.levels) or not all(self.phrases):
            raise ValueError(f"{self.name}: phrases need one non-empty list a level")
        return self


class Scenario(_Entry):
    """A situation and the classes that suit it (PSR)."""

    name: str
    question: str
    object: str | None = None
    target: dict[str, tuple[int, ...]] = Field(min_length=1)
    other: dict[str, tuple[int, ...]] = Field(min_length=1)


class Language(_Entry):
    """Everything in properties.yaml."""

    properties: tuple[Property, ...] = Field(min_length=1)
    unstructured: str
    structured: str
    scenarios: tuple[Scenario, ...] = ()

    @model_validator(mode="after")
    def _names_fit(self) -> Self:
        names = {p.name for p in self.properties}
        for scenario in self.scenarios:
            unknown = (scenario.target.keys() | scenario.other.keys()) - names
            if unknown:
                raise ValueError(f"scenario {scenario.name}: unknown property {', '.join(sorted(unknown))}")
        for template in (self.unstructured, self.structured):
            missing = [name for name in names if f"{{{name}}}" not in template]
            if missing:
                raise ValueError(f"template {template!r} does not name {', '.join(sorted(missing))}")
        return self


class Object(_Entry):
    """One object (or part of one) with its ratings, one tuple a property in the catalogue's order."""

    object_id: str
    name: str
    material: str
    part_of: str
    part: str
    splits: dict[str, Part]
    ratings: tuple[tuple[int, ...], ...]

    @property
    def labels(self) -> tuple[int, ...]:
        """The class of each property: the annotators' mean, rounded (half upwards)."""
        return tuple(math.floor(sum(r) / len(r) + 0.5) for r in self.ratings)


class Catalogue(_Entry):
    """A data set's objects and the language for them."""

    language: Language
    objects: dict[str, Object]

    @cached_property
    def properties(self) -> tuple[Property, ...]:
        """The properties in the order of every label tuple."""
        return self.language.properties

    @cached_property
    def property_names(self) -> tuple[str, ...]:
        """Their names, in the same order."""
        return tuple(p.name for p in self.properties)

    def labels(self, object_id: str) -> tuple[int, ...]:
        """The class of each property of one object."""
        return self.objects[object_id].labels

    def property_index(self, name: str) -> int:
        """The position of a property in a label tuple."""
        return self.property_names.index(name)

    def structured(self, labels: tuple[int, ...]) -> str:
        """The paper's closing sentence, e.g. "Overall, it presents a hard and smooth surface with no bumps."."""
        words = {p.name: p.levels[level] for p, level in zip(self.properties, labels, strict=True)}
        return self.language.structured.format(**words)

    def unstructured(self, object_id: str) -> str:
        """The object's own free description; each property's wording is fixed by the object's id."""
        words = {}
        for p, level in zip(self.properties, self.labels(object_id), strict=True):
            choices = p.phrases[level]
            words[p.name] = choices[derive_seed("phrase", object_id, p.name) % len(choices)]
        return self.language.unstructured.format(**words)

    def describe(self, object_id: str) -> str:
        """The full description of an object: unstructured, then structured."""
        return f"{self.unstructured(object_id)} {self.structured(self.labels(object_id))}"

    def describe_one(self, object_id: str, name: str) -> str:
        """The structured description of one property only (OPD mode `needed`)."""
        index = self.property_index(name)
        p = self.properties[index]
        return p.alone.format(level=p.levels[self.labels(object_id)[index]])


def load_catalogue(folder: Path) -> Catalogue:
    """Read `folder/properties.yaml` and `folder/objects.csv`.

    Raises:
        UserError: naming the file, line and mend, for a missing file or column, an object listed twice, a rating
            outside the classes or an unknown part of a split.
    """
    language_file, objects_file = folder / "properties.yaml", folder / "objects.csv"
    for file in (language_file, objects_file):
        if not file.is_file():
            raise UserError(
                f"{file}: no such file; data.catalogue must name a folder with objects.csv and properties.yaml"
            )
    try:
        language = Language.model_validate(yaml.safe_load(language_file.read_text(encoding="utf-8")))
    except (ValidationError, yaml.YAMLError) as error:
        raise UserError(f"{language_file}: {' '.join(str(error).split())[:300]}") from None
    objects: dict[str, Object] = {}
    with objects_file.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        wanted = [*FIXED_COLUMNS, *(p.name for p in language.properties)]
        missing = [c for c in wanted if c not in (reader.fieldnames or ())]
        if missing:
            raise UserError(f"{objects_file}: column {', '.join(missing)} is missing; expected {', '.join(wanted)}")
        for number, row in enumerate(reader, 2):
            entry = _read_object(row, language, f"{objects_file}, line {number}")
            if entry.object_id in objects:
                raise UserError(
                    f"{objects_file}, line {number}: {entry.object_id} is listed twice, so it could stand in two "
                    "splits; keep one line an object"
                )
            objects[entry.object_id] = entry
    if not objects:
        raise UserError(f"{objects_file}: lists no object; add one line an object")
    return Catalogue(language=language, objects=objects)


def _read_object(row: dict[str, str], language: Language, where: str) -> Object:
    ratings = []
    for p in language.properties:
        try:
            values = tuple(int(word) for word in row[p.name].split())
        except (ValueError, AttributeError):
            values = ()
        if not values or not all(0 <= v < len(p.levels) for v in values):
            raise UserError(
                f"{where}: {p.name} is {row[p.name]!r}; write the annotators' ratings as numbers from 0 to "
                f"{len(p.levels) - 1} separated by spaces"
            )
        ratings.append(values)
    splits = {}
    for column in ("split_paper", "split_release"):
        value = row[column] or Part.UNUSED
        if value not in set(Part):
            raise UserError(f"{where}: {column} is {value!r}; allowed: {', '.join(Part)}")
        splits[column.removeprefix("split_")] = Part(value)
    if not row["object_id"] or not row["name"]:
        raise UserError(f"{where}: object_id and name must not be empty")
    fields = {key: row[key] for key in ("object_id", "name", "material", "part_of", "part")}
    return Object(**fields, splits=splits, ratings=tuple(ratings))
