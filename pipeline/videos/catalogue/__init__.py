"""The catalogue of a data set: its properties, its objects, the annotators' ratings and the words for all of it.

A catalogue is a folder with `objects.csv` and `properties.yaml`. Where its publishers described the objects, there are
`descriptions.csv` for the audit and `texts.csv` to train on (docs/data.md explains every column and key).
The one in pipeline/physiclear is PhysiCLeAR's, from the tables of the paper (names, ratings, materials, parts, splits).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal

import yaml
from pydantic import Field, ValidationError

from pipeline.core.records import Part, Record
from pipeline.core.runtime import derive_seed
from pipeline.running.errors import UserError, first_problem
from pipeline.videos.catalogue.csv_reader import Row, check_object_id, read_rows
from pipeline.videos.catalogue.wording import OPENING, Language, Property, Scenario

__all__ = ["Catalogue", "Language", "Object", "Property", "Scenario", "load_catalogue"]

OBJECTS, PROPERTIES, DESCRIPTIONS, TEXTS = "objects.csv", "properties.yaml", "descriptions.csv", "texts.csv"


class Object(Record):
    """One object (or part of one); tuples have one entry a property, in the catalogue's order."""

    object_id: str
    name: str
    material: str = ""
    part_of: str = ""
    part: str = ""
    splits: dict[str, Part]
    """By the name of the split."""
    ratings: tuple[tuple[int, ...], ...]
    stated: tuple[int | None, ...] = ()
    """The final labels that the publishers state; None where they state none. `labels` never depends on them."""
    ripeness: dict[str, float] = {}  # noqa: RUF012
    """Its rank among the fruits of its kind, by the kind: a larger one is riper. Empty for what does not ripen."""
    description: str = ""
    """In the publishers' words; empty where there is none."""

    @property
    def labels(self) -> tuple[int, ...]:
        """The class of each property: the annotators' mean, rounded (half upwards)."""
        return tuple(math.floor(sum(r) / len(r) + 0.5) for r in self.ratings)


class Catalogue(Record):
    """A data set's objects and the language for them."""

    language: Language
    objects: dict[str, Object]
    texts: dict[str, tuple[str, ...]] = Field(default={}, exclude=True)
    """By object id, free descriptions that stand in place of those put together from phrases; the first is told."""

    @cached_property
    def properties(self) -> tuple[Property, ...]:
        """The properties in the order of every label tuple."""
        return self.language.properties

    @cached_property
    def property_names(self) -> tuple[str, ...]:
        """Their names, in the same order."""
        return tuple(p.name for p in self.properties)

    @property
    def classes(self) -> dict[str, tuple[str, ...]]:
        """The classes of each property: what two catalogues must have in common for one's heads to fit the other."""
        return {p.name: p.levels for p in self.properties}

    @property
    def split_names(self) -> tuple[str, ...]:
        """The splits that objects.csv has columns for, in the columns' order."""
        return tuple(next(iter(self.objects.values())).splits)

    def asking(self, source: str, wording: str = "object") -> Catalogue:
        """The catalogue as questions take it: with the scenarios that are from a source (`Scenario.source`) or none.

        The wording `class` keeps only the first phrase of each class; `texts` alone keeps the texts.

        Raises:
            UserError: for the wording `texts`, where there are none.
        """
        if wording == "texts" and not self.texts:
            raise UserError(f"questions.wording=texts: data.catalogue has no {TEXTS} with a text; see docs/data.md")
        scenarios = tuple(s for s in self.language.scenarios if s.source in ("", source))
        properties = self.language.properties
        if wording == "class":
            first = (tuple(level[:1] for level in p.phrases) for p in properties)
            worded = zip(properties, first, strict=True)
            properties = tuple(p.model_copy(update={"phrases": phrases}) for p, phrases in worded)
        language = self.language.model_copy(update={"scenarios": scenarios, "properties": properties})
        # Not a copy of this one: its cached properties would come along.
        return Catalogue(language=language, objects=self.objects, texts=self.texts if wording == "texts" else {})

    def telling(self, *question: object) -> Catalogue:
        """The catalogue as one question has it: of each object's texts one, drawn by what identifies the question."""
        drawn = {o: (texts[derive_seed("text", *question, o) % len(texts)],) for o, texts in self.texts.items()}
        return self.model_copy(update={"texts": drawn}) if drawn else self

    def called(self, names: Literal["catalogue", "number"]) -> Catalogue:
        """The catalogue with its objects' names as `questions.names` has them; numbers in the order of ids."""
        if names == "catalogue":
            return self
        numbered = enumerate(sorted(self.objects.items()))
        objects = {key: o.model_copy(update={"name": f"object {number}"}) for number, (key, o) in numbered}
        return Catalogue(language=self.language, objects=objects, texts=self.texts)

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
        """The object's own free description: its text, or phrases of its classes, fixed by the object's id."""
        if object_id in self.texts:
            return self.texts[object_id][0]
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
    """Read `properties.yaml`, `objects.csv` and, where they are there, `descriptions.csv` and `texts.csv` of a folder.

    What is wrong is a UserError that names the file, line and mend.
    """
    for name in (PROPERTIES, OBJECTS):
        if not (folder / name).is_file():
            raise UserError(
                f"{folder / name}: no such file; data.catalogue must name a folder with {OBJECTS} and {PROPERTIES}"
            )
    try:
        language = Language.model_validate(yaml.safe_load((folder / PROPERTIES).read_text(encoding="utf-8")))
    except ValidationError as error:
        raise UserError(f"{folder / PROPERTIES}: {first_problem(error)}") from None
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{folder / PROPERTIES}: {' '.join(str(error).split())[:300]}") from None
    header, rows = read_rows(folder / OBJECTS, ["object_id", "name", *(p.name for p in language.properties)])
    splits = _split_columns(folder / OBJECTS, header, language)
    if not rows:
        raise UserError(f"{folder / OBJECTS}: lists no object; add one line an object")
    objects: dict[str, Object] = {}
    names: dict[str, str] = {}
    for where, row in rows:
        entry = _read_object(row, language, splits, where)
        if entry.object_id in objects:
            raise UserError(
                f"{where}: {entry.object_id} is listed twice, so it could stand in two splits; keep one line an object"
            )
        objects[entry.object_id] = entry
        twin = names.setdefault(entry.name.lower(), entry.object_id)
        if twin != entry.object_id:
            raise UserError(
                f"{where}: {entry.name!r} is also the name of {twin}; give each object a name of its own, since "
                "matching questions tell objects apart by name"
            )
    for object_id, (text,) in _read_texts(folder / DESCRIPTIONS, "description", objects).items():
        objects[object_id] = objects[object_id].model_copy(update={"description": text})
    return Catalogue(language=language, objects=objects, texts=_read_texts(folder / TEXTS, "text", objects))


def _split_columns(file: Path, header: Sequence[str], language: Language) -> dict[str, str]:
    """Column to split; `label_` columns are looked at too, so that no misspelt one is passed over in silence."""
    names = [p.name for p in language.properties]
    for column in header:
        if column.startswith("label_") and column.removeprefix("label_") not in names:
            raise UserError(f"{file}: column {column} names no property; allowed: label_ and {', '.join(names)}")
    splits = {column: column.removeprefix("split_") for column in header if column.startswith("split_")}
    for column, name in splits.items():
        if name == "kfold" or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
            raise UserError(
                f"{file}: column {column}: a split's name begins with a small letter, goes on with those, digits or _, "
                "and is not kfold, which is made by rule; rename it"
            )
    return splits


def _read_object(row: Row, language: Language, splits: dict[str, str], where: str) -> Object:
    if not row["object_id"] or not row["name"]:
        raise UserError(f"{where}: object_id and name must not be empty")
    check_object_id(where, row["object_id"])
    ratings, stated = [], []
    for p in language.properties:
        most = len(p.levels) - 1
        values = _classes(row[p.name], most)
        if not values:
            raise UserError(
                f"{where}: {p.name} is {row[p.name]!r}; write the annotators' ratings as numbers from 0 to {most} "
                "separated by spaces"
            )
        ratings.append(values)
        label = row.get(f"label_{p.name}", "")
        final = _classes(label, most)
        if label and len(final) != 1:
            raise UserError(f"{where}: label_{p.name} is {label!r}; write one number from 0 to {most}, or nothing")
        stated.append(final[0] if final else None)
    parts = {}
    for column, name in splits.items():
        value = row[column] or Part.UNUSED
        if value not in set(Part):
            raise UserError(f"{where}: {column} is {value!r}; allowed: {', '.join(Part)}")
        parts[name] = Part(value)
    ripeness = {}
    for column, value in row.items():
        if column.startswith("ripeness_") and value:
            if not re.fullmatch(r"[0-9]+(\.[0-9]+)?", value):
                raise UserError(f"{where}: {column} is {value!r}; write a number, larger for riper, or nothing")
            ripeness[column.removeprefix("ripeness_").replace("_", " ")] = float(value)
    fields = {key: row.get(key, "") for key in ("object_id", "name", "material", "part_of", "part")}
    return Object(**fields, splits=parts, ratings=tuple(ratings), stated=tuple(stated), ripeness=ripeness)


def _classes(text: str, most: int) -> tuple[int, ...]:
    """The numbers of a cell, 1.0 as 1; empty where one is none, or no class."""
    words = text.split()
    values = tuple(int(word.partition(".")[0]) for word in words if re.fullmatch(r"[0-9]+(\.0*)?", word))
    return values if len(values) == len(words) and all(v <= most for v in values) else ()


def _read_texts(file: Path, column: str, objects: dict[str, Object]) -> dict[str, tuple[str, ...]]:
    """Object id to what a column says of it: one `description`, any number of `text`; nothing without the file."""
    found: dict[str, tuple[str, ...]] = {}
    rows = read_rows(file, ["object_id", column])[1] if file.is_file() else []
    for where, row in rows:
        object_id = row["object_id"]
        if object_id not in objects:
            raise UserError(f"{where}: {object_id!r} is not in {file.with_name(OBJECTS)}; correct or remove the line")
        if column == "description" and object_id in found:
            raise UserError(f"{where}: {object_id} is described twice; keep one line an object")
        if column == "text" and (not row[column] or re.search(rf"\b{OPENING}\b", row[column])):
            raise UserError(
                f"{where}: text is empty or has a sentence with {OPENING!r}; write what comes before that closing "
                "sentence, which the ratings make"
            )
        found[object_id] = (*found.get(object_id, ()), row[column])
    return found
