"""The figures of a report, as PNG: effects, confusion of the heads, maps of embeddings, training curves.

Drawn without pyplot (no global state, no window) and saved without dates, so that equal input gives equal files.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence

import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from sklearn.metrics import ConfusionMatrixDisplay

from pipeline.core.io import atomic
from pipeline.report.load import Report
from pipeline.report.render import WORDS
from pipeline.report.tables import marked, ordered, over_seeds, system

MEASURED, QUIET, LINE, TEXT = "#0a5fb4", "#555b66", "#c9ced6", "#1a1d23"
SERIES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, safe for the colour-blind."""
TICKS = {"color": QUIET, "labelcolor": TEXT, "labelsize": 9}
STYLE = {
    "savefig.dpi": 150,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "axes.edgecolor": LINE,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    **{f"{axis}tick.{key}": value for axis in "xy" for key, value in TICKS.items()},
}


def draw_figures(report: Report) -> list[str]:
    """Draw what there is figures for into figures/ of a report, and remove those of an earlier run.

    Returns:
        The names of the files, in reading order.
    """
    folder, effects, properties = report.folder / "figures", report.effects, report.provenance["properties"]
    # Classes are words, even where they read like numbers or like nothing.
    confusion = pd.read_csv(report.folder / "confusion.csv", dtype=str, keep_default_na=False)
    curves = pd.read_csv(report.folder / "curves.csv")
    words = {**dict.fromkeys(properties, str), "x": float, "y": float}
    maps = pd.read_csv(report.folder / "map.csv", dtype=words, keep_default_na=False)
    drawn: dict[str, Figure] = {}
    with rc_context(STYLE):
        if len(learnt := marked(over_seeds(report.scores)).query("whole and rated.notna()")):
            drawn["ratings.png"] = draw_ratings(learnt)
        if len(effects):
            drawn["effects.png"] = draw_effects(effects)
        if len(confusion):
            drawn["confusion.png"] = draw_confusion(confusion, properties)
        if len(maps):
            drawn["map.png"] = draw_maps(maps, properties)
        if (curves["name"] == "loss").any():
            drawn["curves.png"] = draw_curves(curves)
        for name, figure in drawn.items():
            with atomic(folder / name) as temporary:
                figure.savefig(temporary, format="png", metadata={"Software": None})
    for old in folder.glob("*.png"):
        if old.name not in drawn:
            old.unlink()
    return list(drawn)


def draw_effects(effects: pd.DataFrame) -> Figure:
    """A panel a part of the system: differences with intervals, by task; solid where Holm's p is below .05."""
    panels = effects.groupby(["part", "change"], sort=False)
    labels = list(dict.fromkeys(zip(effects["task"], effects["measure"], strict=True)))
    names = [task if measure in ("choice", "combined") else f"{task} {measure}" for task, measure in labels]
    figure, places = _panels(len(panels), 2.7, 1.1 + 0.3 * len(labels), left=1.3)
    reach = 106 * max(1e-3, float(effects[["difference", "low", "high"]].abs().max().max()))
    for number, (axes, ((part, change), rows)) in enumerate(zip(places, panels, strict=True)):
        for row in rows.to_dict("records"):
            height = -labels.index((row["task"], row["measure"]))
            if pd.notna(row["low"]):
                ends = [100 * row["low"], 100 * row["high"]]
                axes.plot(ends, [height] * 2, color=MEASURED, alpha=0.45, linewidth=4, solid_capstyle="round")
            face = MEASURED if row["p_holm"] < 0.05 else "white"
            axes.plot(100 * row["difference"], height, "o", color=MEASURED, markerfacecolor=face)
        axes.axvline(0, color=QUIET, linewidth=0.9)
        axes.xaxis.set_major_locator(MaxNLocator(4, prune="both"))
        axes.set(xlim=(-reach, reach), ylim=(-len(labels) + 0.4, 0.6), xlabel="points")
        axes.set_title(f"{WORDS['parts'].get(part, part)}\n{textwrap.fill(change, 36)}")
        axes.set_yticks([-i for i in range(len(labels))], names if number % 4 == 0 else [""] * len(labels))
        axes.grid(axis="x")
    return figure


def draw_ratings(learnt: pd.DataFrame) -> Figure:
    """The learning curve: a panel a task, accuracy with its interval by rated objects, a line a system, and chance."""
    panels = ordered(learnt).groupby("task", sort=False)
    places = {count: place for place, count in enumerate(sorted(learnt["rated"].unique()))}
    figure, axes = _panels(len(panels), 2.7, 2.6)
    for own, (task, rows) in zip(axes, panels, strict=True):
        names = rows.assign(system=[system(row) for row in rows.to_dict("records")]).groupby("system", sort=False)
        for number, (name, line) in enumerate(names):
            x = line["rated"].map(places) + 0.08 * number
            spans = 100 * abs(line[["low", "high"]].sub(line["accuracy"], axis=0).T.to_numpy())
            own.errorbar(x, 100 * line["accuracy"], spans, fmt="o-", color=SERIES[number % len(SERIES)], label=name)
        own.axhline(100 * rows["chance"].iloc[0], color=QUIET, linewidth=0.9, linestyle=":", label="chance")
        own.set(title=task, ylim=(0, 100), xlabel="rated objects", ylabel="right, %" if own is axes[0] else "")
        own.set_xticks([*places.values()], [f"{count:.0f}" for count in places])
        own.grid(axis="y")
    axes[0].legend(loc="upper left")
    return figure


def draw_confusion(confusion: pd.DataFrame, properties: Mapping[str, Sequence[str]]) -> Figure:
    """One matrix a property, with all its classes: rated down, predicted across, in videos."""
    panels = confusion.groupby("property", sort=False)
    figure, places = _panels(len(panels), 3.6, 3.4)
    for axes, (name, rows) in zip(places, panels, strict=True):
        levels = properties[str(name)]
        ConfusionMatrixDisplay.from_predictions(
            rows["rated"], rows["predicted"], labels=levels, ax=axes, cmap="Blues", colorbar=False
        )
        words = [level.replace(" ", "\n") for level in levels]
        axes.set(xticklabels=words, yticklabels=words, xlabel="predicted", ylabel="rated" if axes is places[0] else "")
        axes.set_title(f"{name}: {(rows['rated'] == rows['predicted']).sum()} of {len(rows)} right")
        axes.tick_params(length=0)
    return figure


def draw_maps(maps: pd.DataFrame, properties: Mapping[str, Sequence[str]]) -> Figure:
    """Test videos by their mean embedding, coloured by class: a row a property, a column a method and encoder."""
    columns = maps.groupby(["method", "encoder"], sort=False)
    figure, places = _panels(len(properties) * len(columns), 2.6, 2.6, across=len(columns))
    panels = [(name, *column) for name in properties for column in columns]
    for number, (axes, (name, (method, encoder), rows)) in enumerate(zip(places, panels, strict=True)):
        for level, color in zip(properties[name], itertools.cycle(SERIES), strict=False):
            own = rows[rows[name] == level]
            axes.plot(own["x"], own["y"], "o", color=color, markersize=3, alpha=0.8, label=level)
        axes.set(xticks=[], yticks=[], title=f"{method}, {encoder}" if number < len(columns) else "")
        if number % len(columns) == 0:
            axes.set_ylabel(name)
            axes.legend(loc="best", handletextpad=0.1)
    return figure


def draw_curves(curves: pd.DataFrame) -> Figure:
    """The loss of each training over its optimiser steps: a panel a stage, a colour a variant, a line a seed."""
    losses = curves[curves["name"].isin(["loss", "validation_loss"])]
    panels = losses.groupby(losses["stage"].str.split("@").str[0], sort=False)
    figure, places = _panels(len(panels), 3.4, 3.1)
    for axes, (name, lines) in zip(places, panels, strict=True):
        labels: dict[str, int] = {}
        for (stage, measure), points in lines.groupby(["stage", "name"], sort=False):
            variant = str(stage).partition("@")[2].rpartition("-")[0]
            label = variant or {"loss": "training", "validation_loss": "validation"}[measure]
            number = labels.setdefault(label, len(labels))
            few = "o" if len(points) == 1 else ""
            axes.plot(points["step"], points["value"], marker=few, color=SERIES[number % len(SERIES)], linewidth=1.3)
        axes.set(title=str(name).replace("_", " "), xlabel="optimiser step")
        axes.set_ylabel("loss" if axes is places[0] else "")
        axes.grid()
        if len(labels) <= len(SERIES):
            axes.legend(handles=[Line2D([], [], color=SERIES[n], label=label) for label, n in labels.items()])
    return figure


def _panels(count: int, width: float, height: float, left: float = 0.0, across: int = 4) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels, `across` in a row, each of this width and height in inches, with room at the left."""
    across, down = min(count, across), -(-count // across)
    figure = Figure(figsize=(width * across + left, height * down), layout="constrained")
    grid = list(figure.subplots(down, across, squeeze=False).flat)
    for unused in grid[count:]:
        unused.remove()
    return figure, grid[:count]
