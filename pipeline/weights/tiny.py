"""Models with random weights: tiny ones show that the chain works, ones of published shapes what these will take."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.io import save_tensors, write_json
from pipeline.core.runtime import derive_seed
from pipeline.running.errors import UserError
from pipeline.weights.backbones import CLIP_CONFIG, CLIP_WEIGHTS

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast

CLIP: dict[str, dict[str, Any]] = {
    "model_cfg": {
        "embed_dim": 64,
        "vision_cfg": {"image_size": 64, "patch_size": 8, "width": 128, "layers": 4, "head_width": 32},
        "text_cfg": {"context_length": 8, "vocab_size": 64, "width": 32, "heads": 1, "layers": 1},
    },
    "preprocess_cfg": {"mean": [0.481, 0.458, 0.408], "std": [0.269, 0.261, 0.276]},
}
"""Pictures are normalised as for OpenAI's CLIP. The text tower is never read, so it is as small as it goes."""
VIT_LARGE = {
    "model_cfg": {
        "embed_dim": 768,
        "quick_gelu": True,
        "vision_cfg": {"image_size": 224, "patch_size": 14, "width": 1024, "layers": 24},
        "text_cfg": CLIP["model_cfg"]["text_cfg"],
    },
    "preprocess_cfg": CLIP["preprocess_cfg"],
}
"""CLIP ViT-L/14's vision tower."""
LLAMA = {
    "hidden_size": 192,
    "intermediate_size": 480,
    "num_hidden_layers": 4,
    "num_attention_heads": 6,
    "max_position_embeddings": 1024,
    "tie_word_embeddings": True,
}
SPECIAL = PAD, BOS, EOS, UNK = ("<pad>", "<s>", "</s>", "<unk>")
MOST_TOKENS = 2048


def write_clip(folder: Path, catalogue: Path, seed: int, *, name: str, form: Mapping[str, Any]) -> None:
    """Write a CLIP of a configuration `form` as open_clip lays it out. It has no words, so needs no catalogue.

    Its draws depend on its name in `MADE`.
    """
    import open_clip
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(name, seed))
        model = open_clip.CLIP(**form["model_cfg"])
    write_json(folder / CLIP_CONFIG, dict(form))
    save_tensors(folder / CLIP_WEIGHTS[0], model.state_dict(), {"format": "pt"})


def write_llama(
    folder: Path, catalogue: Path, seed: int, *, name: str, form: Mapping[str, Any], dtype: str = "float32"
) -> None:
    """Write a Llama, and a tokenizer of the catalogue's words, as transformers lays them out.

    `form` is what `LlamaConfig` takes; without `vocab_size` it has as many words as the tokenizer. Weights are drawn,
    by the name in `MADE`, and written in `dtype`: 7 billion take 27 GB in float32.
    """
    import torch
    from transformers import AutoModelForCausalLM, LlamaConfig

    tokenizer = make_tokenizer(catalogue)
    ends = {f"{kind}_token_id": getattr(tokenizer, f"{kind}_token_id") for kind in ("pad", "bos", "eos")}
    config = LlamaConfig(**{"vocab_size": len(tokenizer), **form, **ends})
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(name, seed))
        model = AutoModelForCausalLM.from_config(config, dtype=getattr(torch, dtype))
    model.save_pretrained(folder)
    tokenizer.save_pretrained(folder)


def make_tokenizer(catalogue: Path) -> PreTrainedTokenizerFast:
    """A byte-level BPE of the words in a catalogue's files; any other text falls back to bytes.

    It has no chat template, so conversations are written in Vicuna's format.
    """
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
    from transformers import PreTrainedTokenizerFast

    files = sorted(file for file in catalogue.glob("*") if file.suffix in (".csv", ".yaml"))
    if not files:
        raise UserError(f"{catalogue} holds no catalogue (.csv and .yaml files); name another with data.catalogue=...")
    words = [w for file in files for w in re.findall(r"[^\W\d_]+", file.read_text(encoding="utf-8"))]
    tokenizer = Tokenizer(models.BPE(unk_token=UNK))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    trainer = trainers.BpeTrainer(
        vocab_size=MOST_TOKENS, special_tokens=list(SPECIAL), initial_alphabet=alphabet, show_progress=False
    )
    tokenizer.train_from_iterator([" ".join(words)], trainer)
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{BOS} $A", special_tokens=[(BOS, tokenizer.token_to_id(BOS))]
    )
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token=PAD, bos_token=BOS, eos_token=EOS, unk_token=UNK
    )
