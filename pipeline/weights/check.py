"""Base models by their configurations and headers: which shapes they have, and whether their files are whole and fit.

Their own libraries build them on torch's meta device, which holds no values. `octopi scale` asks all of this.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.io import tensor_shapes
from pipeline.running.errors import UserError
from pipeline.running.progress import quiet_libraries
from pipeline.weights import again, first_words, load_language
from pipeline.weights.backbones import BACKBONES, CLIP_CONFIG

if TYPE_CHECKING:
    from open_clip.transformer import VisionTransformer
    from tokenizers import Tokenizer
    from torch import nn
    from transformers import PreTrainedModel

LLM_CONFIG, TOKENIZER = "config.json", "tokenizer.json"
AGAIN = "get it again from where the weights are from"
SHAPES: dict[str, Any] = {"device_map": "meta", "ignore_mismatched_sizes": True}
"""Has transformers read no values, and report shapes that do not fit rather than stop at them."""
LLAMA = {"q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj"}
"""Linear maps in a layer of a Llama, and of others that are built like one (Mistral, Qwen)."""

PUBLISHED_CLIP = dict.fromkeys(("clip-vit-large-patch14", "random-clip-vit-large"), "ViT-L-14-quickgelu")
"""By the folder's name: what open_clip calls OpenAI's model, whose configuration it ships."""
SIZES = ("hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads")
VICUNA_7B: dict[str, Any] = {
    **dict(zip(SIZES, (4096, 11008, 32, 32), strict=True)),
    "model_type": "llama",
    "vocab_size": 32000,
    "max_position_embeddings": 4096,
    "hidden_act": "silu",
    "rms_norm_eps": 1e-5,
}
SMOLLM2 = {"num_key_value_heads": 3, "vocab_size": 49152, "tie_word_embeddings": True}
PUBLISHED_LANGUAGE: dict[str, dict[str, Any]] = {
    "vicuna-7b-v1.5": VICUNA_7B,
    "random-vicuna-7b": VICUNA_7B,
    "vicuna-13b-v1.5": VICUNA_7B | dict(zip(SIZES, (5120, 13824, 40, 40), strict=True)),
    "smollm2": dict(zip(SIZES, (576, 1536, 30, 9), strict=True)) | SMOLLM2,
}
"""From config.json of lmsys/vicuna-7b-v1.5, lmsys/vicuna-13b-v1.5 and HuggingFaceTB/SmolLM2-135M-Instruct, by the
folder's name."""


def read_tower(folder: Path) -> VisionTransformer | None:
    """The vision tower in a folder of open_clip's; where it is not there, the one published under its name.

    None for a name that is not known, and for a tower that is no vision transformer of open_clip's own. Raises
    UserError for a broken configuration.
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

    None for a name that is not known, and for layers that are not built like a Llama's. Raises UserError for a broken
    configuration.
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

    parts = layers(model)[:1].named_modules()
    return {name.rpartition(".")[2]: (p.in_features, p.out_features) for name, p in parts if isinstance(p, nn.Linear)}


def parameters(model: nn.Module) -> int:
    """Number of parameters; tied ones count once."""
    return sum(p.numel() for p in model.parameters())


def check_language_files(folder: Path, key: str = "language.weights") -> None:
    """Raise UserError where a language model's files are cut off, broken, or do not fit together.

    `pipeline.weights.check_language` has seen that they are there. Nothing is said of a folder that is not, since the
    chain may make it. `key` is the parameter that names it.
    """
    if not folder.is_dir():
        return
    config = read_form(folder / LLM_CONFIG)
    read_form(folder / "tokenizer_config.json")
    last = max(read_tokenizer(folder).get_vocab(with_added_tokens=False).values(), default=0)
    stored_shapes(folder.glob("*.safetensors"), key)  # transformers would not say which file is broken.
    if "quantization_config" in config:
        return  # Its tensors are in the form of a quantizer, which may not be installed.
    quiet_libraries()
    model = load_language(folder, key, use_safetensors=True, **SHAPES)
    words = model.get_input_embeddings().num_embeddings
    if last >= words:
        raise UserError(
            f"{key}: {folder / TOKENIZER} has words up to number {last}, but vocab_size of {folder / LLM_CONFIG} is "
            f"{words}; take both from one model"
        )


def check_encoder_files(folder: Path, backbone: Collection[str], key: str = "encoder.weights") -> None:
    """Raise UserError where the files that the backbones read are cut off, broken, or do not fit together.

    As `check_language_files`. What timm's own networks have is known to timm alone: of those, files are held to their
    length. `backbone` is `encoder.backbone`.
    """
    import torch

    if not folder.is_dir():
        return
    read = [BACKBONES[name] for name in backbone if BACKBONES[name].key == "weights"]
    stored = stored_shapes({f for each in read for f in each.files(folder) if f.suffix == ".safetensors"}, key)
    if "clip" not in backbone:
        return
    tower = read_tower(folder)
    if tower is None:
        raise UserError(f"{key}: {folder} is no vision transformer; visual prompts need one such as ViT-L/14")
    visual = {
        name.removeprefix("visual."): torch.empty(shape, device="meta")
        for name, shape in stored.items()
        if name.startswith("visual.")
    }
    try:
        tower.load_state_dict(visual, assign=True)
    except RuntimeError as error:  # torch names what is missing or of another shape, from the second line on.
        reason = first_words(str(error).partition("\n")[2])
        raise UserError(
            f"{key}: {folder} does not fit its {CLIP_CONFIG} ({reason}); take both from one model"
        ) from None


def stored_shapes(files: Iterable[Path], key: str) -> dict[str, tuple[int, ...]]:
    """The tensors of safetensors files, by their headers; raises UserError where one is broken or cut off."""
    try:
        return {name: shape for f in sorted(files) for name, shape in tensor_shapes(f, again(f.parent)).items()}
    except UserError as error:
        raise UserError(f"{key}: {error}") from None


def read_tokenizer(folder: Path) -> Tokenizer:
    """The fast tokenizer of a folder; raises UserError where its file is broken."""
    from tokenizers import Tokenizer

    try:
        return Tokenizer.from_file(str(folder / TOKENIZER))
    except Exception as error:  # The library raises nothing narrower.
        raise UserError(f"{folder / TOKENIZER} is no fast tokenizer ({error}); {again(folder)}") from None


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
