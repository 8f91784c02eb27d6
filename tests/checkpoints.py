"""Tiny models in published layouts, ways to change their files, and the base models that are made once."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from safetensors.torch import load_file, save_file

from pipeline.core.io import fingerprint
from pipeline.weights.make import CATALOGUE, make
from tests.closure import ROOT

CLIP_CONFIG: dict[str, dict[str, Any]] = {
    "model_cfg": {
        "embed_dim": 16,
        "quick_gelu": True,
        "vision_cfg": {"image_size": 32, "layers": 2, "width": 32, "head_width": 16, "patch_size": 16},
        "text_cfg": {"context_length": 8, "vocab_size": 64, "width": 16, "heads": 2, "layers": 1},
    },
    "preprocess_cfg": {"mean": [0.5, 0.4, 0.3], "std": [0.2, 0.25, 0.3]},
}


def edit(file: Path, **changes: Any) -> None:
    """Set keys of a JSON object; None takes a key away."""
    form = json.loads(file.read_text()) | changes
    file.write_text(json.dumps({k: v for k, v in form.items() if v is not None}))


def cut(file: Path, by: int = 1) -> None:
    file.write_bytes(file.read_bytes()[:-by])


def replace(file: Path, name: str, value: torch.Tensor) -> None:
    save_file(load_file(file) | {name: value}, file)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder and its subfolders, by its path within."""
    return {f.relative_to(folder).as_posix(): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def write_clip(folder: Path, seed: int = 0, config: dict[str, dict[str, Any]] = CLIP_CONFIG) -> Path:
    """A CLIP as `hf download timm/vit_large_patch14_clip_224.openai` would lay it out."""
    import open_clip

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "open_clip_config.json").write_text(json.dumps(config))
    torch.manual_seed(seed)
    model = open_clip.CLIP(**config["model_cfg"])
    save_file({k: v.contiguous() for k, v in model.state_dict().items()}, folder / "open_clip_model.safetensors")
    return folder


def write_llama(
    folder: Path, seed: int = 0, *, bos: bool = True, pad: str | None = "<pad>", shard: str = "5GB", **shapes: object
) -> Path:
    """A Llama (or a `kind`) with a byte-level tokenizer as `save_pretrained` lays it out; `shapes` go to its config."""
    import transformers
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    special = ["<pad>", "<s>", "</s>", "<unk>"]
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {token: i for i, token in enumerate([*special, *alphabet])}
    tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=[], unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    if bos:
        tokenizer.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    named = {"bos_token": "<s>", "eos_token": "</s>", "unk_token": "<unk>"} | ({"pad_token": pad} if pad else {})
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, **named).save_pretrained(folder)
    torch.manual_seed(seed)
    usual = {"vocab_size": len(vocabulary), "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2}
    usual |= {"num_attention_heads": 4, "num_key_value_heads": 2, "max_position_embeddings": 2048}
    usual |= {"bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
    kind = shapes.pop("kind", "Llama")
    config = getattr(transformers, f"{kind}Config")(**(usual | shapes))
    getattr(transformers, f"{kind}ForCausalLM")(config).save_pretrained(folder, max_shard_size=shard)
    return folder


def write_vicuna(folder: Path, words: str, **shapes: object) -> Path:
    """A narrow Vicuna v1.5 as `save_pretrained` lays it out once it is converted: float16 in several files, pieces of
    `words` as SentencePiece makes them, letters outside them as bytes, the unknown token for padding."""
    from tokenizers import Tokenizer, models, pre_tokenizers, trainers
    from transformers import LlamaConfig, LlamaForCausalLM, LlamaTokenizer

    pieces = Tokenizer(models.BPE(unk_token="<unk>", byte_fallback=True))
    pieces.pre_tokenizer = pre_tokenizers.Metaspace(prepend_scheme="first")
    letters = [f"<0x{byte:02X}>" for byte in range(256)]
    special = ["<unk>", "<s>", "</s>", *letters]
    trainer = trainers.BpeTrainer(vocab_size=1500, special_tokens=special, show_progress=False)
    pieces.train_from_iterator([words], trainer)
    learnt = json.loads(pieces.to_str())["model"]
    merges = [tuple(pair) for pair in learnt["merges"]]
    tokenizer = LlamaTokenizer(vocab=learnt["vocab"], merges=merges, pad_token="<unk>")
    tokenizer.save_pretrained(folder)
    narrow = {"hidden_size": 64, "intermediate_size": 128, "num_attention_heads": 4, "vocab_size": len(tokenizer)}
    vicuna = {"max_position_embeddings": 4096, "rms_norm_eps": 1e-5, "pad_token_id": 0, "tie_word_embeddings": False}
    torch.manual_seed(0)
    model = LlamaForCausalLM(LlamaConfig(**(narrow | vicuna | shapes)))  # type: ignore[arg-type]
    model.half().save_pretrained(folder, max_shard_size="200KB")
    return folder


@cache
def model_folder(name: str) -> Path:
    """The folder of a base model, such as `smollm2` (a minute, and half a gigabyte) or `tiny-llama`; leave it as it is.

    It is kept in pytest's cache under a hash of the code that makes it and of the packages' versions.
    """
    key = fingerprint(ROOT / "pipeline" / "weights", ROOT / "requirements.lock", CATALOGUE)
    folder = ROOT / ".pytest_cache" / "weights" / key / name
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_suffix(".lock")):
        if not folder.is_dir():
            make(name, folder)
    return folder
