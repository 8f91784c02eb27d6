"""What is known of the encoder's backbones before one is loaded: their files, and whether these are there."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pipeline.config import EncoderConfig
from pipeline.running.errors import UserError, did_you_mean
from pipeline.weights import MADE, mend_of, to_be_made

CLIP_CONFIG = "open_clip_config.json"
CLIP_WEIGHTS = ("open_clip_model.safetensors", "model.safetensors")
TIMM_CONFIG = "config.json"
TIMM_WEIGHTS = "model.safetensors"
GET_CLIP = (
    "get CLIP ViT-L/14 with `hf download timm/vit_large_patch14_clip_224.openai --local-dir {folder}`, or set "
    "encoder.weights=data/weights/tiny-clip"
)
GET_TIMM = (
    "set encoder.weights=data/weights/efficientnet-lite0, or save a timm model with "
    "timm.models.save_for_hf(model, '{folder}', safe_serialization=True)"
)


def clip_file(folder: Path) -> Path:
    """The file with the weights, of the names that open_clip knows; the first where there is none."""
    files = [folder / name for name in CLIP_WEIGHTS]
    return next((file for file in files if file.is_file()), files[0])


def check_encoder(folder: Path, size: int, backbone: Collection[str]) -> None:
    """Raise UserError where a backbone is not known, or does not find in `folder` what it reads from it.

    Args:
        folder: `encoder.weights`; one below data/weights/ may still have to be made.
        size: Side of the frames. Larger ones than CLIP's own will do: the encoder averages over areas.
        backbone: `encoder.backbone`.
    """
    for name in backbone:
        if name not in BACKBONES:
            hint = did_you_mean(name, BACKBONES)
            raise UserError(f"encoder.backbone: {name} is no backbone; {hint}known: {', '.join(BACKBONES)}")
        if BACKBONES[name].key != "weights":
            continue
        anew = to_be_made(folder, name, "encoder.weights")
        if size < (wanted := MADE[folder.name].size if anew else frame_side(folder, name)):
            need = f"the encoder in {folder} takes {wanted} or more; set frames.pixels={wanted}"
            raise UserError(f"frames.pixels is {size} but {need}")


def frame_side(folder: Path, backbone: str) -> int:
    """Pixels that a backbone wants frames to have at least, by the configuration in `encoder.weights`.

    Raises UserError where that or the weights are missing, or it is of something else.
    """
    known = BACKBONES[backbone]
    files, mend = known.files(folder), mend_of(folder, known.get)
    for file in files:
        if not file.is_file():
            raise UserError(f"encoder.weights: {file} does not exist; {mend} (pickles are refused: they can run code)")
    try:
        return 0 if known.side is None else known.side(json.loads(files[0].read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError):
        raise UserError(f"encoder.weights: {files[0]} is no configuration of a {backbone} backbone; {mend}") from None


class Backbone(NamedTuple):
    """All that is known of a backbone before it is loaded: this needs no torch."""

    module: str
    """Module that defines `load_backbone(config, *, tuned)`."""
    words: str
    """What it is, as a report says it."""
    files: Callable[[Path], list[Path]]
    """The files of its frozen weights, given the folder (or the file itself) that `key` names."""
    key: Literal["weights", "pretrained"] = "weights"
    """Key in the section `encoder` that names the folder or file."""
    side: Callable[[Any], int] | None = None
    """Minimum side of frames in pixels, read from the first of these files (a JSON) where that says it."""
    get: str = ""
    """How to get the files, for error messages."""
    settings: tuple[str, ...] = ()
    """Keys of the section `encoder` that this backbone uses and not every other does."""

    def place(self, config: EncoderConfig) -> Path:
        """The folder or file of its weights."""
        return Path(getattr(config, self.key))


BACKBONES = {
    "clip": Backbone(
        "pipeline.encoder.clip",
        "the base CLIP with visual prompts",
        lambda folder: [folder / CLIP_CONFIG, clip_file(folder)],
        side=lambda told: int(told["model_cfg"]["vision_cfg"]["image_size"]),
        get=GET_CLIP,
        settings=("prompts", "prompt_layers"),
    ),
    "timm": Backbone(
        "pipeline.encoder.timm_backbone",
        "the base network",
        lambda folder: [folder / TIMM_CONFIG, folder / TIMM_WEIGHTS],
        # Frames of any size; the key `architecture` only shows that the file is timm's.
        side=lambda told: len(told["architecture"]) and 0,
        get=GET_TIMM,
        settings=("feature_stage",),
    ),
    "scenes": Backbone(
        "pipeline.encoder.scene_encoder",
        "a convolutional network with synthetic pretraining",
        lambda file: [file],
        key="pretrained",
    ),
}
"""Values in `encoder.backbone`."""


def reads_weights(config: EncoderConfig) -> bool:
    """Whether a backbone reads `encoder.weights`, which else names a model that nothing uses."""
    return any(BACKBONES[name].key == "weights" for name in config.backbone)


def backbone_files(config: EncoderConfig) -> list[Path]:
    """What the frozen weights of the backbones are read from; a file that several read comes once."""
    used = [BACKBONES[name] for name in config.backbone]
    return list(dict.fromkeys(file for backbone in used for file in backbone.files(backbone.place(config))))
