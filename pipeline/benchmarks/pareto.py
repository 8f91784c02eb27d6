"""Which settings are worth their cost, and a picture of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.artifacts import atomic
from pipeline.benchmarks import BenchRow


def front(rows: Sequence[BenchRow]) -> list[BenchRow]:
    """The rows that no other row beats by being as cheap and better, or cheaper and as good; in order of rising cost.

    Rows without an error do not count.
    """
    best: list[BenchRow] = []
    for row in sorted((r for r in rows if r.error is not None), key=lambda r: (r.cost, r.error)):
        assert row.error is not None, "rows without an error were left out"
        if not best or best[-1].error is None or row.error < best[-1].error:
            best.append(row)
    return best


def draw_pareto(rows: Sequence[BenchRow], path: Path, title: str, error: str) -> None:
    """Draw cost against error with intervals; the front is a line, the names of its points are bold."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import ScalarFormatter

    ahead = front(rows)
    figure, axes = plt.subplots(figsize=(9, 6), constrained_layout=True)
    groups = list(dict.fromkeys(row.case.split(",")[0] for row in rows))
    markers = "osD^vPX*"
    for number, group in enumerate(groups):
        points = [r for r in rows if r.case.split(",")[0] == group and r.error is not None]
        errors = [r.error or 0.0 for r in points]
        spread = [
            [e - r.low for e, r in zip(errors, points, strict=True)],
            [r.high - e for e, r in zip(errors, points, strict=True)],
        ]
        axes.errorbar(
            [r.cost for r in points],
            errors,
            yerr=spread,
            fmt=markers[number % len(markers)],
            label=group,
            capsize=2,
            elinewidth=0.7,
            alpha=0.85,
        )
    axes.plot([r.cost for r in ahead], [r.error for r in ahead], color="black", linewidth=1, zorder=0, label="front")
    for number, row in enumerate(sorted((r for r in rows if r.error is not None), key=lambda r: r.cost)):
        # The group is in the legend; above and below by turns, since neighbours lie close together.
        place, shift = (row.cost, row.error or 0.0), (10 if number % 2 else -16)
        name = row.case.split(", ")[-1]
        weight = "bold" if row in ahead else "normal"
        axes.annotate(name, place, xytext=(4, shift), textcoords="offset points", fontsize=7, fontweight=weight)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(ScalarFormatter())
    axes.set_xlabel(f"cost ({rows[0].unit})")
    axes.set_ylabel(error)
    axes.set_title(title)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=130, format="png", metadata={"Software": None})
    plt.close(figure)
