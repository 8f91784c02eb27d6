"""Which modules of the pipeline a script reaches: the reference that dvc.yaml is held against."""

from __future__ import annotations

import ast
from collections.abc import Collection
from pathlib import Path

ROOT = Path(__file__).parent.parent


def imported(file: Path) -> set[Path]:
    """Project files that a file imports, at its top or inside functions, with their packages."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    paths = {ROOT.joinpath(*name.split(".")[:depth]) for name in names for depth in range(1, name.count(".") + 2)}
    files = {file for path in paths for file in (path.with_suffix(".py"), path / "__init__.py")}
    return {file for file in files if file.is_file()}


def closure(script: Path, unfollowed: Collection[str] = ()) -> list[str]:
    """Project files that running `script` can import, itself included, but nothing that those in `unfollowed` import.

    Files of a docstring alone, as most packages' __init__ are, are left out: they cannot change a result.
    """
    seen: set[Path] = set()
    waiting = [script]
    while waiting:
        file = waiting.pop()
        if file not in seen:
            seen.add(file)
            if file.relative_to(ROOT).as_posix() not in unfollowed:
                waiting += imported(file)
    bodies = {file: ast.parse(file.read_text(encoding="utf-8")).body for file in seen}
    code = [file for file, body in bodies.items() if any(not isinstance(node, ast.Expr) for node in body)]
    return sorted(file.relative_to(ROOT).as_posix() for file in code)
