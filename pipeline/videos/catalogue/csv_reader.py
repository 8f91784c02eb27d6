"""CSV files that people write by hand or in a spreadsheet, read with the place of every line."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

from pipeline.running.errors import UserError

Row = dict[str, str]
LONGEST_ID = 150
"""Bytes of an object's id at most: names of files begin with it, and have up to 255."""


def check_object_id(where: str, object_id: str, mend: str = "") -> None:
    """Raise UserError for an id that names of files cannot begin with; `mend` says where to write another."""
    size = len(os.fsencode(object_id))
    if size > LONGEST_ID or re.fullmatch(r"[\w-]+", object_id) is None:
        wanted = f"take letters, digits, _ and - alone, up to {LONGEST_ID} bytes"
        raise UserError(f"{where}: object {object_id[:50]!r} ({size} bytes) names files; {wanted}{mend}")


def read_rows(file: Path, needed: Sequence[str]) -> tuple[list[str], list[tuple[str, Row]]]:
    """The header, and each line with its place as an error names it.

    Cells are stripped and absent ones empty; empty lines are passed over, and other columns than `needed` are kept.
    What is wrong is a UserError that names the file, line and mend.
    """
    rows = []
    # Spreadsheets put a byte order mark before their UTF-8, and commas alone on lines that once held something.
    with file.open(encoding="utf-8-sig", newline="") as stream:
        # Strict, or an unclosed quotation mark swallows all lines behind it.
        reader, begins = csv.reader(stream, strict=True), 1
        try:
            header = [cell.strip() for cell in next(reader, [])]
            missing = [c for c in needed if c not in header]
            if missing:
                expected = f"expected {', '.join(needed)}, separated by commas"
                raise UserError(f"{file}: column {', '.join(missing)} is missing; {expected}")
            twice = [c for c in header if c and header.count(c) > 1]
            if twice:
                raise UserError(f"{file}: column {twice[0]} stands twice; remove one")
            begins = reader.line_num + 1
            for cells in reader:
                where, begins = f"{file}, line {begins}", reader.line_num + 1
                if len(cells) > len(header):
                    fields = f"{len(cells)} fields for {len(header)} columns"
                    raise UserError(f"{where}: {fields}; put a text that has commas between quotation marks")
                stripped = [cell.strip() for cell in cells]
                if any(stripped):
                    rows.append((where, dict(zip_longest(header, stripped, fillvalue=""))))
        except UnicodeDecodeError as error:
            raise UserError(f"{file}: no CSV in UTF-8 ({error}); save it as such") from None
        except csv.Error as error:
            raise UserError(f"{file}, line {begins}: no CSV ({error}); is a quotation mark open?") from None
    return header, rows
