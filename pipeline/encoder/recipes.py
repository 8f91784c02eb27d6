"""The registry of encoder recipes. A new one is a module with the two functions below, and a line in `RECIPES`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

from pipeline.config import EncoderConfig
from pipeline.running.errors import UserError, did_you_mean

if TYPE_CHECKING:
    from pipeline.encoder.model import FrameEncoder, PropertyClassifier

RECIPES = {
    "paper": "pipeline.encoder.clip",
    "release": "pipeline.encoder.release",
    "tuned": "pipeline.encoder.tuned",
}
"""Values of `encoder.recipe` and their modules: named, not imported, as `octopi scale` checks them without torch."""


def check_recipe(name: str) -> None:
    """Raise UserError where no recipe has this name."""
    if name not in RECIPES:
        raise UserError(
            f"encoder.recipe: {name} is no recipe; {did_you_mean(name, RECIPES)}known: {', '.join(RECIPES)}"
        )


def base_encoder(config: EncoderConfig) -> FrameEncoder:
    """The ablation's base: the off-the-shelf encoder, read as the recipe reads a fine-tuned one."""
    check_recipe(config.recipe)
    encoder: FrameEncoder = import_module(RECIPES[config.recipe]).base_encoder(config)
    return encoder


def property_classifier(config: EncoderConfig, classes: Sequence[int]) -> PropertyClassifier:
    """The classifier to fine-tune, or to load a fine-tuned state into. It is drawn from torch's seed."""
    check_recipe(config.recipe)
    classifier: PropertyClassifier = import_module(RECIPES[config.recipe]).property_classifier(config, classes)
    return classifier
