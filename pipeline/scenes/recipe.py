"""What an object is made of, as physics sees it: listed in a catalogue's `scenes.yaml`, or drawn from its labels.

Each listed object has a few lines of YAML (docs/scenes.md). One that is not listed draws its parameters from its
classes' ranges by its own seed, so that objects of one class differ. All videos of an object share its recipe.
"""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Annotated

import yaml
from pydantic import Field, ValidationError

from pipeline.config.params import OneKeyLoader
from pipeline.core.records import Record
from pipeline.core.runtime import derive_seed
from pipeline.running.errors import UserError, first_problem
from pipeline.scenes.geometry import IMAGE_MM, Body, Flat, Round
from pipeline.scenes.relief import AnyLayer, Domes, Ridges, Rough
from pipeline.videos.catalogue import Catalogue

SCENES = "scenes.yaml"
Range = tuple[float, float]

MODULUS_MPA: tuple[Range, ...] = ((0.02, 0.08), (0.15, 0.6), (10.0, 1000.0))
"""Reduced modulus E* by hardness: foam and down; rubber, fruit and cloth; wood, hard plastic and metal."""
ROUGH_RMS_MM: tuple[Range, ...] = ((0.0003, 0.001), (0.007, 0.01), (0.028, 0.04))
"""Root mean square height of the roughness."""
ROUGH_LONGEST_MM: Range = (0.4, 0.6)
"""Its longest wavelength, below what counts as shape (`measure.TEXTURE_MM`)."""
BUMP_SHARE: tuple[Range, ...] = ((0.0, 0.0), (0.15, 0.19), (0.45, 0.6))
"""Width of a bump by bumpiness, as a share of the image's height; the paper's border is 1/4 of the image."""
BUMP_STEEPNESS: Range = (0.14, 0.19)
"""Height of a bump over its width."""
RADII_MM: dict[str, tuple[Range, Range]] = {
    "flat": ((40.0, 120.0), (40.0, 120.0)),
    "round": ((18.0, 45.0), (18.0, 45.0)),
    "barrel": ((8.0, 20.0), (80.0, 300.0)),
}
"""Radii of curvature across and along a body."""
LIMP = ("fabric", "paper")
"""Materials that lie flat."""
HELD = ("handle", "barrel", "grip")
"""Parts that are thicker in no direction but one."""


class SceneRecipe(Record):
    """An object as physics sees it."""

    modulus: Annotated[float, Field(ge=0.001, le=1e6)]
    """Reduced modulus E / (1 - nu^2) in MPa."""
    body: Body = Flat()
    relief: tuple[AnyLayer, ...] = ()
    twist: bool = True
    """Whether the hand turns it under pressure, as in the public videos, or only presses."""


def load_recipes(folder: Path, catalogue: Catalogue, seed: int) -> dict[str, SceneRecipe]:
    """A recipe for every object of the catalogue: listed in the folder's `scenes.yaml`, else drawn by `recipe_of`.

    What is wrong with the file is a UserError that names it, the object and the key.
    """
    listed = _read(folder / SCENES, catalogue) if (folder / SCENES).is_file() else {}
    return {o: listed[o] if o in listed else recipe_of(o, catalogue, seed) for o in catalogue.objects}


def recipe_of(object_id: str, catalogue: Catalogue, seed: int) -> SceneRecipe:
    """A recipe drawn from the labels of an object of the catalogue, whether or not it is listed in `scenes.yaml`.

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
    if described.material in LIMP:
        shape = "flat"
    else:
        shape = "barrel" if described.part in HELD else rng.choice(("flat", "round"))
    across, along = RADII_MM[shape]
    width = max(rng.uniform(*BUMP_SHARE[levels["bumpiness"]]) * IMAGE_MM[1], 0.01)
    height, spacing = width * rng.uniform(*BUMP_STEEPNESS), width * rng.uniform(1.15, 1.7)
    shaped = Domes if rng.random() < 0.5 else Ridges
    bumps: AnyLayer = shaped(height=height, width=width, spacing=spacing)
    rms = _log_uniform(rng, ROUGH_RMS_MM[levels["roughness"]])
    rough = Rough(rms=rms, longest=rng.uniform(*ROUGH_LONGEST_MM))
    return SceneRecipe(
        modulus=_log_uniform(rng, MODULUS_MPA[levels["hardness"]]),
        body=Round(radii=(_log_uniform(rng, across), _log_uniform(rng, along))),
        relief=(bumps, rough) if levels["bumpiness"] > 0 else (rough,),
    )


def _read(file: Path, catalogue: Catalogue) -> dict[str, SceneRecipe]:
    try:
        entries = yaml.load(file.read_text(encoding="utf-8"), Loader=OneKeyLoader) or {}
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{file}: {' '.join(str(error).split())[:300]}; correct it, or remove it to draw") from None
    if not isinstance(entries, dict):
        raise UserError(f"{file}: must map object ids to recipes, like `rug: {{modulus: 0.3}}`")
    recipes = {}
    for object_id, entry in entries.items():
        if object_id not in catalogue.objects:
            raise UserError(f"{file}: {object_id} is not in objects.csv; correct or remove the entry")
        try:
            recipes[object_id] = SceneRecipe.model_validate(entry)
        except ValidationError as error:
            what = first_problem(error)
            raise UserError(f"{file}: {object_id}: {what}; docs/scenes.md says which keys a recipe has") from None
    return recipes


def _log_uniform(rng: random.Random, bounds: Range) -> float:
    return math.exp(rng.uniform(math.log(bounds[0]), math.log(bounds[1])))
