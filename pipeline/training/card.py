"""The model card beside every trained model: what it is made of, how it was trained and what it cannot do.

A training's card has no scores, as none are known then; that of a packaged model has them. Equal trainings write equal
bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml
from huggingface_hub import ModelCard, ModelCardData, metadata_load

from pipeline.core.io import sha256
from pipeline.weights import REPOSITORIES

CARD_FILE = "README.md"


def write_card(
    folder: Path,
    title: str,
    *,
    bases: Mapping[str, Path],
    data: Mapping[str, object],
    settings: Mapping[str, object],
    limits: Sequence[str],
    front: Mapping[str, Any] = MappingProxyType({}),
    tables: Mapping[str, Sequence[Mapping[str, object]]] = MappingProxyType({}),
) -> None:
    """Write README.md, a model card as the Hugging Face Hub reads it.

    Args:
        bases: Folder or file of the weights of each model that it was made from, by its part.
        limits: What it cannot do, a sentence each.
        front: What else the front matter says, as `ModelCardData` takes it.
        tables: Further tables by their heading, a mapping a row.
    """
    # As the card beside the weights states it.
    beside = {part: front_matter(path if path.is_dir() else path.parent) for part, path in bases.items()}
    licences = {part: str(card["license"]) if "license" in card else None for part, card in beside.items()}
    stated = set(licences.values())
    published = {part: REPOSITORIES[path.name] for part, path in bases.items() if path.name in REPOSITORIES}
    head = ModelCardData(
        **front,
        license=stated.pop() if len(stated) == 1 and None not in stated else "other",
        # The Hub would take a folder for a name of its own.
        base_model=[*published.values()] or None,
        tags=["tactile", "gelsight", "octopi"],
    )
    lines = ["---", head.to_yaml(), "---", f"# {title}", "", "## Base models", ""]
    for part, path in bases.items():
        name = f"`{published[part]}`, here `{path.as_posix()}`" if part in published else f"`{path.as_posix()}`"
        lines.append(f"- {part}: {name}, licence: {licences[part] or 'not stated beside the weights'}")
        files = sorted(path.glob("*.safetensors")) if path.is_dir() else [path]
        lines += [f"  - `{file.name}`, sha256 {sha256(file)}" for file in files]
    for heading, values in (("Training data", data), ("Hyper-parameters", settings)):
        lines += ["", f"## {heading}", "", "| | |", "|---|---|", *map(_row, values.items())]
    for heading, rows in tables.items():
        if rows:
            lines += ["", f"## {heading}", "", _row(rows[0]), _row(["---"] * len(rows[0]))]
            lines += (_row(row.values()) for row in rows)
    lines += ["", "## What it cannot do", "", *(f"- {limit}" for limit in limits)]
    ModelCard("\n".join(lines) + "\n").save(folder / CARD_FILE)


def _row(cells: Iterable[object]) -> str:
    shown = (", ".join(map(str, cell)) if isinstance(cell, (list, tuple)) else str(cell) for cell in cells)
    return f"| {' | '.join(shown)} |"


def front_matter(folder: Path) -> dict[str, Any]:
    """What the card in a folder says in its front matter; empty where there is none."""
    try:
        return metadata_load(folder / CARD_FILE) or {}
    except (FileNotFoundError, ValueError, yaml.YAMLError):  # Of another's model: it is then as good as none.
        return {}
