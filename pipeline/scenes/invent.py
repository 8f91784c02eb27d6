"""Invented objects: recipes drawn from wide ranges, as training data for an encoder."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.scenes.geometry import Bar, Body, Flat, Round, Wedge
from pipeline.scenes.recipe import Recipe
from pipeline.scenes.relief import AnyLayer, Creases, Digits, Domes, Grains, Plates, Ridges, Rough, Strands, Weave

MODULUS_MPA = (0.015, 100.0)
"""Beyond a hundred times the gel's modulus nothing changes."""


def invent(rng: np.random.Generator) -> Recipe:
    """Draw a body, up to three layers of relief and a modulus."""
    kinds = list(LAYERS)
    chances = np.array([LAYERS[k][0] for k in kinds])
    relief = [LAYERS[k][1](rng) for k, kept in zip(kinds, rng.random(len(kinds)) < chances, strict=True) if kept]
    rng.shuffle(relief)
    return Recipe(modulus=_log(rng, *MODULUS_MPA), body=_body(rng), relief=tuple(relief[:3]))


def _body(rng: np.random.Generator) -> Body:
    choice = rng.random()
    if choice < 0.25:
        return Flat()
    if choice < 0.75:
        first = _log(rng, 5, 300)
        second = first * _log(rng, 0.7, 1.4) if rng.random() < 0.5 else _log(rng, 5, 1000)
        return Round(radii=(first, second))
    if choice < 0.88:
        return Bar(width=_log(rng, 3, 25), edge=_log(rng, 0.3, 1.5))
    return Wedge(slope=_log(rng, 0.05, 0.8), tip=_log(rng, 0.3, 5))


def _rough(rng: np.random.Generator) -> AnyLayer:
    stretch = _log(rng, 2, 12) if rng.random() < 0.25 else 1.0
    return Rough(
        rms=_log(rng, 0.0004, 0.12),
        longest=_log(rng, 0.3, 6),
        hurst=rng.uniform(0.3, 1),
        stretch=stretch,
        angle=rng.uniform(0, 180),
    )


def _domes(rng: np.random.Generator) -> AnyLayer:
    width = _log(rng, 0.4, 7)
    return Domes(
        height=_height(rng, width),
        width=width,
        spacing=width * _log(rng, 1.0, 3),
        edge=_log(rng, 0.2, 1),
        jitter=rng.random(),
        occupied=rng.uniform(0.3, 1),
        uneven=rng.uniform(0, 0.6),
    )


def _ridges(rng: np.random.Generator) -> AnyLayer:
    width = _log(rng, 0.4, 8)
    return Ridges(
        height=_height(rng, width),
        width=width,
        spacing=width * _log(rng, 1.0, 4),
        edge=_log(rng, 0.2, 1),
        angle=rng.uniform(0, 180),
    )


def _plates(rng: np.random.Generator) -> AnyLayer:
    size = _log(rng, 1, 8)
    return Plates(
        height=_height(rng, size),
        size=(size, size * _log(rng, 0.6, 2)),
        gap=size * rng.uniform(0.1, 0.8),
        edge=_log(rng, 0.2, 1),
        uneven=rng.uniform(0, 0.4),
    )


def _weave(rng: np.random.Generator) -> AnyLayer:
    spacing = _log(rng, 0.35, 3)
    return Weave(
        spacing=spacing,
        thread=spacing * rng.uniform(0.6, 1.2),
        crimp=spacing * rng.uniform(0.05, 0.4),
        repeat=int(rng.choice((2, 2, 3, 4))),
    )


def _strands(rng: np.random.Generator) -> AnyLayer:
    width = _log(rng, 0.2, 4)
    return Strands(
        width=width,
        spacing=width * rng.uniform(1, 2),
        uneven=rng.uniform(0, 0.7),
        waver=_log(rng, 0.05, 2),
        bundles=int(rng.integers(1, 5)),
    )


def _grains(rng: np.random.Generator) -> AnyLayer:
    width = _log(rng, 0.8, 4)
    return Grains(
        length=width * _log(rng, 1, 3),
        width=width,
        thickness=width * rng.uniform(0.4, 0.9),
        packing=rng.uniform(0.8, 2.5),
        depth=rng.random(),
    )


def _creases(rng: np.random.Generator) -> AnyLayer:
    spacing = _log(rng, 0.8, 8)
    height = _height(rng, spacing) * 0.6
    return Creases(height=height if rng.random() < 0.5 else -height, spacing=spacing, fold=rng.random())


def _digits(rng: np.random.Generator) -> AnyLayer:
    size = _log(rng, 1.5, 6)
    sign = 1 if rng.random() < 0.7 else -1
    return Digits(
        height=sign * _log(rng, 0.05, 0.5),
        size=size,
        stroke=size * rng.uniform(0.1, 0.25),
        spacing=(size * rng.uniform(0.9, 2), size * rng.uniform(1.2, 2.5)),
    )


LAYERS: dict[str, tuple[float, Callable[[np.random.Generator], AnyLayer]]] = {
    "rough": (0.6, _rough),
    "domes": (0.22, _domes),
    "ridges": (0.18, _ridges),
    "plates": (0.06, _plates),
    "weave": (0.12, _weave),
    "strands": (0.1, _strands),
    "grains": (0.07, _grains),
    "creases": (0.1, _creases),
    "digits": (0.04, _digits),
}
"""Each with the chance that an object has it."""


def _height(rng: np.random.Generator, width: float) -> float:
    return min(width * _log(rng, 0.02, 0.35), 2.0)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
