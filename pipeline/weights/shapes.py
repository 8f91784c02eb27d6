"""What the configurations of two kinds of base models say of their size: open_clip's vision towers and Llamas.

Sizes are numbers of values, not bytes. `saved` is what autograd keeps of a forward pass through the frozen layers, as
their derivatives need it; tests hold it to what torch keeps.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Literal, Self

from pipeline.core.errors import UserError

Targets = Sequence[str] | Literal["all-linear"]
"""`lora.target_modules`."""
CLIP_CONFIG, LLM_CONFIG = "open_clip_config.json", "config.json"
FULL = 4
"""Bytes of a float32 value."""
DROPPED = 1
"""Bytes that remember whether a value was dropped, on a GPU."""
AGAIN = "get it again from where the weights are from"
LIKE_LLAMA = ("llama", "mistral")
"""Kinds (`model_type`) of language models whose tensors have a Llama's names and shapes."""


@dataclass(frozen=True)
class Vision:
    """open_clip's vision transformer (`vision_cfg`)."""

    layers: int
    width: int
    patch_size: int
    image_size: int
    embed_dim: int
    head_width: int = 64
    quick_gelu: bool = True

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """The tower in a folder; by the published shapes of the folder's name where it is not there.

        None for a name that is not known, and for a tower that is no vision transformer of open_clip's own.

        Raises:
            UserError: for a broken configuration.
        """
        file = folder / CLIP_CONFIG
        if not file.is_file():
            known = PUBLISHED_VISION.get(folder.name)
            return cls(**known) if known else None
        model = read_form(file).get("model_cfg")
        form = model.get("vision_cfg") if isinstance(model, dict) else None
        if not isinstance(model, dict) or not isinstance(form, dict):
            raise UserError(f"{file} is no open_clip configuration (model_cfg, vision_cfg); {AGAIN}")
        if isinstance(form.get("layers"), list) or "timm_model_name" in form:
            return None
        return cls(
            **sizes(form, ("layers", "width", "patch_size", "image_size"), file),
            **sizes(model, ("embed_dim",), file),
            **sizes({"head_width": 64} | form, ("head_width",), file),
            quick_gelu=bool(model.get("quick_gelu", False)),
        )

    @property
    def tokens(self) -> int:
        """Of a picture: its patches and the class token."""
        return (self.image_size // self.patch_size) ** 2 + 1

    @property
    def parameters(self) -> int:
        """Of the whole tower."""
        return sum(map(prod, self.tensors.values()))

    @property
    def tensors(self) -> dict[str, tuple[int, ...]]:
        """Shapes by name, as a checkpoint has them."""
        width = self.width
        layer: dict[str, tuple[int, ...]] = {
            "attn.in_proj_weight": (3 * width, width),
            "attn.in_proj_bias": (3 * width,),
            "attn.out_proj.weight": (width, width),
            "attn.out_proj.bias": (width,),
            "mlp.c_fc.weight": (4 * width, width),
            "mlp.c_fc.bias": (4 * width,),
            "mlp.c_proj.weight": (width, 4 * width),
            "mlp.c_proj.bias": (width,),
        }
        norms = [f"transformer.resblocks.{i}.{norm}" for i in range(self.layers) for norm in ("ln_1", "ln_2")]
        found: dict[str, tuple[int, ...]] = {
            "class_embedding": (width,),
            "positional_embedding": (self.tokens, width),
            "conv1.weight": (width, 3, self.patch_size, self.patch_size),
            "proj": (width, self.embed_dim),
            **{f"{norm}.{part}": (width,) for norm in ("ln_pre", "ln_post", *norms) for part in ("weight", "bias")},
            **{f"transformer.resblocks.{i}.{n}": shape for i in range(self.layers) for n, shape in layer.items()},
        }
        return {f"visual.{name}": shape for name, shape in found.items()}

    def saved(self, frames: int, prompts: int, size: int) -> int:
        """Bytes that a training forward keeps.

        Args:
            frames: Pictures at a time.
            prompts: Tokens beside a picture's own at each layer.
            size: Bytes of the value that linear layers compute in; below 4 it is autocast.
        """
        width, heads = self.width, self.width // self.head_width
        # Norms are computed in float32; attention keeps its three inputs, its outcome and a sum a head.
        token = 2 * width * FULL + 4 * FULL + 4 * width * size + heads * FULL
        # x sigmoid(1.702 x) is a product: both factors are kept.
        token += (2 if self.quick_gelu else 1) * 4 * width * size
        # Autocast makes copies of the frozen weights, and the derivatives keep them.
        copies = self.layers * 12 * width**2 * size if size < FULL else 0
        read = frames * (self.tokens + prompts)
        return self.layers * read * token + read * (width + 2) * FULL + copies

    def passing(self, frames: int, prompts: int, size: int) -> int:
        """Bytes that come and go at the widest place: four tensors of the wide map's outcome."""
        return 4 * frames * (self.tokens + prompts) * 4 * self.width * size


@dataclass(frozen=True)
class Llama:
    """transformers' Llama (`config.json`)."""

    hidden_size: int
    intermediate_size: int
    num_hidden_layers: int
    num_attention_heads: int
    vocab_size: int
    num_key_value_heads: int
    head_dim: int
    tie_word_embeddings: bool = False

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """The model in a folder; by the published shapes of the folder's name where it is not there.

        None for a name that is not known, and for another kind of model whose configuration has not a Llama's keys.

        Raises:
            UserError: for a broken configuration.
        """
        file = folder / LLM_CONFIG
        form = read_form(file) if file.is_file() else PUBLISHED_LANGUAGE.get(folder.name)
        keys = ("hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads", "vocab_size")
        if form is None or (form.get("model_type") not in LIKE_LLAMA and not form.keys() >= set(keys)):
            return None
        found = sizes(form, keys, file)
        # Both may be absent or null.
        usual = {
            "num_key_value_heads": found["num_attention_heads"],
            "head_dim": found["hidden_size"] // found["num_attention_heads"],
        }
        own = usual | {key: form[key] for key in usual if form.get(key) is not None}
        return cls(**found, **sizes(own, usual, file), tie_word_embeddings=bool(form.get("tie_word_embeddings", False)))

    @property
    def linear(self) -> dict[str, tuple[int, int]]:
        """Lengths of what goes in and comes out of a layer's linear maps."""
        hidden, middle = self.hidden_size, self.intermediate_size
        queries, keys = self.num_attention_heads * self.head_dim, self.num_key_value_heads * self.head_dim
        return {
            "q_proj": (hidden, queries),
            "k_proj": (hidden, keys),
            "v_proj": (hidden, keys),
            "o_proj": (queries, hidden),
            "gate_proj": (hidden, middle),
            "up_proj": (hidden, middle),
            "down_proj": (middle, hidden),
        }

    @property
    def tensors(self) -> dict[str, tuple[int, ...]]:
        """Shapes by name, as a checkpoint has them; a linear map has a row for each value that comes out."""
        hidden = self.hidden_size
        found: dict[str, tuple[int, ...]] = {
            "model.embed_tokens.weight": (self.vocab_size, hidden),
            "model.norm.weight": (hidden,),
        }
        if not self.tie_word_embeddings:
            found["lm_head.weight"] = (self.vocab_size, hidden)
        for layer in (f"model.layers.{i}" for i in range(self.num_hidden_layers)):
            for name, (read, made) in self.linear.items():
                part = "self_attn" if name in ("q_proj", "k_proj", "v_proj", "o_proj") else "mlp"
                found[f"{layer}.{part}.{name}.weight"] = (made, read)
            for norm in ("input_layernorm", "post_attention_layernorm"):
                found[f"{layer}.{norm}.weight"] = (hidden,)
        return found

    @property
    def layer_linear(self) -> int:
        """Parameters of a layer's linear maps."""
        return sum(a * b for a, b in self.linear.values())

    @property
    def words(self) -> int:
        """Parameters outside the layers: word embeddings, the last norm, and the head where it is not tied."""
        return self.hidden_size * (1 + self.vocab_size * (1 if self.tie_word_embeddings else 2))

    @property
    def parameters(self) -> int:
        """Of the whole model."""
        return self.words + self.num_hidden_layers * (self.layer_linear + 2 * self.hidden_size)

    def _adapted(self, targets: Targets) -> list[str]:
        """The linear maps of a layer that get an adapter."""
        return [name for name in self.linear if targets == "all-linear" or name in targets]

    def adapters(self, targets: Targets, rank: int) -> int:
        """Parameters of low-rank adapters on these linear maps of each layer."""
        return self.num_hidden_layers * rank * sum(sum(self.linear[t]) for t in self._adapted(targets))

    def saved_layer(self, size: int) -> int:
        """Bytes a token that one frozen layer keeps of a training forward; `size` is that of a weight's value."""
        queries, keys = self.num_attention_heads * self.head_dim, self.num_key_value_heads * self.head_dim
        norms = 2 * (self.hidden_size + 1) * FULL
        attention = (2 * queries + 2 * keys) * size + self.num_attention_heads * FULL
        return norms + attention + 3 * self.intermediate_size * size

    def saved_adapters(self, targets: Targets, rank: int, size: int, dropout: bool) -> int:
        """Bytes a token that one layer's adapters, in float32, keep besides."""
        known = self._adapted(targets)
        total = len(known) * rank * FULL
        if dropout:
            return total + sum(self.linear[t][0] * (FULL + DROPPED) for t in known)
        # What several maps read is one tensor, unless each casts it for itself.
        read = [self.linear[t][0] for t in known]
        if size == FULL:
            groups = {"q_proj": 0, "k_proj": 0, "v_proj": 0, "gate_proj": 1, "up_proj": 1}
            # down_proj reads a product, o_proj the outcome of attention, which are kept already or for this alone.
            read = [self.hidden_size for _ in {groups[t] for t in known if t in groups}]
            read += [self.intermediate_size] if "down_proj" in known else []
        return total + sum(read) * FULL

    def saved_loss(self, labels: int) -> int:
        """Bytes that the loss keeps for so many labelled tokens: logarithms of all words' probabilities."""
        return labels * self.vocab_size * FULL

    def cache(self, tokens: int, size: int) -> int:
        """Bytes of so many tokens' keys and values."""
        return 2 * tokens * self.num_hidden_layers * self.num_key_value_heads * self.head_dim * size


def read_form(file: Path) -> dict[str, Any]:
    """A configuration that came with weights; raises UserError where it is no JSON object."""
    try:
        form = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        form = None
    if not isinstance(form, dict):
        raise UserError(f"{file} is not a JSON object; {AGAIN}")
    return form


def sizes(form: dict[str, Any], keys: Iterable[str], file: Path) -> dict[str, int]:
    """The values of these keys of a configuration; raises UserError where one is no whole number of 1 or more."""
    for key in keys:
        if type(form.get(key)) is not int or form[key] < 1:
            found = repr(form[key]) if key in form else "missing"
            raise UserError(f"{file}: {key} must be a whole number of 1 or more and is {found}; {AGAIN}")
    return {key: form[key] for key in keys}


PUBLISHED_VISION: dict[str, dict[str, Any]] = {
    "clip-vit-large-patch14": {
        "layers": 24,
        "width": 1024,
        "patch_size": 14,
        "image_size": 224,
        "embed_dim": 768,
        "quick_gelu": True,
    }
}
"""From open_clip_config.json of timm/vit_large_patch14_clip_224.openai, by the folder's name."""
PUBLISHED_LANGUAGE: dict[str, dict[str, Any]] = {
    **{
        f"vicuna-{size}-v1.5": {
            "hidden_size": hidden,
            "intermediate_size": middle,
            "num_hidden_layers": depth,
            "num_attention_heads": depth,  # Both have as many heads as layers.
            "model_type": "llama",
            "vocab_size": 32000,
            "max_position_embeddings": 4096,
            "hidden_act": "silu",
            "rms_norm_eps": 1e-5,
        }
        for size, hidden, middle, depth in (("7b", 4096, 11008, 32), ("13b", 5120, 13824, 40))
    },
    "smollm2": {
        "model_type": "llama",
        "hidden_size": 576,
        "intermediate_size": 1536,
        "num_hidden_layers": 30,
        "num_attention_heads": 9,
        "num_key_value_heads": 3,
        "vocab_size": 49152,
        "tie_word_embeddings": True,
    },
}
"""From config.json of lmsys/vicuna-7b-v1.5, lmsys/vicuna-13b-v1.5 and HuggingFaceTB/SmolLM2-135M-Instruct, by the
folder's name."""
