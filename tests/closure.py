"""Which modules of the pipeline a script reaches: the reference that dvc.yaml is held against."""

from __future__ import annotations

import ast
from collections.abc import Collection
from pathlib import Path

ROOT = Path(__file__).parent.parent


def module_file(name: str) -> Path | None:
    """The file of a dotted module name inside the project, or None for anything else."""
    base = ROOT / Path(*name.split("."))
    return next((f for f in (base.with_suffix(".py"), base / "__init__.py") if f.is_file()), None)


def imported(file: Path) -> set[Path]:
    """Project files that a file imports, at its top or inside functions, with their packages."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    files: set[Path] = set()
    for name in names:
        parts = name.split(".")
        found = [module_file(".".join(parts[: i + 1])) for i in range(len(parts))]
        files |= {f for f in found if f is not None}
    return files


def closure(script: Path, unfollowed: Collection[str] = ()) -> list[str]:
    """Project files that running `script` can import, itself included, but nothing that those in `unfollowed` import.

    Packages' empty __init__ files are left out: they cannot change a result.
    """
    seen: set[Path] = set()
    waiting = [script]
    while waiting:
        file = waiting.pop()
        if file not in seen:
            seen.add(file)
            if file.relative_to(ROOT).as_posix() not in unfollowed:
                waiting += imported(file)
    return sorted(f.relative_to(ROOT).as_posix() for f in seen if f.stat().st_size > 0)
