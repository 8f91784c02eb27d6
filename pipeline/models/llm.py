"""Loading of the language model and its tokenizer from a folder, never from a hub."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError
from transformers import AutoModelForCausalLM, AutoTokenizer, PreTrainedModel, PreTrainedTokenizerBase

from pipeline.errors import UserError
from pipeline.models.weights import GET_LLM, check_language
from pipeline.prompts import add_tactile_tokens


def load_tokenizer(folder: Path) -> PreTrainedTokenizerBase:
    """The tokenizer with the tactile tokens added; padding falls back to the unknown token, never to the end token."""
    check_language(folder)
    tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True, use_fast=True)
    add_tactile_tokens(tokenizer)
    if tokenizer.pad_token is None:
        if tokenizer.unk_token is None:
            raise UserError(f"{folder}: its tokenizer has neither a padding nor an unknown token; add a pad_token")
        # pad = eos would make the model learn, or stop at, padding.
        tokenizer.pad_token = tokenizer.unk_token
    return tokenizer


def load_llm(folder: Path, dtype: torch.dtype) -> PreTrainedModel:
    """The language model, frozen and in evaluation mode.

    Raises:
        UserError: for a missing folder or file, a pickle, or a checkpoint that does not fit its configuration.
    """
    check_language(folder)
    try:
        model, info = AutoModelForCausalLM.from_pretrained(
            folder, dtype=dtype, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except (OSError, ValueError, RuntimeError, KeyError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"language.weights: {folder} cannot be loaded ({reason}); {GET_LLM.format(folder=folder)}"
        ) from None
    wrong = [*info["missing_keys"], *info["mismatched_keys"]]
    if wrong:
        raise UserError(
            f"language.weights: {folder} does not fit its config.json ({wrong[0]} is missing or of another shape); "
            f"{GET_LLM.format(folder=folder)}"
        )
    return model.requires_grad_(False).eval()
