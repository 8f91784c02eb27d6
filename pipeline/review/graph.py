"""The chain as a drawing: stages of dvc.yaml in ranks, and the dependencies between them.

Dependencies follow from paths: a stage comes after another if it reads what that one writes. Which stages of a
`foreach` there are is a matter of params.yaml; the drawing takes a plan with everything in it.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pipeline.plan import resolve_plan
from pipeline.records import Touch
from pipeline.config import SCENES_DIR

WIDTH, HEIGHT = 144, 42
ACROSS, DOWN = 18, 30
"""Free space between two boxes."""
TOP = 8
SWEEPS = 8


@dataclass(frozen=True)
class StageNode:
    """A stage and its place; several stages of a `foreach` are one."""

    name: str
    description: str
    plan: str
    """Key of params.yaml that it is repeated over; empty where it runs once."""
    x: float
    y: float


@dataclass(frozen=True)
class Drawing:
    """Boxes, and lines from box to box as SVG paths."""

    nodes: tuple[StageNode, ...]
    lines: tuple[str, ...]
    width: float
    height: float


@dataclass(frozen=True)
class _Stage:
    name: str
    description: str
    plan: str
    reads: frozenset[str]
    writes: frozenset[str]


def draw_chain(file: Path) -> Drawing:
    """Lay out the stages of a dvc.yaml, first at the top."""
    stages = _stages(yaml.safe_load(file.read_text(encoding="utf-8"))["stages"])
    after = _reduced({s.name: {o.name for o in stages if o is not s and _feeds(o, s)} for s in stages})
    ranks = _ranks(after)
    rows, chains = _rows(after, ranks)
    _order(rows, chains)
    widest = max(len(row) for row in rows)
    width = widest * WIDTH + (widest - 1) * ACROSS + 2 * ACROSS
    places = {
        name: ((i - (len(row) - 1) / 2) * (WIDTH + ACROSS) + width / 2, rank * (HEIGHT + DOWN) + TOP + HEIGHT / 2)
        for rank, row in enumerate(rows)
        for i, name in enumerate(row)
    }
    known = {s.name: s for s in stages}
    nodes = tuple(
        StageNode(name, known[name].description, known[name].plan, *places[name])
        for row in rows
        for name in row
        if name in known
    )
    lines = tuple(_line([places[name] for name in chain]) for chain in chains)
    return Drawing(nodes, lines, width, len(rows) * (HEIGHT + DOWN) - DOWN + 2 * TOP)


def _stages(content: Mapping[str, Any]) -> list[_Stage]:
    plan = resolve_plan(
        "scenes", "factorial", (0,), pretrained=True, compared={"strong": True}, counterfactuals=(Touch.SWAPPED,)
    ).model_dump(mode="json")
    found = []
    for name, stage in content.items():
        over = re.sub(r"^\$\{(.*)\}$", r"\1", str(stage.get("foreach", "")))
        body = stage.get("do", stage)
        items = plan[over.removeprefix("plan.")] if over else {"": {}}
        named = items.items() if isinstance(items, dict) else ((str(item), {}) for item in items)
        reads: set[str] = set()
        writes: set[str] = set()
        for key, item in named:
            values = {"key": key, "item": key, "data.dir": SCENES_DIR.as_posix(), "plan.pretrained": plan["pretrained"]}
            values |= {f"item.{field}": str(value) for field, value in item.items()}
            reads |= {_filled(path, values) for path in _paths(body.get("deps", ()))}
            writes |= {_filled(path, values) for part in ("outs", "metrics") for path in _paths(body.get(part, ()))}
        found.append(_Stage(name, str(body.get("desc", "")), over, frozenset(reads), frozenset(writes)))
    return found


def _paths(entries: Iterable[Any]) -> list[str]:
    return [next(iter(e)) if isinstance(e, dict) else str(e) for e in entries]


def _filled(path: str, values: Mapping[str, str]) -> str:
    return re.sub(r"\$\{([^}]+)\}", lambda m: values.get(m[1], m[0]), path)


def _feeds(one: _Stage, other: _Stage) -> bool:
    return any(r == w or r.startswith(w + "/") or w.startswith(r + "/") for r in other.reads for w in one.writes)


def _reduced(after: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Only dependencies that do not follow from others."""
    every: dict[str, set[str]] = {}

    def before(name: str) -> set[str]:
        if name not in every:
            every[name] = after[name].union(*(before(n) for n in after[name]))
        return every[name]

    return {name: {n for n in near if not any(n in before(m) for m in near if m != n)} for name, near in after.items()}


def _ranks(after: Mapping[str, set[str]]) -> dict[str, int]:
    """By the longest way from the start; what depends on nothing stands right above what needs it."""
    ranks: dict[str, int] = {}

    def rank(name: str) -> int:
        if name not in ranks:
            ranks[name] = 1 + max((rank(n) for n in after[name]), default=-1)
        return ranks[name]

    for name in after:
        rank(name)
    for name in [n for n, near in after.items() if not near]:
        ranks[name] = min((ranks[m] for m, near in after.items() if name in near), default=1) - 1
    return ranks


def _rows(after: Mapping[str, set[str]], ranks: Mapping[str, int]) -> tuple[list[list[str]], list[list[str]]]:
    """Names by rank, and each line as the names that it passes: long lines get a free place in every row between."""
    rows: list[list[str]] = [[] for _ in range(max(ranks.values()) + 1)]
    for name, rank in ranks.items():
        rows[rank].append(name)
    chains = []
    for name, near in after.items():
        for other in sorted(near):
            between = [f"{other}>{name}:{rank}" for rank in range(ranks[other] + 1, ranks[name])]
            for rank, free in enumerate(between, ranks[other] + 1):
                rows[rank].append(free)
            chains.append([other, *between, name])
    return rows, chains


def _order(rows: list[list[str]], chains: Iterable[list[str]]) -> None:
    """Within rows by the mean place of neighbours, from above and from below by turns: fewer lines cross."""
    links = [(a, b) for chain in chains for a, b in itertools.pairwise(chain)]
    for sweep in range(SWEEPS):
        down = sweep % 2 == 0
        for place in range(1, len(rows)) if down else range(len(rows) - 2, -1, -1):
            fixed = rows[place - 1 if down else place + 1]
            where = {name: i - (len(fixed) - 1) / 2 for i, name in enumerate(fixed)}
            middle = {}
            for i, name in enumerate(rows[place]):
                near = [where[a if down else b] for a, b in links if (b if down else a) == name]
                middle[name] = sum(near) / len(near) if near else i - (len(rows[place]) - 1) / 2
            rows[place].sort(key=lambda name: middle[name])


def _line(places: list[tuple[float, float]]) -> str:
    (x, y), half = places[0], HEIGHT / 2
    path = f"M{x:g} {y + half:g}"
    for number, (right, down) in enumerate(places[1:], 1):
        start, end = y + half, down - half
        middle = (start + end) / 2
        path += f"C{x:g} {middle:g} {right:g} {middle:g} {right:g} {end:g}"
        if number < len(places) - 1:
            path += f"V{down + half:g}"
        x, y = right, down
    return path
