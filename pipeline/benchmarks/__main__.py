"""The command behind `make bench SECTION=name`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.io import write_json
from pipeline.benchmarks import BenchRow, frames, realism, scenes, selection, startup
from pipeline.errors import UserError


def _encoder(root: Path) -> Sequence[BenchRow]:
    # Torch is loaded for this section alone: `frames` measures the memory of processes that import this module.
    from pipeline.benchmarks import encoder

    return encoder.measure(root)


def _language(root: Path) -> Sequence[BenchRow]:
    from pipeline.benchmarks import language

    return language.measure(root)


def _coverage(root: Path) -> Sequence[BenchRow]:
    # NumPy's whole statistics are loaded for this section alone, for the same reason.
    from pipeline.benchmarks import coverage

    return coverage.measure(root)


SECTIONS: dict[str, Callable[[Path], Sequence[BenchRow]]] = {
    "frames": frames.measure,
    "realism": realism.measure,
    "scenes": scenes.measure,
    "selection": selection.measure,
    "startup": startup.measure,
    "coverage": _coverage,
    "encoder": _encoder,
    "language": _language,
}
"""To add a section: write its module with a `measure(root)` beside this one and list it here."""


def main(arguments: Sequence[str]) -> None:
    """Run one section and write its rows; anything wrong ends the process with one line and status 1."""
    try:
        if len(arguments) != 1 or arguments[0] not in SECTIONS:
            raise UserError(f"bench {' '.join(arguments) or '(no section)'}: allowed sections: {', '.join(SECTIONS)}")
        rows = SECTIONS[arguments[0]](Path())
    except UserError as error:
        sys.exit(str(error))
    path = Path("reports") / "bench" / f"{arguments[0]}.json"
    write_json(path, [row.model_dump() for row in rows])
    for row in rows:
        print(f"{row.case:44} {row.cost:8.2f} {row.unit}  {row.ratio:6.3f} x {row.baseline}")
    print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
