"""The figures: confusion matrices, the map of the embeddings, the curves of the trainings.

Drawn without pyplot (no global state, no window) and saved without dates, so that equal input gives equal files.
Classes differ in colour (Okabe and Ito's, safe for the colour-blind) and in shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.io import atomic
from pipeline.videos.catalogue import Property
from pipeline.records import Measurement

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#E69F00", "#CC79A7", "#009E73", "#D55E00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
FEWEST_FOR_TSNE = 5
LARGEST_PERPLEXITY = 30
DPI = 150
MOST_ACROSS = 4
"""Panels in a row; further ones go below."""
MOST_MARKED = 40
"""Points up to which a curve shows them."""


@dataclass(frozen=True)
class Curve:
    """One line of a panel; curves of one label share a colour and one entry in the legend."""

    label: str
    points: Sequence[Measurement]
    dashed: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes with its curves."""

    title: str
    ylabel: str
    curves: Sequence[Curve]
    share: bool = False
    """Whether its values are shares, from 0 to 1."""


def draw_confusion(
    path: Path, properties: Sequence[Property], counts: Sequence[Sequence[Sequence[int]]], footer: str
) -> None:
    """One matrix a property (rated down, predicted across); numbers are videos, shades the share of the row."""
    import numpy as np

    most = max(len(p.levels) for p in properties)
    figure, panels = panels_of(len(properties), max(3.9, 0.95 * most), max(3.7, 0.9 * most))
    for axes, p, matrix in zip(panels, properties, map(np.array, counts), strict=True):
        shares = matrix / np.maximum(matrix.sum(axis=1, keepdims=True), 1)
        axes.imshow(shares, cmap="Blues", vmin=0, vmax=1)
        for (row, column), count in np.ndenumerate(matrix):
            # Below this share of "Blues" black has the better contrast.
            colour = "white" if shares[row, column] > 0.7 else "black"
            axes.text(column, row, str(count), ha="center", va="center", color=colour, fontsize=12)
        places, words = range(len(p.levels)), [level.replace(" ", "\n") for level in p.levels]
        axes.set_xticks(places, words)
        axes.set_yticks(places, words)
        axes.set_xlabel("predicted")
        axes.set_ylabel("rated")
        right = int(matrix.trace())
        axes.set_title(f"{p.name}: {right} of {int(matrix.sum())} right")
        axes.tick_params(length=0)
    save(figure, path, footer)


def draw_embedding_map(
    path: Path, features: np.ndarray, labels: Sequence[Sequence[int]], properties: Sequence[Property], footer: str
) -> None:
    """Videos in the plane, one panel a property.

    Args:
        features: float, videos x dim: the mean embedding of each video; at least two videos.
        labels: one tuple of class indices a video.
    """
    maps = project(features)
    figure, panels = panels_of(len(maps) * len(properties), 3.9, 4.0, across=len(properties))
    rows = [(places, method, index, p) for method, places in maps.items() for index, p in enumerate(properties)]
    for axes, (places, method, index, p) in zip(panels, rows, strict=True):
        for level, name in enumerate(p.levels):
            chosen = [i for i, label in enumerate(labels) if label[index] == level]
            axes.scatter(
                places[chosen, 0],
                places[chosen, 1],
                c=_colour(level),
                marker=_marker(level),
                s=42,
                edgecolors="white",
                linewidths=0.5,
                label=f"{name} ({len(chosen)})",
            )
        axes.set_title(p.name)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlabel(f"{method} 1")
        axes.set_ylabel(f"{method} 2")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, frameon=False, fontsize=9)
    save(figure, path, footer)


def project(features: np.ndarray) -> dict[str, np.ndarray]:
    """Two dimensions of videos x dim by the method's name: PCA, and t-SNE from five videos on."""
    import numpy as np
    from sklearn.decomposition import PCA
    from sklearn.manifold import TSNE

    count = len(features)
    # Two videos span one dimension at the most; the second is drawn as 0.
    flat = PCA(n_components=min(2, count - 1), svd_solver="full").fit_transform(features)
    maps = {"PCA": np.pad(flat, ((0, 0), (0, 2 - flat.shape[1])))}
    if count >= FEWEST_FOR_TSNE:
        perplexity = min(LARGEST_PERPLEXITY, (count - 1) / 3)
        # The exact method adds in one order; Barnes-Hut adds in as many as there are threads.
        exact = TSNE(perplexity=perplexity, init="pca", method="exact", random_state=0)
        maps["t-SNE"] = exact.fit_transform(features)
    return maps


def draw_curves(path: Path, panels: Sequence[Panel], footer: str) -> None:
    """The trainings' values over their optimiser steps."""
    from matplotlib.lines import Line2D

    figure, places = panels_of(len(panels), 3.9, 3.9)
    for axes, panel in zip(places, panels, strict=True):
        labels = list(dict.fromkeys(curve.label for curve in panel.curves))
        colours = {label: _colour(i) for i, label in enumerate(labels)}
        # Hollow shapes show lines that lie on each other, and a curve of one point.
        marked = max((len(curve.points) for curve in panel.curves), default=0) <= MOST_MARKED
        shapes = {label: _marker(i) if marked else "" for i, label in enumerate(labels)}
        for curve in panel.curves:
            steps, values = [m.step for m in curve.points], [m.value for m in curve.points]
            style, marker, colour = "--" if curve.dashed else "-", shapes[curve.label], colours[curve.label]
            axes.plot(steps, values, style, color=colour, marker=marker, mfc="none", markersize=6, linewidth=1.6)
        axes.set_title(panel.title)
        axes.set_xlabel("optimiser step")
        axes.set_ylabel(panel.ylabel)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        if panel.share:
            axes.set_ylim(-0.04, 1.04)
        keys = [Line2D([], [], color=colours[x], marker=shapes[x], mfc="none", label=x) for x in labels]
        if any(curve.dashed for curve in panel.curves):
            keys.append(Line2D([], [], color="grey", linestyle="--", label="base CLIP"))
        axes.legend(handles=keys, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2, frameon=False, fontsize=9)
    save(figure, path, footer)


def training_panels(
    encoder: Mapping[str, Sequence[Measurement]], language: Mapping[str, Sequence[Curve]]
) -> list[Panel]:
    """Panels of what was trained: loss and validation accuracy of the encoder, loss of each stage in `language`.

    Args:
        encoder: history by seed.
        language: curves of all measurements by the stage's title.
    """
    panels = []
    losses = [
        Curve(label, found)
        for points in encoder.values()
        for label, name in (("training", "loss"), ("validation", "validation_loss"))
        if (found := _named(points, name))
    ]
    scores = [
        Curve(name.removeprefix("validation_"), _named(points, name))
        for points in encoder.values()
        for name in dict.fromkeys(m.name for m in points)
        if name.startswith("validation_") and not name.endswith("loss")
    ]
    panels += [Panel("Encoder", "loss", losses)] if losses else []
    panels += [Panel("Encoder", "validation accuracy", scores, share=True)] if scores else []
    for title, curves in language.items():
        shown = [Curve(c.label, _named(c.points, "loss"), c.dashed) for c in curves]
        panels += [Panel(title, "training loss", shown)] if shown else []
    return panels


def _named(points: Sequence[Measurement], name: str) -> list[Measurement]:
    return sorted((m for m in points if m.name == name), key=lambda m: m.step)


def panels_of(count: int, width: float, height: float, across: int = MOST_ACROSS) -> tuple[Figure, Sequence[Axes]]:
    """A figure of so many panels, each of this width and height in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    across = min(count, across)
    down = -(-count // across)
    figure = Figure(figsize=(width * across, height * down), layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(down, across, squeeze=False).flat)
    for unused in panels[count:]:
        unused.remove()
    return figure, panels[:count]


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _marker(number: int) -> str:
    # Shifted by one each time that the colours begin anew, so that no pair of colour and shape soon comes again.
    return MARKERS[(number + number // len(COLOURS)) % len(MARKERS)]


def save(figure: Figure, path: Path, footer: str) -> None:
    """Write a figure with a line of small print, equal bytes for equal figures."""
    figure.supxlabel(footer, fontsize=8, color="#555555", x=0.995, ha="right")
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})
