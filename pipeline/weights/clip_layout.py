"""CLIP as transformers lays it out, brought into the layout of open_clip, which the chain reads."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.running.errors import UserError
from pipeline.weights.check import LLM_CONFIG, read_form

if TYPE_CHECKING:
    import torch

PICTURES = "preprocessor_config.json"
OPEN_CLIP_NAMES = (
    (r"^vision_model\.", "visual."),
    (r"^text_model\.", ""),
    (r"^visual_projection\.weight", "visual.proj"),
    (r"^text_projection\.weight", "text_projection"),
    (r"encoder\.layers\.", "transformer.resblocks."),
    (r"self_attn\.", "attn."),
    (r"layer_norm(?=[12]\.)", "ln_"),
    (r"mlp\.fc1", "mlp.c_fc"),
    (r"mlp\.fc2", "mlp.c_proj"),
    (r"embeddings\.class_embedding", "class_embedding"),
    (r"embeddings\.patch_embedding", "conv1"),
    (r"embeddings\.token_embedding", "token_embedding"),
    (r"embeddings\.position_embedding\.weight", "positional_embedding"),
    (r"pre_layrnorm", "ln_pre"),
    (r"post_layernorm", "ln_post"),
    (r"final_layer_norm", "ln_final"),
)
"""Patterns of names in transformers' CLIPModel, and what open_clip has in their place; one after the other."""


def open_clip_form(folder: Path) -> dict[str, Any]:
    """What open_clip_config.json says of the model in a folder of transformers'; UserError where that is no CLIP."""
    model, pictures = read_form(folder / LLM_CONFIG), read_form(folder / PICTURES)
    try:
        vision, text = model["vision_config"], model["text_config"]
        acts = {part["hidden_act"] for part in (vision, text)}
        form = {
            "embed_dim": model["projection_dim"],
            "quick_gelu": acts == {"quick_gelu"},
            "vision_cfg": {
                "image_size": vision["image_size"],
                "patch_size": vision["patch_size"],
                **_tower(vision),
                "head_width": vision["hidden_size"] // vision["num_attention_heads"],
            },
            "text_cfg": {
                "context_length": text["max_position_embeddings"],
                "vocab_size": text["vocab_size"],
                **_tower(text),
                "heads": text["num_attention_heads"],
            },
        }
        return {"model_cfg": form, "preprocess_cfg": {"mean": pictures["image_mean"], "std": pictures["image_std"]}}
    except (KeyError, TypeError, ZeroDivisionError):
        raise UserError(f"{folder / LLM_CONFIG} is no configuration of a CLIP; download it again") from None


def _tower(part: Mapping[str, Any]) -> dict[str, Any]:
    """What both towers have; four times the width, the usual, is left out."""
    ratio = part["intermediate_size"] / part["hidden_size"]
    own = {"width": part["hidden_size"], "layers": part["num_hidden_layers"]}
    return own if ratio == 4 else own | {"mlp_ratio": ratio}


def to_open_clip(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """All tensors of transformers' CLIPModel under open_clip's names, a layer's three maps of attention in one."""
    import torch

    found = {}
    for name, value in state.items():
        for pattern, there in OPEN_CLIP_NAMES:
            name = re.sub(pattern, there, name)
        if name.endswith("position_ids"):
            continue  # Once stored; they are the numbers 0, 1, 2 and so on.
        # open_clip multiplies by its projections from the other side.
        found[name] = value.T.contiguous() if name in ("visual.proj", "text_projection") else value
    for first in [name for name in found if ".attn.q_proj." in name]:
        names = [first.replace("q_proj", part) for part in ("q_proj", "k_proj", "v_proj")]
        # Where one is missing, the sum is too short, which the check of shapes sees.
        found[first.replace("q_proj.", "in_proj_")] = torch.cat([found.pop(name) for name in names if name in found])
    return found
