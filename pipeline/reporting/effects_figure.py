"""What each part of the system brings, as a figure: a point and an interval for each task and change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.reporting.answered import FAILED
from pipeline.reporting.figures import COLOURS, panels_of, save
from pipeline.reporting.language_rows import EffectRow


def draw_effects(path: Path, rows: Sequence[EffectRow], footer: str) -> None:
    """One panel a task, one line a change; hollow where the base model fails the task's gate.

    Args:
        rows: With the same others, in the order in which they are to stand.
    """
    tasks = list(dict.fromkeys(row.task for row in rows))
    changes = list(dict.fromkeys(f"{row.axis}: {row.change}" for row in rows))
    figure, panels = panels_of(len(tasks), 3.3, 1.5 + 0.42 * len(changes), across=3)
    # One scale for all panels, so that lengths can be compared.
    reach = max((abs(end) for row in rows for end in (row.low, row.high, row.difference) if end is not None), default=1)
    for number, (axes, task) in enumerate(zip(panels, tasks, strict=True)):
        for row in (r for r in rows if r.task == task):
            height = -changes.index(f"{row.axis}: {row.change}")
            face = "white" if row.gate.startswith(FAILED) else COLOURS[0]
            if row.low is not None and row.high is not None:
                axes.plot([100 * row.low, 100 * row.high], [height, height], color=COLOURS[0], linewidth=1.8)
            axes.plot(100 * row.difference, height, "o", color=COLOURS[0], markerfacecolor=face, markersize=6)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_title(task)
        axes.set_xlim(-105 * reach, 105 * reach)
        axes.set_ylim(-len(changes) + 0.5, 0.5)
        axes.set_yticks([-i for i in range(len(changes))], changes if number % 3 == 0 else [""] * len(changes))
        axes.set_xlabel("difference in percentage points")
        axes.grid(axis="x", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, path, footer)
