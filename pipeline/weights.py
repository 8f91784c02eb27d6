"""Whether pretrained weights are there and in the right format; light, so that it can be asked before any training."""

from __future__ import annotations

import json
from pathlib import Path

from pipeline.errors import UserError

CLIP_CONFIG = "open_clip_config.json"
CLIP_WEIGHTS = ("open_clip_model.safetensors", "model.safetensors")
GET_CLIP = (
    "get CLIP ViT-L/14 with `hf download timm/vit_large_patch14_clip_224.openai --local-dir {folder}`, or the stand-in "
    "with `make standins`"
)
GET_LLM = (
    "get Vicuna with `hf download lmsys/vicuna-7b-v1.5 --local-dir {folder}` and convert it to safetensors (README, "
    "section Real weights), or the stand-in with `make standins`"
)


def clip_file(folder: Path) -> Path:
    """The file with the weights, of the names that open_clip knows; the first where there is none."""
    files = [folder / name for name in CLIP_WEIGHTS]
    return next((file for file in files if file.is_file()), files[0])


def check_encoder(folder: Path, size: int) -> None:
    """Raise UserError where `folder` holds no open_clip model as safetensors that takes frames of side `size`.

    Larger frames than its own will do: the encoder averages over areas.
    """
    mend = GET_CLIP.format(folder=folder)
    if not (folder / CLIP_CONFIG).is_file():
        raise UserError(f"encoder.weights: {folder / CLIP_CONFIG} does not exist; {mend}")
    if not clip_file(folder).is_file():
        raise UserError(
            f"encoder.weights: {folder} has no {CLIP_WEIGHTS[0]} (pickles are refused because they can run code); "
            f"{mend}"
        )
    try:
        config = json.loads((folder / CLIP_CONFIG).read_text(encoding="utf-8"))
        wanted = int(config["model_cfg"]["vision_cfg"]["image_size"])
    except (json.JSONDecodeError, KeyError, TypeError, ValueError):
        raise UserError(f"encoder.weights: {folder / CLIP_CONFIG} is no open_clip configuration; {mend}") from None
    if size < wanted:
        raise UserError(
            f"frames.size is {size} but the encoder in {folder} takes {wanted} or more; set frames.size={wanted}"
        )


def check_language(folder: Path) -> None:
    """Raise UserError where `folder` holds no transformers model as safetensors."""
    mend = GET_LLM.format(folder=folder)
    for name in ("config.json", "tokenizer_config.json"):
        if not (folder / name).is_file():
            raise UserError(f"language.weights: {folder / name} does not exist; {mend}")
    if not any(folder.glob("*.safetensors")):
        found = (
            "only pickles, which are refused because they can run code" if any(folder.glob("*.bin")) else "no weights"
        )
        raise UserError(f"language.weights: {folder} has {found}; {mend}")
