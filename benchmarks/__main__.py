"""The command behind `make bench SECTION=name`: measure one section, merge its rows, draw the figures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from benchmarks.figures import draw
from benchmarks.table import CSV, Row, merge
from pipeline.running.errors import UserError

SECTIONS = ("frames", "encoder", "contact", "systems", "serving", "training")
"""Modules beside this one with a `measure(root)` that gives rows. Another section is a module and its name here."""


def main(arguments: Sequence[str]) -> None:
    """Run one section; anything wrong ends the process with one line and status 1."""
    try:
        if len(arguments) != 1 or arguments[0] not in SECTIONS:
            raise UserError(f"bench {' '.join(arguments) or '(no section)'}: allowed sections: {', '.join(SECTIONS)}")
        # Imported here, since torch is of no use to sections that decode in many processes.
        rows: list[Row] = import_module(f"benchmarks.{arguments[0]}").measure(Path())
        table = merge(CSV, rows)
        draw(table, CSV.parent)
    except UserError as error:
        sys.exit(str(error))
    for row in rows:
        shown = "" if row.error is None else f"  error {row.error:.4g}{' (front)' if row.front else ''}"
        print(f"{row.question:32} {row.setting:44} {row.cost:9.3g} {row.unit}, x {row.cost_ratio:.3g}{shown}")
    print(CSV)


if __name__ == "__main__":
    main(sys.argv[1:])
