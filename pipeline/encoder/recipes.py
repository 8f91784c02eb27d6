"""Which encoder and heads a recipe is made of: the one place that knows the recipes by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.config import EncoderConfig
from pipeline.encoder.clip import load_visual_tower
from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.model import Heads, PropertyClassifier, TactileEncoder
from pipeline.encoder.release import PublishedEncoder, PublishedHeads
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.vpt import VisualPrompts


def base_encoder(config: EncoderConfig) -> TactileEncoder:
    """The off-the-shelf CLIP encoder (the ablation's base), read as the recipe reads a fine-tuned one."""
    kind = PublishedEncoder if config.recipe == "release" else TactileEncoder
    return kind(load_visual_tower(Path(config.weights)))


def property_classifier(config: EncoderConfig, classes: Sequence[int]) -> PropertyClassifier:
    """The classifier to fine-tune, or to load a fine-tuned state into.

    Args:
        classes: How many classes each property has.
    """
    if config.recipe == "pretrained":
        return FrameVotes(SceneEncoder(), classes)
    tower = load_visual_tower(Path(config.weights))
    paper = config.recipe == "paper"
    layers = min(tower.layers, config.prompt_layers or tower.layers)
    prompts = VisualPrompts(layers, config.prompts, tower.width, tower.patch_area, shared=paper)
    encoder = (TactileEncoder if paper else PublishedEncoder)(tower, prompts)
    heads = (Heads if paper else PublishedHeads)(encoder.dim, classes)
    return PropertyClassifier(encoder, heads, classes)
