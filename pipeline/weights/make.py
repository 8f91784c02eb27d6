"""Making base models: from packages that hold pretrained weights, or tiny and at random.

A folder is written beside its place, with a card and the licence, and renamed when it is whole.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import yaml

from pipeline.core.errors import UserError
from pipeline.core.io import atomic_folder, write_text
from pipeline.weights import DOWNLOADED, efficientnet, smollm2, tiny
from pipeline.weights.source import Given, Origin

CATALOGUE = Path(__file__).parents[1] / "physiclear"


class Recipe(NamedTuple):
    """How a base model is made."""

    write: Callable[[Path, Given], None]
    """Writes configuration and weights into an empty folder."""
    card: Mapping[str, object]
    """Front matter of its card, in Hugging Face's keys; `taught` is what reports say of it."""
    about: str
    """The text of its card."""
    origin: Origin | None = None
    """Where its weights come from; None where they are drawn."""


RECIPES = {
    "efficientnet-lite0": Recipe(efficientnet.write, efficientnet.CARD, efficientnet.ABOUT, efficientnet.ORIGIN),
    "smollm2": Recipe(smollm2.write, smollm2.CARD, smollm2.ABOUT, smollm2.ORIGIN),
    "tiny-clip": Recipe(tiny.write_clip, tiny.CLIP_CARD, tiny.ABOUT),
    "tiny-llama": Recipe(tiny.write_llama, tiny.LLAMA_CARD, tiny.ABOUT),
}
"""By name; `pipeline.weights.MADE` says which kind each is."""
PACKAGED = {name for name, recipe in RECIPES.items() if recipe.origin}
"""Those that an installed package holds."""


def make(name: str, folder: Path, *, seed: int = 0, catalogue: Path = CATALOGUE) -> None:
    """Make a base model, whole or not at all; what lies in the folder is replaced.

    Args:
        name: In `RECIPES`.
        folder: Where it goes.
        seed: Of the weights of a random model.
        catalogue: Folder whose words the tokenizer of a random language model knows.

    Raises:
        UserError: for an unknown name, or a package that is missing or holds another file than was tested.
    """
    recipe = RECIPES.get(name)
    if recipe is None:
        raise UserError(f"weights {name!r} are not known; allowed: {', '.join((*RECIPES, *DOWNLOADED))}")
    origin = recipe.origin
    given = Given(origin.find() if origin else catalogue, seed)
    with atomic_folder(folder) as temporary:
        recipe.write(temporary, given)
        source = "Drawn from a seed by this pipeline."
        if origin:
            source = (
                f"Made of `{origin.file}` of the package {origin.package} {origin.version}, sha256 {origin.sha256}."
            )
            if licence := origin.licence():
                shutil.copyfile(licence, temporary / "LICENSE")
        front = yaml.safe_dump(dict(recipe.card), sort_keys=False)
        write_text(temporary / "README.md", f"---\n{front}---\n# {name}\n\n{recipe.about}\n\n{source}\n")
