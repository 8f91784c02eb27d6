"""Base models by their shapes: their own libraries build them on torch's meta device, which holds no values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.errors import UserError
from pipeline.weights import first_words

if TYPE_CHECKING:
    from open_clip.transformer import VisionTransformer
    from torch import nn
    from transformers import PreTrainedModel

CLIP_CONFIG, LLM_CONFIG = "open_clip_config.json", "config.json"
AGAIN = "get it again from where the weights are from"
LLAMA = {"q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj"}
"""Linear maps in a layer of a Llama, and of others that are built like one (Mistral, Qwen)."""


def read_tower(folder: Path) -> VisionTransformer | None:
    """The vision tower in a folder of open_clip's; where it is not there, the one published under its name.

    None for a name that is not known, and for a tower that is no vision transformer of open_clip's own.

    Raises:
        UserError: for a broken configuration.
    """
    file = folder / CLIP_CONFIG
    if not file.is_file() and folder.name not in PUBLISHED_CLIP:
        return None
    import open_clip
    import torch

    form = read_form(file) if file.is_file() else {"model_cfg": open_clip.get_model_config(PUBLISHED_CLIP[folder.name])}
    try:
        model = form["model_cfg"]
        with torch.device("meta"):
            # The visual tower alone: the text tower is never read, and open_clip would ask a hub for some.
            tower = open_clip.model._build_vision_tower(
                model["embed_dim"], model["vision_cfg"], model.get("quick_gelu", False)
            )
    except Exception as error:  # Whatever its layers make of wrong values.
        raise UserError(f"{file} is no configuration of open_clip's ({first_words(error)}); {AGAIN}") from None
    return tower if isinstance(tower, open_clip.transformer.VisionTransformer) else None


def read_language(folder: Path) -> PreTrainedModel | None:
    """The language model in a folder of transformers'; where it is not there, the one published under its name.

    None for a name that is not known, and for layers that are not built like a Llama's.

    Raises:
        UserError: for a broken configuration.
    """
    file = folder / LLM_CONFIG
    if not file.is_file() and folder.name not in PUBLISHED_LANGUAGE:
        return None
    import torch
    from transformers import AutoConfig, AutoModelForCausalLM, LlamaConfig

    try:
        if file.is_file():
            config = AutoConfig.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
        else:
            config = LlamaConfig(**PUBLISHED_LANGUAGE[folder.name])
        with torch.device("meta"):
            model: PreTrainedModel = AutoModelForCausalLM.from_config(config)
    except Exception as error:  # Whatever transformers makes of wrong values.
        raise UserError(f"{file} is no language model's configuration ({first_words(error)}); {AGAIN}") from None
    return model if linear(model).keys() >= LLAMA else None


def layers(model: nn.Module) -> nn.ModuleList:
    """The equal layers of a tower or a language model; an empty list where it has none."""
    from torch import nn

    return next((part for part in model.modules() if isinstance(part, nn.ModuleList)), nn.ModuleList())


def linear(model: nn.Module) -> dict[str, tuple[int, int]]:
    """Lengths of what goes in and comes out of the linear maps in a language model's layer."""
    from torch import nn

    parts = dict(layers(model)[:1].named_modules())
    found = {name: part for name, part in parts.items() if isinstance(part, nn.Linear)}
    return {name.rpartition(".")[2]: (part.in_features, part.out_features) for name, part in found.items()}


def parameters(*parts: nn.Module) -> int:
    """Their number; a tied one is one."""
    return sum(p.numel() for part in parts for p in part.parameters())


def read_form(file: Path) -> dict[str, Any]:
    """A configuration that came with weights; raises UserError where it is missing or no JSON object."""
    try:
        form = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{file} does not exist; {AGAIN}") from None
    except ValueError:
        form = None
    if not isinstance(form, dict):
        raise UserError(f"{file} is not a JSON object; {AGAIN}")
    return form


PUBLISHED_CLIP = dict.fromkeys(("clip-vit-large-patch14", "random-clip-vit-large"), "ViT-L-14-quickgelu")
"""By the folder's name: what open_clip calls OpenAI's model, whose configuration it ships."""
VICUNA: dict[str, Any] = {
    "model_type": "llama",
    "vocab_size": 32000,
    "max_position_embeddings": 4096,
    "hidden_act": "silu",
    "rms_norm_eps": 1e-5,
}
SIZES = ("hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads")
PUBLISHED_LANGUAGE: dict[str, dict[str, Any]] = {
    **dict.fromkeys(
        ("vicuna-7b-v1.5", "random-vicuna-7b"), dict(zip(SIZES, (4096, 11008, 32, 32), strict=True)) | VICUNA
    ),
    "vicuna-13b-v1.5": dict(zip(SIZES, (5120, 13824, 40, 40), strict=True)) | VICUNA,
    "smollm2": {
        **dict(zip(SIZES, (576, 1536, 30, 9), strict=True)),
        "num_key_value_heads": 3,
        "vocab_size": 49152,
        "tie_word_embeddings": True,
    },
}
"""From config.json of lmsys/vicuna-7b-v1.5, lmsys/vicuna-13b-v1.5 and HuggingFaceTB/SmolLM2-135M-Instruct, by the
folder's name."""
