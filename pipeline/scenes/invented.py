"""A catalogue of invented objects, as many as are wanted: all combinations of classes equally often.

Shapes are as wide as `invent` draws them, so that a class is not one shape, which an encoder would learn in its place.
Classes keep a distance from the borders between them, since objects near a border cannot be told apart.
"""

from __future__ import annotations

import json
import math
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from pipeline.config import InventConfig, Params
from pipeline.core.io import atomic_folder, code_of, fingerprint, write_text
from pipeline.core.layout import CHECKPOINTS, INVENTED
from pipeline.core.runtime import derive_seed
from pipeline.running.parallel import run_parallel
from pipeline.scenes.contact import Method, press_by
from pipeline.scenes.geometry import IMAGE_MM, heights
from pipeline.scenes.invent import invent
from pipeline.scenes.measure import BIG_SHARE, ROUGH_MM, bump_share, texture
from pipeline.scenes.recipe import MODULUS_MPA, SCENES, Range, SceneRecipe
from pipeline.videos.catalogue import OBJECTS, PROPERTIES, Catalogue, Object, load_catalogue

WORDS = Path(__file__).parents[1] / "physiclear"
"""Catalogue whose words for the properties are taken; nothing of its objects is."""
DATASET = "invented objects"
CLASSES = 3
"""Classes of each of the three properties; hardness, roughness and bumpiness are the digits of an object's number."""
TEXTURE: tuple[Range, ...] = (
    (0.0, ROUGH_MM[0] / 1.5),
    (ROUGH_MM[0] * 1.5, ROUGH_MM[1] / 1.5),
    (ROUGH_MM[1] * 1.5, math.inf),
)
"""Root mean square height of the texture by roughness, in mm: a factor of 1.5 away from each border."""
BUMPS: tuple[Range, ...] = ((0.0, 0.0), (0.02, BIG_SHARE / 1.25), (BIG_SHARE * 1.25, 1.0))
"""Width of the bumps by bumpiness, as a share of the image's height: a factor of 1.25 away from the border."""
WIDTHS_MM: tuple[Range, ...] = ((0.0, math.inf), (0.7, 4.5), (3.0, math.inf))
"""Widest feature of relief by bumpiness, in mm. Outside it no object measures as the class, so none is pressed."""
ACROSS = {"plates": "size", "weave": "spacing", "creases": "spacing", "digits": "stroke"}
"""By kind of layer, the key for the width of a feature where it is not `width`; roughness has no width."""
FORCES_N = (1.0, 3.0)
"""A patch is pressed with each; both must show the bumps of the class."""
WIDTH, HEIGHT = 160, 120
"""Pixels of the view that is measured."""
PITCH = IMAGE_MM[0] / WIDTH
SIDE = int(np.hypot(WIDTH, HEIGHT)) | 1
METHOD = Method("layer", 64)


def classes_of(number: int) -> tuple[int, int, int]:
    """Hardness, roughness and bumpiness of object `number`: any 27 in a row have all combinations."""
    return number % CLASSES, number // CLASSES % CLASSES, number // CLASSES**2 % CLASSES


def invented_catalogue(config: InventConfig) -> Catalogue:
    """The objects by number, with their classes and with PhysiCLeAR's words; no recipe is drawn for that.

    Ids hold the seed, so that objects of two seeds are never taken for the same.
    """
    objects = {
        object_id: Object(
            object_id=object_id,
            name=f"object {n}",
            splits={},
            stated=(None,) * CLASSES,
            ratings=tuple((level,) for level in classes_of(n)),
        )
        for n in range(config.objects)
        for object_id in (f"object_{100_000 * config.seed + n:05d}",)
    }
    language = load_catalogue(WORDS).language.model_copy(update={"dataset": DATASET})
    return Catalogue(language=language, objects=objects)


def catalogue_of(params: Params) -> Catalogue:
    """The catalogue that `data.catalogue` names, also before the chain has written that of invented objects."""
    folder = Path(params.data.catalogue)
    return invented_catalogue(params.invent) if folder == INVENTED else load_catalogue(folder)


def write_catalogue(config: InventConfig, folder: Path) -> None:
    """Draw all objects, in as many processes as there are cores, and write a catalogue's folder with their recipes.

    Object i depends on the seed and i alone. What is finished waits in checkpoints/, where a killed drawing goes on.
    """
    work = CHECKPOINTS / "invent" / fingerprint(config.seed, *code_of("invent"))
    work.mkdir(parents=True, exist_ok=True)
    files = [work / f"{number:05d}.json" for number in range(config.objects)]
    missing = [file for file in files if not file.is_file()]
    for _ in run_parallel(partial(_draw, config.seed), missing, "invented objects", "object"):
        pass
    catalogue = invented_catalogue(config)
    with atomic_folder(folder) as new:
        words = (WORDS / PROPERTIES).read_text(encoding="utf-8")
        write_text(new / PROPERTIES, re.sub(r"(?m)^dataset: .*$", f"dataset: {DATASET}", words))
        rows = [f"{o.object_id},{o.name},{','.join(map(str, o.labels))}" for o in catalogue.objects.values()]
        header = ",".join(("object_id", "name", *catalogue.property_names))
        write_text(new / OBJECTS, "\n".join([header, *rows]) + "\n")
        # JSON is YAML, and is written and read many times as fast.
        entries = zip(catalogue.objects, files, strict=True)
        write_text(new / SCENES, "".join(f"{o}: {file.read_text()}\n" for o, file in entries))


def draw(classes: tuple[int, int, int], rng: np.random.Generator) -> SceneRecipe:
    """An object that measures as these classes, off their borders, in two patches under different forces."""
    hardness, roughness, bumpiness = classes
    while True:
        recipe = invent(rng)
        sizes = [getattr(layer, ACROSS.get(layer.kind, "width"), 0.0) for layer in recipe.relief]
        widest = max((size[0] if isinstance(size, tuple) else size for size in sizes), default=0.0)
        if not WIDTHS_MM[bumpiness][0] <= widest <= WIDTHS_MM[bumpiness][1]:
            continue
        modulus = math.exp(rng.uniform(*np.log(MODULUS_MPA[hardness])))
        recipe = recipe.model_copy(update={"modulus": modulus})
        if all(_measures(recipe, roughness, bumpiness, force, rng) for force in FORCES_N):
            return recipe


def _measures(recipe: SceneRecipe, roughness: int, bumpiness: int, force: float, rng: np.random.Generator) -> bool:
    """Whether a fresh patch has the texture and, pressed, shows the bumps of these classes."""
    surface = heights(recipe.body, recipe.relief, SIDE, PITCH, rng)
    view = tuple(slice((SIDE - size) // 2, (SIDE - size) // 2 + size) for size in (HEIGHT, WIDTH))
    if not TEXTURE[roughness][0] <= texture(surface[view], PITCH) <= TEXTURE[roughness][1]:
        return False
    (skin,) = press_by(METHOD, surface, np.array([force]), recipe.modulus, PITCH).skins
    return BUMPS[bumpiness][0] <= bump_share(skin[view], PITCH) <= BUMPS[bumpiness][1]


def _draw(seed: int, file: Path) -> None:
    """Draw the object whose number a file is named after."""
    cv2.setNumThreads(1)
    number = int(file.stem)
    rng = np.random.default_rng(derive_seed(seed, "invented", number))
    write_text(file, json.dumps(draw(classes_of(number), rng).model_dump(mode="json")))
