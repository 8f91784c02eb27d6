"""What each part of the system brings, as figures: a point and an interval for each task and change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.reporting.answered import FAILED
from pipeline.reporting.compared_rows import EffectRow, FactorialRow
from pipeline.reporting.figures import COLOURS, panels_of, save

ACROSS = 3


def draw_effects(path: Path, rows: Sequence[EffectRow] | Sequence[FactorialRow], footer: str) -> None:
    """One panel a task, one line a change; hollow where the base model fails the task's gate.

    Args:
        rows: In the order in which they are to stand; interactions, of which a line parts the main effects, last.
    """
    tasks = list(dict.fromkeys(row.task for row in rows))
    labels = list(dict.fromkeys(_label(row) for row in rows))
    main = len({_label(row) for row in rows if not _interaction(row)})
    lines = 1 + max(label.count("\n") for label in labels)
    figure, panels = panels_of(len(tasks), 3.3, 1.5 + (0.32 + 0.1 * lines) * len(labels), across=ACROSS)
    # One scale for all panels, so that lengths can be compared.
    reach = max((abs(end) for row in rows for end in (row.low, row.high, row.difference) if end is not None), default=1)
    for number, (axes, task) in enumerate(zip(panels, tasks, strict=True)):
        for row in (r for r in rows if r.task == task):
            height, colour = -labels.index(_label(row)), COLOURS[4] if _interaction(row) else COLOURS[0]
            face = "white" if row.gate.startswith(FAILED) else colour
            if row.low is not None and row.high is not None:
                axes.plot([100 * row.low, 100 * row.high], [height, height], color=colour, linewidth=1.8)
            marker = "D" if _interaction(row) else "o"
            axes.plot(100 * row.difference, height, marker, color=colour, markerfacecolor=face, markersize=6)
        axes.axvline(0, color="black", linewidth=0.8)
        if 0 < main < len(labels):
            axes.axhline(0.5 - main, color="black", linewidth=0.5, linestyle=":")
        axes.set_title(task)
        axes.set_xlim(-105 * reach, 105 * reach)
        axes.set_ylim(-len(labels) + 0.5, 0.5)
        axes.set_yticks([-i for i in range(len(labels))], labels if number % ACROSS == 0 else [""] * len(labels))
        axes.set_xlabel("difference in percentage points")
        axes.grid(axis="x", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, path, footer)


def _label(row: EffectRow | FactorialRow) -> str:
    if isinstance(row, EffectRow):
        return f"{row.axis}: {row.change}"
    return f"{row.factors}:\n{row.change}" if _interaction(row) else f"{row.factors}: {row.change}"


def _interaction(row: EffectRow | FactorialRow) -> bool:
    return isinstance(row, FactorialRow) and row.effect == "interaction"
