"""The figures of a report, as PNG: effects, confusion of the heads, training curves.

Drawn without pyplot (no global state, no window) and saved without dates, so that equal input gives equal files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from pipeline.core.io import atomic
from pipeline.report.tables import PARTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED, QUIET, LINE = "#0a5fb4", "#555b66", "#c9ced6"
SERIES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, safe for the colour-blind."""
DPI = 150


def draw_figures(
    folder: Path,
    effects: pd.DataFrame,
    confusion: pd.DataFrame,
    curves: pd.DataFrame,
    maps: pd.DataFrame,
    properties: Mapping[str, Sequence[str]],
) -> list[str]:
    """Draw what there is figures for and remove figures of an earlier run.

    Args:
        confusion: property, rated, predicted; one row a video.
        curves: stage, name, step, value.
        maps: encoder, method, x, y, and a column a property with classes.
        properties: the classes of each, in rising order.

    Returns:
        The names of the files, in reading order.
    """
    drawn: dict[str, Figure] = {}
    if len(effects):
        drawn["effects.png"] = draw_effects(effects)
    if len(confusion):
        drawn["confusion.png"] = draw_confusion(confusion, properties)
    if len(maps):
        drawn["map.png"] = draw_maps(maps, properties)
    if (curves["name"] == "loss").any():
        drawn["curves.png"] = draw_curves(curves)
    for old in folder.glob("*.png"):
        if old.name not in drawn:
            old.unlink()
    for name, figure in drawn.items():
        with atomic(folder / name) as temporary:
            figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})
    return list(drawn)


def draw_effects(effects: pd.DataFrame) -> Figure:
    """A panel a part of the system: differences with intervals, by task; solid where Holm's p is below .05."""
    from matplotlib.ticker import MaxNLocator

    parts = list(dict.fromkeys(zip(effects["part"], effects["change"], strict=True)))
    labels = list(dict.fromkeys(zip(effects["task"], effects["measure"], strict=True)))
    figure, places = _panels(len(parts), 2.7, 1.1 + 0.3 * len(labels), left=1.3)
    reach = 100 * max(1e-3, float(effects[["difference", "low", "high"]].abs().max().max()))
    for number, (axes, (part, change)) in enumerate(zip(places, parts, strict=True)):
        rows = effects[(effects["part"] == part) & (effects["change"] == change)]
        for row in rows.to_dict("records"):
            height = -labels.index((row["task"], row["measure"]))
            if pd.notna(row["low"]):
                ends = [100 * row["low"], 100 * row["high"]]
                axes.plot(ends, [height] * 2, color=MEASURED, alpha=0.45, linewidth=4, solid_capstyle="round")
            face = MEASURED if row["p_holm"] < 0.05 else "white"
            axes.plot(100 * row["difference"], height, "o", color=MEASURED, markerfacecolor=face, markersize=6)
        axes.axvline(0, color=QUIET, linewidth=0.9)
        axes.set_title(f"{PARTS.get(part, part)}\n{change}", fontsize=10)
        axes.xaxis.set_major_locator(MaxNLocator(4, prune="both"))
        axes.set_xlim(-1.06 * reach, 1.06 * reach)
        axes.set_ylim(-len(labels) + 0.4, 0.6)
        names = [task if measure in ("choice", "combined") else f"{task} {measure}" for task, measure in labels]
        axes.set_yticks([-i for i in range(len(labels))], names if number % 4 == 0 else [""] * len(labels))
        axes.set_xlabel("points", fontsize=9)
        axes.grid(axis="x", alpha=0.25)
        _quiet(axes)
    return figure


def draw_confusion(confusion: pd.DataFrame, properties: Mapping[str, Sequence[str]]) -> Figure:
    """One matrix a property, with all its classes: rated down, predicted across, in videos."""
    from sklearn.metrics import ConfusionMatrixDisplay

    names = list(dict.fromkeys(confusion["property"]))
    figure, places = _panels(len(names), 3.6, 3.4)
    for axes, name in zip(places, names, strict=True):
        rows = confusion[confusion["property"] == name]
        levels = properties[name]
        ConfusionMatrixDisplay.from_predictions(
            rows["rated"], rows["predicted"], labels=levels, ax=axes, cmap="Blues", colorbar=False
        )
        words = [level.replace(" ", "\n") for level in levels]
        axes.set_xticklabels(words, fontsize=9)
        axes.set_yticklabels(words, fontsize=9)
        axes.set_xlabel("predicted")
        axes.set_ylabel("rated" if name == names[0] else "")
        axes.set_title(f"{name}: {(rows['rated'] == rows['predicted']).sum()} of {len(rows)} right", fontsize=10)
        axes.tick_params(length=0)
    return figure


def draw_maps(maps: pd.DataFrame, properties: Mapping[str, Sequence[str]]) -> Figure:
    """Test videos by their mean embedding, coloured by class: a row a property, a column a method and encoder."""
    columns = list(dict.fromkeys(zip(maps["method"], maps["encoder"], strict=True)))
    figure, places = _panels(len(properties) * len(columns), 2.6, 2.6, across=len(columns))
    for number, axes in enumerate(places):
        name, (method, encoder) = list(properties)[number // len(columns)], columns[number % len(columns)]
        rows = maps[(maps["method"] == method) & (maps["encoder"] == encoder)]
        for level, color in zip(properties[name], SERIES, strict=False):
            own = rows[rows[name] == level]
            axes.plot(own["x"], own["y"], "o", color=color, markersize=3, alpha=0.8, label=level)
        axes.set_xticks([])
        axes.set_yticks([])
        if number < len(columns):
            axes.set_title(f"{method}, {encoder}", fontsize=10)
        if number % len(columns) == 0:
            axes.set_ylabel(name, fontsize=10)
            axes.legend(frameon=False, fontsize=7, loc="best", handletextpad=0.1)
        _quiet(axes)
    return figure


def draw_curves(curves: pd.DataFrame) -> Figure:
    """The loss of each training over its optimiser steps: a panel a stage, a colour a variant, a line a seed."""
    from matplotlib.lines import Line2D

    losses = curves[curves["name"].isin(["loss", "validation_loss"])]
    stages = losses["stage"].str.split("@").str[0]
    names = list(dict.fromkeys(stages))
    figure, places = _panels(len(names), 3.4, 3.1)
    for axes, name in zip(places, names, strict=True):
        lines = list(losses[stages == name].groupby(["stage", "name"], sort=False))
        labels: dict[str, int] = {}
        for (stage, measure), points in lines:
            variant = str(stage).partition("@")[2].rpartition("-")[0]
            label = variant or {"loss": "training", "validation_loss": "validation"}[measure]
            number = labels.setdefault(label, len(labels))
            few = "o" if len(points) == 1 else ""
            axes.plot(points["step"], points["value"], marker=few, color=SERIES[number % len(SERIES)], linewidth=1.3)
        axes.set_title(name.replace("_", " "), fontsize=10)
        axes.set_xlabel("optimiser step", fontsize=9)
        axes.set_ylabel("loss" if name == names[0] else "", fontsize=9)
        axes.grid(alpha=0.25)
        _quiet(axes)
        if len(labels) <= len(SERIES):
            named = [Line2D([], [], color=SERIES[number], label=label) for label, number in labels.items()]
            axes.legend(handles=named, frameon=False, fontsize=7.5)
    return figure


def _panels(count: int, width: float, height: float, left: float = 0.0, across: int = 4) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels, `across` in a row, each of this width and height in inches, with room at the left."""
    from matplotlib.figure import Figure

    across, down = min(count, across), -(-count // across)
    figure = Figure(figsize=(width * across + left, height * down), layout="constrained")
    grid = list(figure.subplots(down, across, squeeze=False).flat)
    for unused in grid[count:]:
        unused.remove()
    return figure, grid[:count]


def _quiet(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    for spine in axes.spines.values():
        spine.set_color(LINE)
    axes.tick_params(colors=QUIET, labelcolor="#1a1d23", labelsize=9)
