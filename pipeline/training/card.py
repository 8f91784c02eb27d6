"""The model card beside every trained model: what it is made of, how it was trained and what it cannot do.

A training's card has no scores, as none are known then; that of a packaged model has them. Equal trainings write equal
bytes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from pipeline.core.io import sha256, write_text

CARD_FILE = "README.md"


def write_card(
    folder: Path,
    title: str,
    *,
    bases: Mapping[str, Path],
    data: Mapping[str, object],
    settings: Mapping[str, object],
    limits: Sequence[str],
    front: Mapping[str, object] = MappingProxyType({}),
    tables: Mapping[str, Sequence[Mapping[str, object]]] = MappingProxyType({}),
) -> None:
    """Write README.md with the front matter of Hugging Face's model cards.

    Args:
        bases: Folder or file of the weights of each model that it was made from, by its part.
        limits: What it cannot do, a sentence each.
        front: What else the front matter says.
        tables: Further tables by their heading, a mapping a row.
    """
    # As the card beside the weights states it.
    beside = {part: front_matter(path if path.is_dir() else path.parent) for part, path in bases.items()}
    licences = {part: str(card["license"]) if "license" in card else None for part, card in beside.items()}
    stated = set(licences.values())
    front = {
        **front,
        "license": stated.pop() if len(stated) == 1 and None not in stated else "other",
        "base_model": [path.as_posix() for path in bases.values()],
        "tags": ["tactile", "gelsight", "octopi"],
    }
    lines = ["---", yaml.safe_dump(front, sort_keys=False).rstrip(), "---", f"# {title}", "", "## Base models", ""]
    for part, path in bases.items():
        lines.append(f"- {part}: `{path.as_posix()}`, licence: {licences[part] or 'not stated beside the weights'}")
        files = sorted(path.glob("*.safetensors")) if path.is_dir() else [path]
        lines += [f"  - `{file.name}`, sha256 {sha256(file)}" for file in files]
    for heading, values in (("Training data", data), ("Hyper-parameters", settings)):
        lines += ["", f"## {heading}", "", "| | |", "|---|---|", *map(_row, values.items())]
    for heading, rows in tables.items():
        if rows:
            lines += ["", f"## {heading}", "", _row(rows[0]), _row(["---"] * len(rows[0]))]
            lines += (_row(row.values()) for row in rows)
    lines += ["", "## What it cannot do", "", *(f"- {limit}" for limit in limits)]
    write_text(folder / CARD_FILE, "\n".join(lines) + "\n")


def _row(cells: Iterable[object]) -> str:
    shown = (", ".join(map(str, cell)) if isinstance(cell, (list, tuple)) else str(cell) for cell in cells)
    return f"| {' | '.join(shown)} |"


def front_matter(folder: Path) -> dict[str, Any]:
    """What the card in a folder says in its front matter; empty where there is none."""
    card = folder / CARD_FILE
    text = card.read_text(encoding="utf-8", errors="replace") if card.is_file() else ""
    found = re.match(r"---\n(.*?)^---\s*$", text, re.DOTALL | re.MULTILINE)
    try:
        front: Any = yaml.safe_load(found[1]) if found else None
    except yaml.YAMLError:  # Of another's model: it is then as good as none.
        front = None
    return front if isinstance(front, dict) else {}
