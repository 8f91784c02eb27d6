"""Train the tiny Llama from scratch on generated text, by a curriculum whose steps are gated.

Run from the repository's root: `python -m standins.make_llama`. Writes `standins/llama/` (transformers' format) and
`standins/llama_curve.csv`. A killed training goes on from its last check.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from transformers import GenerationConfig, LlamaConfig, LlamaForCausalLM

from pipeline.runtime import CHECKPOINTS, seed_everything
from standins.curriculum import FORMATS, phrases, vocabulary
from standins.outputs import replacing, write_rows
from standins.settings import FOLDER, LlamaSettings, load_settings
from standins.training import Trainer
from standins.vocabulary import build_tokenizer

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast

EMBEDDING_STD = 0.1
"""With transformers' usual .02 even copying is not learnt."""
HEADER = ("step", "tokens", "format", "kind", "accuracy", "loss")


def make_model(settings: LlamaSettings, tokenizer: PreTrainedTokenizerFast) -> LlamaForCausalLM:
    """An untrained Llama: matrices of variance 1 / fan-in, a quarter of it where they write to the residual stream."""
    config = LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=settings.hidden_size,
        intermediate_size=settings.intermediate_size,
        num_hidden_layers=settings.layers,
        num_attention_heads=settings.heads,
        max_position_embeddings=settings.max_positions,
        tie_word_embeddings=True,
        bos_token_id=tokenizer.bos_token_id,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )
    model = LlamaForCausalLM(config)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "embed" in name:
                weight.normal_(0, EMBEDDING_STD)
            elif weight.ndim == 2:
                writes = "o_proj" in name or "down_proj" in name
                weight.normal_(0, weight.shape[1] ** -0.5 * (0.5 if writes else 1.0))
    return model


def save(model: LlamaForCausalLM, tokenizer: PreTrainedTokenizerFast) -> None:
    """Put the model, rounded to bfloat16, and its tokenizer in place."""
    ends = {"bos_token_id": tokenizer.bos_token_id, "eos_token_id": tokenizer.eos_token_id}
    stored = copy.deepcopy(model).to(torch.bfloat16)
    stored.generation_config = GenerationConfig(**ends, pad_token_id=tokenizer.pad_token_id)
    with replacing(FOLDER / "llama") as folder:
        tokenizer.save_pretrained(folder)
        stored.save_pretrained(folder)


def mark(settings: LlamaSettings) -> str:
    """A digest of what a training depends on: the settings, the words, and the modules of the recipe."""
    digest = hashlib.sha256(settings.model_dump_json().encode())
    digest.update("\n".join([*vocabulary(), *phrases()]).encode())
    modules = [m for name, m in sys.modules.items() if name.startswith("standins.")]
    for file in sorted({__file__, *(m.__file__ for m in modules if m.__file__), str(FOLDER / "situations.yaml")}):
        digest.update(Path(file).read_bytes())
    return digest.hexdigest()


def main() -> None:
    """Make the stand-in."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--from", type=Path, dest="file", help="go on from this checkpoint, also of another recipe")
    file = parser.parse_args().file
    settings = load_settings().llama
    torch.set_num_threads(settings.threads)
    seed_everything(settings.seed)
    tokenizer = build_tokenizer(vocabulary(), phrases())
    model = make_model(settings, tokenizer)
    print(f"{len(tokenizer)} tokens, {model.num_parameters() / 1e6:.2f}M parameters", flush=True)
    trainer = Trainer(model, tokenizer, settings, FORMATS, CHECKPOINTS / "standins-llama", mark(settings))
    if trainer.resume(file):
        print(f"going on at step {trainer.steps}", flush=True)
    trainer.learn()
    save(model, tokenizer)
    write_rows(FOLDER / "llama_curve.csv", HEADER, trainer.curve)


if __name__ == "__main__":
    main()
