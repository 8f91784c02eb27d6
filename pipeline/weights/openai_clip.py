"""OpenAI's CLIP (Radford et al. 2021, arXiv:2103.00020) from transformers' layout into open_clip's."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

LAYER_NAMES = {
    "layer_norm1": "ln_1",
    "layer_norm2": "ln_2",
    "mlp.fc1": "mlp.c_fc",
    "mlp.fc2": "mlp.c_proj",
    "self_attn.out_proj": "attn.out_proj",
}
"""Of a layer."""
ENDS = {
    "text_model.embeddings.token_embedding.weight": "token_embedding.weight",
    "text_model.embeddings.position_embedding.weight": "positional_embedding",
    "text_model.final_layer_norm.weight": "ln_final.weight",
    "text_model.final_layer_norm.bias": "ln_final.bias",
    "vision_model.embeddings.class_embedding": "visual.class_embedding",
    "vision_model.embeddings.patch_embedding.weight": "visual.conv1.weight",
    "vision_model.embeddings.position_embedding.weight": "visual.positional_embedding",
    "vision_model.pre_layrnorm.weight": "visual.ln_pre.weight",
    "vision_model.pre_layrnorm.bias": "visual.ln_pre.bias",
    "vision_model.post_layernorm.weight": "visual.ln_post.weight",
    "vision_model.post_layernorm.bias": "visual.ln_post.bias",
    "logit_scale": "logit_scale",
}
TURNED = {"text_projection.weight": "text_projection", "visual_projection.weight": "visual.proj"}
"""Matrices that open_clip multiplies from the other side."""


def configuration(model: Mapping[str, Any], pictures: Mapping[str, Any]) -> dict[str, Any]:
    """open_clip_config.json, from config.json and preprocessor_config.json; raises KeyError where one lacks a key."""
    from transformers import CLIPConfig

    form = CLIPConfig.from_dict(dict(model))
    vision, text = form.vision_config, form.text_config
    return {
        "model_cfg": {
            "embed_dim": form.projection_dim,
            "quick_gelu": vision.hidden_act == text.hidden_act == "quick_gelu",
            "vision_cfg": {
                "image_size": vision.image_size,
                "layers": vision.num_hidden_layers,
                "width": vision.hidden_size,
                "head_width": vision.hidden_size // vision.num_attention_heads,
                "patch_size": vision.patch_size,
            },
            "text_cfg": {
                "context_length": text.max_position_embeddings,
                "vocab_size": text.vocab_size,
                "width": text.hidden_size,
                "heads": text.num_attention_heads,
                "layers": text.num_hidden_layers,
            },
        },
        "preprocess_cfg": {"mean": pictures["image_mean"], "std": pictures["image_std"]},
    }


def renamed(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The tensors under open_clip's names, with a layer's three maps of attention in one; what it has not, is left out.

    Raises:
        KeyError: for a layer without all three.
    """
    import torch

    found = {ENDS[name]: value for name, value in state.items() if name in ENDS}
    found |= {TURNED[name]: value.T.contiguous() for name, value in state.items() if name in TURNED}
    for name, value in state.items():
        if not (place := re.fullmatch(r"(text|vision)_model\.encoder\.layers\.(\d+)\.(.+)\.(weight|bias)", name)):
            continue
        tower, layer, part, leaf = place.groups()
        there = f"{'visual.' if tower == 'vision' else ''}transformer.resblocks.{layer}"
        if part in LAYER_NAMES:
            found[f"{there}.{LAYER_NAMES[part]}.{leaf}"] = value
        elif part == "self_attn.q_proj":
            maps = [state[name.replace("q_proj", other)] for other in ("q_proj", "k_proj", "v_proj")]
            found[f"{there}.attn.in_proj_{leaf}"] = torch.cat(maps)
    return found
