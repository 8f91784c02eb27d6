"""OpenAI's CLIP (Radford et al. 2021, arXiv:2103.00020) from transformers' layout into open_clip's."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

NAMES = (
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
"""Patterns of transformers' names, and what open_clip has in their place; one after the other."""


def renamed(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """All tensors of a CLIPModel under open_clip's names, with a layer's three maps of attention in one."""
    import torch

    found = {}
    for name, value in state.items():
        for pattern, there in NAMES:
            name = re.sub(pattern, there, name)
        if name.endswith("position_ids"):
            continue  # Once stored; they are the numbers 0, 1, 2 and so on.
        # open_clip multiplies by its projections from the other side.
        found[name] = value.T.contiguous() if name in ("visual.proj", "text_projection") else value
    for first in [name for name in found if ".attn.q_proj." in name]:
        names = [first.replace("q_proj", part) for part in ("q_proj", "k_proj", "v_proj")]
        maps = [found.pop(name) for name in names if name in found]
        found[first.replace("q_proj.", "in_proj_")] = torch.cat(maps)
    return found
