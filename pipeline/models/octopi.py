"""Octopi: tactile embeddings, projected into a language model's word embedding space."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import nn
from transformers import PreTrainedModel, PreTrainedTokenizerBase

from pipeline.artifacts import read_json, save_tensors, write_json
from pipeline.models.llm import load_llm, load_tokenizer
from pipeline.models.tactile_encoder import load_trainable
from pipeline.prompts import TACTILE_TOKENS
from pipeline.runtime import resolve_dtype
from pipeline.sections import LanguageConfig

CONNECTOR_FILE = "connector.safetensors"
ADAPTER_DIR = "adapter"


class Connector(nn.Module):
    """The paper's projection (two linear layers, GELU between) and the embeddings of the two new tokens.

    The new tokens' embeddings live here, not in the language model's matrix: they are the only word embeddings that
    are trained, the matrix keeps its shape, and a plain PEFT adapter stays loadable on the untouched base.
    """

    def __init__(self, tactile_dim: int, hidden: int) -> None:
        super().__init__()
        self.projection = nn.Sequential(nn.Linear(tactile_dim, hidden), nn.GELU(), nn.Linear(hidden, hidden))
        self.delimiters = nn.Parameter(torch.zeros(2, hidden))


class Octopi(nn.Module):
    """A causal language model that reads tactile embeddings at the places of `<tact_frame>`.

    Args:
        llm: A Llama-like model, or a PEFT model around one; frozen but for adapters.
        tokenizer: Knows the three tactile tokens.
        tactile_dim: Length of a tactile embedding.
    """

    _keys_to_ignore_on_save = None  # read by transformers' Trainer when it reloads a checkpoint

    def __init__(self, llm: PreTrainedModel, tokenizer: PreTrainedTokenizerBase, tactile_dim: int) -> None:
        super().__init__()
        self.llm = llm
        matrix = llm.get_input_embeddings().weight
        self.connector = Connector(tactile_dim, matrix.shape[1])
        with torch.no_grad():
            # The mean of all words is a neutral start for a new one.
            self.connector.delimiters.copy_(matrix.float().mean(0).expand(2, -1))
        ids = tokenizer.convert_tokens_to_ids(list(TACTILE_TOKENS))
        self.start_id, self.frame_id, self.end_id = ids
        self.tokenizer = tokenizer

    def embed(self, input_ids: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """Word embeddings with the tactile ones in their places.

        Args:
            input_ids: batch x length.
            features: batch x (most frames of a row) x tactile_dim; a row's frames come first, in reading order, and
                what lies behind them is padding that is never read.

        Returns:
            batch x length x hidden, in the language model's number format.
        """
        words = self.llm.get_input_embeddings()
        tactile = torch.isin(input_ids, input_ids.new_tensor([self.start_id, self.frame_id, self.end_id]))
        # The tactile tokens have no row in the word matrix.
        embeddings = words(input_ids.masked_fill(tactile, 0))
        frames = input_ids == self.frame_id
        used = torch.arange(features.shape[1], device=features.device) < frames.sum(1, keepdim=True)
        projected = self.connector.projection(features[used].to(self.connector.delimiters.dtype))
        embeddings = embeddings.masked_scatter(frames[..., None], projected.to(embeddings.dtype))
        for token, row in ((self.start_id, 0), (self.end_id, 1)):
            delimiter = self.connector.delimiters[row].to(embeddings.dtype)
            embeddings = torch.where((input_ids == token)[..., None], delimiter, embeddings)
        return cast(torch.Tensor, embeddings)

    def forward(
        self,
        input_ids: torch.Tensor,
        attention_mask: torch.Tensor,
        features: torch.Tensor,
        labels: torch.Tensor | None = None,
        **loss_arguments: Any,
    ) -> Any:
        """Logits, and with labels the mean cross-entropy over the answers' tokens (transformers' own loss)."""
        return self.llm(
            inputs_embeds=self.embed(input_ids, features),
            attention_mask=attention_mask,
            labels=labels,
            **loss_arguments,
        )


def build_octopi(config: LanguageConfig, tactile_dim: int) -> Octopi:
    """A fresh model on the frozen language model of `config.weights`; its connector is drawn from torch's seed."""
    folder = Path(config.weights)
    return Octopi(load_llm(folder, resolve_dtype(config.dtype)), load_tokenizer(folder), tactile_dim)


def has_adapter(folder: Path) -> bool:
    """Whether a checkpoint folder holds a LoRA adapter."""
    return (folder / ADAPTER_DIR).is_dir()


def save_octopi(model: Octopi, state: Mapping[str, torch.Tensor], folder: Path) -> None:
    """Write the connector and, where there is one, the adapter in PEFT's own format.

    Args:
        state: The trained parameters by name; the model's own may be sharded over processes.
    """
    from peft import PeftModel

    folder.mkdir(parents=True, exist_ok=True)
    save_tensors(folder / CONNECTOR_FILE, _below("connector", state))
    if isinstance(model.llm, PeftModel):
        model.llm.save_pretrained(str(folder / ADAPTER_DIR), state_dict=_below("llm", state))
        # PEFT writes a set, whose order differs from process to process, and an empty model card.
        config = folder / ADAPTER_DIR / "adapter_config.json"
        values = read_json(config)
        write_json(config, {**values, "target_modules": sorted(values["target_modules"])})
        (folder / ADAPTER_DIR / "README.md").unlink(missing_ok=True)


def _below(prefix: str, state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name.removeprefix(f"{prefix}."): v for name, v in state.items() if name.startswith(f"{prefix}.")}


def load_octopi(model: Octopi, folder: Path) -> None:
    """Read what `save_octopi` wrote into a fresh model."""
    load_trainable(model.connector, folder / CONNECTOR_FILE)
    if has_adapter(folder):
        from peft import PeftModel

        model.llm = PeftModel.from_pretrained(model.llm, str(folder / ADAPTER_DIR)).eval()
