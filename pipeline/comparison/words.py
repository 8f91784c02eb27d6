"""A comparison as text: what a reviewer asks first comes first, and long lists end with how much is left out."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import groupby

from pipeline.comparison.accuracies import Accuracy, Tested
from pipeline.comparison.compare import Comparison
from pipeline.comparison.figures import Figure
from pipeline.comparison.locked import Change, StageChange

SHOWN = 40
"""So many lines of one kind; the rest is in the JSON file."""
ROWS = 5
"""Of one of the reports' tables."""
LONGEST = 72
"""Letters of a cell."""
HASH = re.compile(r"[0-9a-f]{32,}")
HASH_SHOWN = 12
STAGE_METRICS = "data/metrics/"
FIGURES = frozenset(range(2, 11))
"""The columns of the accuracies that are flush right."""
LEGEND = """\
  95 %: of the gain, clustered by object. p: sign flip over objects. One right: questions that one of the two alone got
  right. Detectable: the gain that four in five such comparisons find."""


def describe(comparison: Comparison) -> str:
    """The comparison for a terminal, a hundred columns and more wide."""
    old, new = comparison.old, comparison.new
    if not comparison.differs:
        same = f"Nothing differs between {old} and {new}: parameters, stages as they last ran, figures of the reports."
        return "\n".join([same, *_notes(comparison.tested)])
    parts = [
        [f"{old} -> {new}"],
        _parameters(comparison),
        _inputs(comparison),
        _stages(comparison),
        _figures(comparison),
        _origins(comparison),
        _accuracies(comparison.tested),
        _notes(comparison.tested),
    ]
    return "\n\n".join("\n".join(part) for lines in parts if (part := list(lines)))


def _parameters(comparison: Comparison) -> Iterator[str]:
    changes = comparison.parameters
    yield _heading(len(changes), "parameter", "changed")
    yield from _table(("", "old", "new"), [(c.name, _cell(c.old), _cell(c.new)) for c in changes])


def _inputs(comparison: Comparison) -> Iterator[str]:
    """Names alone: a hash tells a person nothing."""
    inputs = comparison.inputs
    yield _heading(len(inputs), "file or folder that stages read", "changed", "files or folders that stages read")
    marks = [" (new)" if c.old is None else " (gone)" if c.new is None else "" for c in inputs]
    yield from [f"  {c.name}{mark}" for c, mark in zip(inputs, marks, strict=True)][:SHOWN]
    yield from _left_out(len(inputs) - SHOWN, 2)


def _stages(comparison: Comparison) -> Iterator[str]:
    moved = [stage for stage in comparison.stages if stage.outs]
    yield _heading(len(moved), "stage", "made other outputs")
    yield from _table(("stage", "because of", "outputs that moved"), [(s.stage, _reasons(s), _outs(s)) for s in moved])
    idle = [stage.stage for stage in comparison.stages if not stage.outs]
    for names, words in (
        (idle, "ran with something else and made the same"),
        (comparison.appeared, f"only in {comparison.new}"),
        (comparison.vanished, f"only in {comparison.old}"),
    ):
        if names:
            yield f"{_count(len(names), 'stage')} {words}: {', '.join(names)}"


def _outs(stage: StageChange) -> str:
    """Without the few metrics that nearly every stage writes, unless they are all."""
    names = [c.name for c in stage.outs]
    return ", ".join([name for name in names if not name.startswith(STAGE_METRICS)] or names)


def _reasons(stage: StageChange) -> str:
    code = [c for c in stage.deps if c.name.endswith(".py")]
    reasons = [c.name for c in (*stage.params, *stage.deps) if c not in code]
    reasons += [_count(len(code), "code file")] if code else []
    return ", ".join([*reasons, *["its command"] * stage.command]) or "nothing that dvc.lock names"


def _figures(comparison: Comparison) -> Iterator[str]:
    figures = comparison.figures
    yield _heading(len(figures.moved), "figure", "moved")
    for file, group in groupby(figures.moved, key=lambda figure: figure.file):
        yield f"  {file}"
        if file.endswith(".csv"):
            lines = [_line(list(cells)) for _, cells in groupby(group, key=lambda figure: figure.row)]
            yield from _table(("row", "column", "old", "new", ""), lines, indent=4, most=ROWS)
        else:
            yield from _table(("", "old", "new"), [(f.row, _cell(f.old), _cell(f.new)) for f in group], indent=4)
    for change in figures.files:
        yield f"  {change.name}: only in {comparison.new if change.old is None else comparison.old}"


def _line(cells: Sequence[Figure]) -> tuple[str, ...]:
    """A row by the first of its cells that moved: tables begin with what they measure, intervals follow."""
    first, more = cells[0], len(cells) - 1
    rest = f"and {_count(more, 'other cell')}" if more else ""
    return _cut(first.row), first.column, _cell(first.old), _cell(first.new), rest


def _origins(comparison: Comparison) -> Iterator[str]:
    """Without what the parameters have said already."""
    said = set(comparison.parameters)
    left = [f for f in comparison.figures.origins if Change(f.row, f.old, f.new) not in said]
    if left:
        yield "Reports were made from something else"
        yield from _table(("", "old", "new"), [(f"{f.file}: {f.row}", _cell(f.old), _cell(f.new)) for f in left])


def _accuracies(tested: Tested) -> Iterator[str]:
    if tested.accuracies:
        count = len(tested.accuracies)
        yield f"Accuracies on the same questions, in percent; {_count(count, 'test')} in Holm's family"
        names = ("variant", "task", "old", "new", "gain", "95 %", "p", "p Holm", "n", "one right", "detectable")
        yield from _table(names, [_tested(row) for row in tested.accuracies], right=FIGURES)
        yield LEGEND
        if tested.same:
            yield f"  Every question went as before: {', '.join(tested.same)}"


def _tested(row: Accuracy) -> tuple[str, ...]:
    interval = "" if row.low is None or row.high is None else f"{100 * row.low:.1f} to {100 * row.high:.1f}"
    n = f"{row.n} ({row.left_out} left out)" if row.left_out else str(row.n)
    shares = (f"{100 * row.old:.1f}", f"{100 * row.new:.1f}", f"{100 * row.difference:+.1f}", interval)
    detectable = "" if row.detectable is None else "over 100" if row.detectable > 1 else f"{100 * row.detectable:.1f}"
    return row.variant, row.task, *shares, _p(row.p), _p(row.p_holm), n, str(row.changed), detectable


def _notes(tested: Tested) -> list[str]:
    return [f"note: {note}" for note in tested.notes]


def _table(
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    indent: int = 2,
    most: int = SHOWN,
    right: frozenset[int] = frozenset(),
) -> Iterator[str]:
    """Columns as wide as what is shown in them; nothing without rows."""
    if rows:
        shown = [columns, *rows[:most]]
        widths = [max(len(row[place]) for row in shown) for place in range(len(columns))]
        for row in shown:
            cells = (
                cell.rjust(width) if place in right else cell.ljust(width)
                for place, (cell, width) in enumerate(zip(row, widths, strict=True))
            )
            yield f"{' ' * indent}{'  '.join(cells)}".rstrip()
        yield from _left_out(len(rows) - most, indent)


def _left_out(count: int, indent: int) -> Iterator[str]:
    if count > 0:
        yield f"{' ' * indent}... and {count} more; --json FILE has them all"


def _heading(count: int, one: str, did: str, many: str = "") -> str:
    return f"{_count(count, one, many)} {did}" if count else f"No {one} {did}"


def _count(count: int, one: str, many: str = "") -> str:
    return f"{count} {one if count == 1 else many or one + 's'}"


def _cell(value: str | None) -> str:
    if value is None:
        return "-"
    return (value[:HASH_SHOWN] if HASH.fullmatch(value) else _cut(value)) or '""'


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _p(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
