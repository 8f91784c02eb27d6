"""Invented objects: recipes drawn from wide ranges, as training data for an encoder."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np

from pipeline.scenes.geometry import Bar, Body, Flat, Round, Wedge
from pipeline.scenes.recipe import SceneRecipe
from pipeline.scenes.relief import AnyLayer, Creases, Digits, Domes, Grains, Plates, Ridges, Rough, Strands, Weave

MODULUS_MPA = (0.015, 100.0)
"""Beyond a hundred times the gel's modulus nothing changes."""
LAYERS = {
    "rough": 0.6,
    "domes": 0.22,
    "ridges": 0.18,
    "plates": 0.06,
    "weave": 0.12,
    "strands": 0.1,
    "grains": 0.07,
    "creases": 0.1,
    "digits": 0.04,
}
"""The chance that an object has a layer of this kind."""


def invent(rng: np.random.Generator) -> SceneRecipe:
    """Draw a body, up to three layers of relief and a modulus."""
    kept = rng.random(len(LAYERS)) < np.array(list(LAYERS.values()))
    relief = [_layer(kind, rng) for kind in itertools.compress(LAYERS, kept)]
    rng.shuffle(relief)
    return SceneRecipe(modulus=_log(rng, *MODULUS_MPA), body=_body(rng), relief=tuple(relief[:3]))


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


def _layer(kind: str, rng: np.random.Generator) -> AnyLayer:
    """A layer of this kind. What is wider is mostly higher and farther apart as well."""
    log, even = partial(_log, rng), rng.uniform
    if kind == "rough":
        stretch = log(2, 12) if rng.random() < 0.25 else 1.0
        rms, longest, hurst = log(0.0004, 0.12), log(0.3, 6), even(0.3, 1)
        return Rough(rms=rms, longest=longest, hurst=hurst, stretch=stretch, angle=even(0, 180))
    if kind == "domes":
        width = log(0.4, 7)
        return Domes(
            height=_height(rng, width),
            width=width,
            spacing=width * log(1.0, 3),
            edge=log(0.2, 1),
            jitter=rng.random(),
            occupied=even(0.3, 1),
            uneven=even(0, 0.6),
        )
    if kind == "ridges":
        width = log(0.4, 8)
        height, spacing, edge = _height(rng, width), width * log(1.0, 4), log(0.2, 1)
        return Ridges(height=height, width=width, spacing=spacing, edge=edge, angle=even(0, 180))
    if kind == "plates":
        across = log(1, 8)
        height, along, gap = _height(rng, across), across * log(0.6, 2), across * even(0.1, 0.8)
        return Plates(height=height, size=(across, along), gap=gap, edge=log(0.2, 1), uneven=even(0, 0.4))
    if kind == "weave":
        spacing = log(0.35, 3)
        thread, crimp = spacing * even(0.6, 1.2), spacing * even(0.05, 0.4)
        return Weave(spacing=spacing, thread=thread, crimp=crimp, repeat=int(rng.choice((2, 2, 3, 4))))
    if kind == "strands":
        width = log(0.2, 4)
        spacing, uneven, waver = width * even(1, 2), even(0, 0.7), log(0.05, 2)
        return Strands(width=width, spacing=spacing, uneven=uneven, waver=waver, bundles=int(rng.integers(1, 5)))
    if kind == "grains":
        width = log(0.8, 4)
        length, thickness, packing = width * log(1, 3), width * even(0.4, 0.9), even(0.8, 2.5)
        return Grains(length=length, width=width, thickness=thickness, packing=packing, depth=rng.random())
    if kind == "creases":
        spacing = log(0.8, 8)
        height = _height(rng, spacing) * 0.6
        return Creases(height=height if rng.random() < 0.5 else -height, spacing=spacing, fold=rng.random())
    size, sign = log(1.5, 6), 1 if rng.random() < 0.7 else -1
    height, stroke, apart = sign * log(0.05, 0.5), size * even(0.1, 0.25), size * even(0.9, 2)
    return Digits(height=height, size=size, stroke=stroke, spacing=(apart, size * even(1.2, 2.5)))


def _height(rng: np.random.Generator, width: float) -> float:
    return min(width * _log(rng, 0.02, 0.35), 2.0)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
