"""What a catalogue's labels mean in millimetres and megapascals: the physical parameters of every object.

The classes are the annotators' (paper, "Dataset Collection"): hardness by how far an object yields, roughness by its
grain, bumpiness by the size of what sticks out, against a quarter of the image. Each object draws its parameters from
its classes' ranges by its own seed, so that objects of one class differ and all videos of an object share them.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from pipeline.errors import UserError
from pipeline.physiclear.catalogue import Catalogue, Object
from pipeline.runtime import derive_seed
from pipeline.scenes.geometry import IMAGE_MM, BumpShape, Surface

Range = tuple[float, float]

MODULUS_MPA: tuple[Range, ...] = ((0.02, 0.08), (0.15, 0.6), (10.0, 1000.0))
"""Reduced modulus E* by hardness: foam and down; rubber, fruit and cloth; wood, hard plastic and metal."""
GRAIN_MM: tuple[Range, ...] = ((0.0003, 0.001), (0.009, 0.016), (0.03, 0.05))
"""Root mean square height of the grain by roughness."""
GRAIN_LENGTH_MM: tuple[Range, ...] = ((0.3, 0.6), (0.35, 0.6), (0.7, 1.2))
"""Longest wavelength of the grain by roughness."""
BUMP_SHARE: tuple[Range, ...] = ((0.0, 0.0), (0.07, 0.16), (0.29, 0.5))
"""Width of a bump by bumpiness, as a share of the image's height; the paper's border is 1/4."""
BUMP_STEEPNESS: Range = (0.1, 0.18)
"""Height of a bump over its width."""
RADII_MM: dict[str, tuple[Range, Range]] = {
    "flat": ((40.0, 120.0), (40.0, 120.0)),
    "round": ((18.0, 45.0), (18.0, 45.0)),
    "barrel": ((8.0, 20.0), (80.0, 300.0)),
}
"""Radii of curvature across and along a body."""
LIMP = ("fabric", "paper")
"""Materials that lie flat; of these, fabric is woven."""
HELD = ("handle", "barrel", "grip")
"""Parts that are thicker in no direction but one."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """An object as physics sees it."""

    modulus: float
    """Reduced modulus E / (1 - nu^2) in MPa."""
    surface: Surface


def recipe_of(object_id: str, catalogue: Catalogue, seed: int) -> Recipe:
    """The parameters of an object of the catalogue.

    Raises:
        UserError: where the catalogue lacks one of the three properties that scenes are made from, or has it with
            other than three classes. Further properties leave no trace in a scene.
    """
    levels = dict(zip(catalogue.property_names, catalogue.labels(object_id), strict=True))
    three = {p.name for p in catalogue.properties if len(p.levels) == 3}
    needed = ("hardness", "roughness", "bumpiness")
    if not three.issuperset(needed):
        raise UserError(
            f"data.catalogue: scenes need the properties {', '.join(needed)} with three classes each; set "
            "data.source=videos for a catalogue with others"
        )
    rng = random.Random(derive_seed(seed, "object", object_id))
    described = catalogue.objects[object_id]
    across, along = RADII_MM[_body(described, rng)]
    width = rng.uniform(*BUMP_SHARE[levels["bumpiness"]]) * IMAGE_MM[1]
    shape: BumpShape = "weave" if described.material == "fabric" else rng.choice(("domes", "domes", "ridges"))
    surface = Surface(
        radii=(_log_uniform(rng, across), _log_uniform(rng, along)),
        bump_shape=shape,
        bump_width=width,
        bump_height=width * rng.uniform(*BUMP_STEEPNESS),
        bump_spacing=width * rng.uniform(1.15, 1.7),
        grain=_log_uniform(rng, GRAIN_MM[levels["roughness"]]),
        grain_length=rng.uniform(*GRAIN_LENGTH_MM[levels["roughness"]]),
    )
    return Recipe(modulus=_log_uniform(rng, MODULUS_MPA[levels["hardness"]]), surface=surface)


def _body(described: Object, rng: random.Random) -> str:
    if described.material in LIMP:
        return "flat"
    return "barrel" if described.part in HELD else rng.choice(("flat", "round"))


def _log_uniform(rng: random.Random, bounds: Range) -> float:
    return math.exp(rng.uniform(math.log(bounds[0]), math.log(bounds[1])))
