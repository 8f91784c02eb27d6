"""A folder of videos, objects and ratings in the layout of docs/data.md, as `octopi studio` fills it.

What lies on disk is the truth: it is read anew at every call, and each change is one file that takes another's place.
"""

from __future__ import annotations

import csv
import logging
import os
import re
import shutil
import time
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType

import yaml
from pydantic import ValidationError

from pipeline.core.io import atomic, remove_rests, write_text
from pipeline.running.errors import UserError, first_problem
from pipeline.videos.audit.labels import icc3k
from pipeline.videos.catalogue import OBJECTS, PROPERTIES
from pipeline.videos.catalogue.csv_reader import LONGEST_ID, Row, read_rows
from pipeline.videos.catalogue.wording import Language
from pipeline.videos.files import LIST_FILE, video_files
from pipeline.videos.importing.presses import first_free

log = logging.getLogger(__name__)
RATINGS = "ratings.csv"
ASIDE = ".deleted"
"""Where deleted videos wait for an undo, until the folder is opened again."""


class RatedFolder:
    """Videos in `videos/`; in `catalogue/` the properties, who rated which object how, and objects.csv made of that."""

    def __init__(self, folder: Path, properties: Path) -> None:
        """Open a folder, or make one with the properties of the file `properties`; UserError for a broken one."""
        self.videos, self.catalogue, self.known = folder / "videos", folder / "catalogue", dict[str, Row]()
        self.videos.mkdir(parents=True, exist_ok=True)
        file = self.catalogue / PROPERTIES
        if not file.exists():  # `dataset` would put PhysiCLeAR's figures beside other videos'.
            write_text(file, re.sub(r"(?m)^dataset:.*\n", "", properties.read_text(encoding="utf-8")))
        try:
            self.properties = Language.model_validate(yaml.safe_load(file.read_text(encoding="utf-8"))).properties
        except (ValidationError, UnicodeDecodeError, yaml.YAMLError) as error:
            what = first_problem(error) if isinstance(error, ValidationError) else str(error)
            raise UserError(f"{file}: {' '.join(what.split())[:300]}") from None
        self.names = [p.name for p in self.properties]
        remove_rests(folder)
        shutil.rmtree(self.videos / ASIDE, ignore_errors=True)
        # What was written by hand may hold more than is written here: lines without ratings, files that are elsewhere.
        stamp, kept = f"{datetime.now():%Y%m%d-%H%M%S-%f}", dict[Path, Path]()  # To the microsecond: no older copy's.
        for file in (self.catalogue / RATINGS, self.catalogue / OBJECTS, self.videos / LIST_FILE):
            if file.is_file():
                kept[file] = Path(shutil.copyfile(file, file.with_name(f"{file.name}.{stamp}")))
        self.save(self.ratings())
        self.list_videos()
        for file, copy in kept.items():
            if file.is_file() and file.read_bytes() == copy.read_bytes():
                copy.unlink()
            else:
                log.warning("%s: written anew; %s is as it was", file, copy.name)

    # ---- ratings ----

    def ratings(self) -> list[Row]:
        """The lines of ratings.csv; behind them objects that objects.csv alone has, whose raters are numbered."""
        rows = self._read(RATINGS, ["object_id", "rater", *self.names])
        known = {row["object_id"] for row in rows}
        for row in self._read(OBJECTS, ["object_id", "name", *self.names]):
            if row["object_id"] not in known:
                for n, each in enumerate(zip_longest(*(row[p].split() for p in self.names), fillvalue=""), 1):
                    given = dict(zip(self.names, each, strict=True))
                    rows.append({"object_id": row["object_id"], "rater": f"rater {n}"} | given)
        return rows

    def id_of(self, name: str) -> str:
        """The id of an object, by which its videos are called: a new one's is its name, with _ for blanks and signs."""
        if name in {row["object_id"] for row in (*self.ratings(), *self.recorded())}:
            return name
        known = {row["name"].lower(): row["object_id"] for row in self._read(OBJECTS, ["object_id", "name"])}
        plain = unicodedata.normalize("NFC", name).strip().lower()
        key = known.get(plain) or re.sub(r"[^\w-]+", "_", plain).strip("_-")
        if 0 < len(os.fsencode(key)) <= LONGEST_ID:
            return key
        raise UserError(f"{name[:50]!r}: no name for an object; write a short one, such as: a block of foam")

    def save(self, rows: Sequence[Row], called: Mapping[str, Row] = MappingProxyType({})) -> None:
        """Write ratings.csv, and objects.csv with each object that has a class of every property from somebody.

        Names and other columns of objects.csv stay as they are, but for lines in `called` (by id); a new object is
        called by its id.
        """
        self._write(self.catalogue / RATINGS, ["object_id", "rater", *self.names], rows)
        file = self.catalogue / OBJECTS
        header, before = read_rows(file, ["object_id", "name"]) if file.exists() else ([], [])
        old, lines = {row["object_id"]: row for _, row in before} | {**called}, list[Row]()
        for key in dict.fromkeys(row["object_id"] for row in rows):
            own = [row for row in rows if row["object_id"] == key]
            cells = {p: " ".join(row[p] for row in own if row.get(p)) for p in self.names}
            if all(cells.values()):
                lines.append({"object_id": key, "name": key.replace("_", " ")} | old.get(key, {}) | cells)
        self._write(file, dict.fromkeys(["object_id", "name", *self.names, *header]), lines)

    def rate(self, rater: str, object_id: str, property: str, level: int) -> None:
        """Write down one class that a rater gives an object."""
        if not rater or level not in {p.name: range(len(p.levels)) for p in self.properties}.get(property, ()):
            raise UserError(f"{rater!r}, {property}, {level}: no such rater, property or class; load the page anew")
        rows = self.ratings()
        if object_id not in {row["object_id"] for row in (*rows, *self.recorded())}:
            raise UserError(f"{object_id}: no such object; load the page anew")
        row = next((row for row in rows if (row["object_id"], row["rater"]) == (object_id, rater)), Row())
        if not row:
            rows.append(row)
        row |= {"object_id": object_id, "rater": rater, property: str(level)}
        self.save(rows)

    def rename(
        self, old: str, new: str, name: str, files: Mapping[str, str] | None = None
    ) -> tuple[str, dict[str, str]]:
        """Give an object another id and name, with its videos and ratings.

        Args:
            files: For an undo, what each of its videos was called.

        Returns:
            The name that it had, and what each of its videos was called, by what it is called now.
        """
        rows, videos, lines = self.ratings(), self.recorded(), self._read(OBJECTS, ["object_id", "name"])
        if new != old and new in {video["object_id"] for video in videos}:
            raise UserError(f"{new}: is another object; give the videos to it one by one")
        names = {line["object_id"]: line["name"] for line in lines}
        line = next((line for line in lines if line["object_id"] == old), Row()) | {"object_id": new, "name": name}
        # An object without videos may have that name, also from a kill in here: its ratings by other raters stay.
        given = {
            row["rater"]: row | {"object_id": new} for key in (new, old) for row in rows if row["object_id"] == key
        }
        others = [row for row in rows if row["object_id"] != new]
        if new != old:  # Rated under both names while its videos move, so that a kill leaves none unrated.
            self.save([*others, *given.values()], {new: line})
        own = [video["file"] for video in videos if video["object_id"] == old != new]
        moved = {self.move(file, new, (files or {}).get(file, ""))[0]: file for file in own}
        self.save([*(row for row in others if row["object_id"] != old), *given.values()], {new: line})
        return names.get(old, old.replace("_", " ")), moved

    def rated(self) -> set[str]:
        """Ids of objects with videos, and with a class of every property from somebody."""
        listed = {row["object_id"] for row in self._read(OBJECTS, ["object_id"])}
        return listed & {video["object_id"] for video in self.recorded()}

    def agreement(self, rows: Sequence[Row]) -> dict[str, tuple[float, float, float] | None]:
        """By property ICC(3,k) of ratings, with its interval; None where undefined.

        It takes objects that each of its raters rated. Raters who rated few are left out where the others have more
        ratings without them, so that who has just begun does not hide how those before agree.
        """
        found = {}
        for p in self.names:
            by = dict[str, dict[str, int]]()
            for row in rows:
                if row[p]:
                    by.setdefault(row["rater"], {})[row["object_id"]] = int(row[p])
            most = sorted(by.values(), key=len, reverse=True)
            tables = [
                [[own[key] for own in most[:count]] for key in most[0] if all(key in own for own in most[:count])]
                for count in range(2, len(most) + 1)
            ]
            found[p] = icc3k(max(tables, key=lambda table: sum(map(len, table)), default=[]))
        return found

    def _read(self, name: str, needed: Sequence[str]) -> list[Row]:
        file = self.catalogue / name
        return [row for _, row in read_rows(file, needed)[1]] if file.exists() else []

    def _write(self, file: Path, columns: Iterable[str], rows: Sequence[Row]) -> None:
        with atomic(file) as part, part.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, list(columns), restval="", extrasaction="ignore", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)

    # ---- videos ----

    def recorded(self) -> list[Row]:
        """The videos that are there: as videos.csv lists them, then those that it lacks, by their names."""
        there = {path.relative_to(self.videos).as_posix(): path for path in video_files(self.videos)[0]}
        file, found = self.videos / LIST_FILE, dict[str, Row]()
        for _, row in read_rows(file, ["file", "object_id"])[1] if file.exists() else ():
            if row["file"] in there:
                found[row["file"]] = row
        for name, path in there.items():
            if name not in found and name in self.known:
                found[name] = self.known[name]
            elif name not in found and (match := re.fullmatch(r"([\w-]+)_\d+", path.stem)):
                found[name] = {"file": name, "object_id": match[1]}
        return list(found.values())

    def list_videos(self, *coming: Row) -> None:
        """Write videos.csv, with all its columns; none for no video, since it would be an error of its own."""
        if rows := [*self.recorded(), *coming]:
            columns = dict.fromkeys(["file", "object_id", "session", *(key for row in rows for key in row)])
            self._write(self.videos / LIST_FILE, columns, rows)
        else:
            (self.videos / LIST_FILE).unlink(missing_ok=True)

    def move(self, file: str, to: str, now: str = "") -> tuple[str, str]:
        """Give a video to another object, or with an empty `to` put it aside; where it is now, and whose it was.

        Args:
            now: For an undo, what it was called; by default the next free number of the object.
        """
        row = next((row for row in self.recorded() if row["file"] == file), self.known.get(file))
        source = self.videos / file
        if row is None or not source.is_file():
            raise UserError(f"{file}: no such video; load the page anew")
        free = f"{to}_{first_free(self.videos, to)}{source.suffix}"
        now = now or (free if to else f"{ASIDE}/{time.time_ns()}_{source.name}")
        self.known[now] = row | {"file": now, "object_id": to}
        if to:  # Listed under both names while it moves: a kill leaves it its session.
            self.list_videos(self.known[now])
        target = self.videos / now
        target.parent.mkdir(parents=True, exist_ok=True)
        if (timed := source.with_suffix(".csv")).is_file():  # There twice for a moment: no video is without its times.
            shutil.copyfile(timed, target.with_suffix(".csv"))
        os.replace(source, target)
        timed.unlink(missing_ok=True)
        self.list_videos()
        return now, row["object_id"]
