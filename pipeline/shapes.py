"""What the configurations of two kinds of base models say of their size: open_clip's vision towers and Llamas.

Sizes are numbers of values, not bytes. `saved` is what autograd keeps of a forward pass through the frozen layers, as
their derivatives need it; tests hold it to what torch keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pipeline.io import read_json

CLIP_CONFIG, LLM_CONFIG = "open_clip_config.json", "config.json"
FULL = 4
"""Bytes of a float32 value."""
DROPPED = 1
"""Bytes that remember whether a value was dropped, on a GPU."""


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
        """The tower in a folder; by the published shapes of the folder's name where it is not there, or None."""
        if not (folder / CLIP_CONFIG).is_file():
            known = PUBLISHED_VISION.get(folder.name)
            return cls(**known) if known else None
        model = read_json(folder / CLIP_CONFIG)["model_cfg"]
        form = model["vision_cfg"]
        return cls(
            **{key: form[key] for key in ("layers", "width", "patch_size", "image_size")},
            embed_dim=model["embed_dim"],
            head_width=form.get("head_width", 64),
            quick_gelu=bool(model.get("quick_gelu", False)),
        )

    @property
    def tokens(self) -> int:
        """Of a picture: its patches and the class token."""
        return (self.image_size // self.patch_size) ** 2 + 1

    @property
    def layer(self) -> int:
        """Parameters of a layer: two norms, attention, and the two maps behind it that are four times as wide."""
        return 12 * self.width**2 + 13 * self.width

    @property
    def parameters(self) -> int:
        """Of the whole tower."""
        patches = 3 * self.patch_size**2 * self.width
        return patches + self.width * (1 + self.tokens + 4 + self.embed_dim) + self.layers * self.layer

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
        """The model in a folder; by the published shapes of the folder's name where it is not there, or None."""
        file = folder / LLM_CONFIG
        form: dict[str, Any] | None = read_json(file) if file.is_file() else PUBLISHED_LANGUAGE.get(folder.name)
        if form is None:
            return None
        heads = form["num_attention_heads"]
        return cls(
            **{key: form[key] for key in ("hidden_size", "intermediate_size", "num_hidden_layers", "vocab_size")},
            num_attention_heads=heads,
            num_key_value_heads=form.get("num_key_value_heads") or heads,
            head_dim=form.get("head_dim") or form["hidden_size"] // heads,
            tie_word_embeddings=bool(form.get("tie_word_embeddings", False)),
        )

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

    def adapters(self, targets: Sequence[str], rank: int) -> int:
        """Parameters of low-rank adapters on these linear maps of each layer."""
        return self.num_hidden_layers * rank * sum(sum(self.linear[t]) for t in targets if t in self.linear)

    def saved_layer(self, size: int) -> int:
        """Bytes a token that one frozen layer keeps of a training forward; `size` is that of a weight's value."""
        queries, keys = self.num_attention_heads * self.head_dim, self.num_key_value_heads * self.head_dim
        norms = 2 * (self.hidden_size + 1) * FULL
        attention = (2 * queries + 2 * keys) * size + self.num_attention_heads * FULL
        return norms + attention + 3 * self.intermediate_size * size

    def saved_adapters(self, targets: Sequence[str], rank: int, size: int, dropout: bool) -> int:
        """Bytes a token that one layer's adapters, in float32, keep besides."""
        known = [t for t in targets if t in self.linear]
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
_VICUNA = {"vocab_size": 32000, "max_position_embeddings": 4096}
PUBLISHED_LANGUAGE: dict[str, dict[str, Any]] = {
    "vicuna-7b-v1.5": {
        "hidden_size": 4096,
        "intermediate_size": 11008,
        "num_hidden_layers": 32,
        "num_attention_heads": 32,
        **_VICUNA,
    },
    "vicuna-13b-v1.5": {
        "hidden_size": 5120,
        "intermediate_size": 13824,
        "num_hidden_layers": 40,
        "num_attention_heads": 40,
        **_VICUNA,
    },
}
"""From config.json of lmsys/vicuna-7b-v1.5 and lmsys/vicuna-13b-v1.5, by the folder's name."""
