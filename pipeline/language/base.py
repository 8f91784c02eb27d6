"""Loading of the language model, its tokenizer and its adapter from folders, never from a hub.

Adapters are in PEFT's own format: plain `PeftModel.from_pretrained(base, folder)` loads them. PEFT is imported where it
is needed: a model without an adapter is ready seconds sooner.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from transformers import AutoTokenizer, BitsAndBytesConfig, PreTrainedModel, PreTrainedTokenizerBase

from pipeline.core.io import tensor_shapes
from pipeline.core.records import Turn
from pipeline.core.runtime import Quantization
from pipeline.language.chat import add_tactile_tokens, render
from pipeline.running.errors import UserError
from pipeline.weights import again, check_finite, check_language, first_words, load_language

ADAPTER_CONFIG = "adapter_config.json"
ADAPTER_WEIGHTS = "adapter_model.safetensors"


def load_tokenizer(folder: Path) -> PreTrainedTokenizerBase:
    """The tokenizer with the tactile tokens added, and with a padding token.

    If it has none, the unknown token is used, or else the end token. Padding is identified by position, never by token
    id, so an end token that is also the padding token is still learnt and still ends an answer.

    Raises:
        UserError: for a broken file; where there is no end token, which answers are stopped by; and for no chat
            template that `render` can use.
    """
    check_language(folder, exists=True)
    try:
        tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True, use_fast=True, trust_remote_code=False)
    except Exception as error:  # The library for tokenizers raises nothing narrower.
        raise UserError(
            f"language.weights: the tokenizer in {folder} cannot be read ({first_words(error)}); {again(folder)}"
        ) from None
    if tokenizer.eos_token is None:
        raise UserError(
            f"language.weights: {folder / 'tokenizer_config.json'} names no eos_token; answers end with it, so add it"
        )
    add_tactile_tokens(tokenizer)
    render([Turn(user="a", assistant="b")] * 2, tokenizer, system_prompt="", frames=1, complete=True)
    if tokenizer.pad_token is None:
        tokenizer.pad_token = tokenizer.unk_token or tokenizer.eos_token
    return tokenizer


def load_llm(folder: Path, dtype: torch.dtype, quantization: Quantization = "none") -> PreTrainedModel:
    """Load the language model, frozen and in evaluation mode; UserError where it cannot be loaded with these settings.

    Args:
        dtype: Of the weights; with `nf4`, of what is computed and of the layers that are left whole.
        quantization: `nf4` holds linear layers in four bits (Dettmers et al. 2023), on the CUDA device.
    """
    check_language(folder, exists=True)
    own: dict[str, Any] = {}
    if quantization == "nf4":
        needed = {"bitsandbytes (`pip install bitsandbytes`)": find_spec("bitsandbytes") is not None}
        needed["a CUDA device"] = torch.cuda.is_available()
        if lacking := [name for name, found in needed.items() if not found]:
            raise UserError(
                f"language.quantization: nf4 needs {' and '.join(lacking)}; or set language.quantization=none"
            )
        kind = {"bnb_4bit_quant_type": "nf4", "bnb_4bit_use_double_quant": True, "bnb_4bit_compute_dtype": dtype}
        own["quantization_config"] = BitsAndBytesConfig(load_in_4bit=True, **kind)
        own["device_map"] = {"": torch.cuda.current_device()}
    model = load_language(folder, "language.weights", dtype=dtype, use_safetensors=True, **own)
    check_finite(folder, "language.weights", model.named_parameters())
    return model.requires_grad_(False).eval()


def load_adapter(llm: PreTrainedModel, folder: Path) -> PreTrainedModel:
    """The language model with the adapter of a folder on it (float32, frozen).

    A missing file, a pickle, or an adapter of another language model is a UserError.
    """
    from peft import PeftModel, get_peft_model_state_dict

    for name in (ADAPTER_CONFIG, ADAPTER_WEIGHTS):
        if not (folder / name).is_file():
            raise UserError(f"{folder / name}: no such file (pickled adapters are refused); `dvc repro` makes it")
    try:
        model = PeftModel.from_pretrained(llm, str(folder))
        # PEFT only warns of tensors that are missing, and says nothing of those that are too many.
        own = get_peft_model_state_dict(model, save_embedding_layers=False).keys()
        if wrong := sorted(own ^ tensor_shapes(folder / ADAPTER_WEIGHTS).keys()):
            raise ValueError(wrong[0])
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise UserError(
            f"{folder}: its adapter is broken or of another language model ({first_words(error)}); run `dvc repro`"
        ) from None
    return model
