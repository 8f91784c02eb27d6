"""What Octopi adds to a language model, and what a saved model says of itself."""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import Field, ValidationError
from torch import nn

from pipeline.config import TrainedEmbeddings
from pipeline.core.errors import UserError, first_problem
from pipeline.core.io import read_json
from pipeline.core.records import Record
from pipeline.language.chat import TACTILE_TOKENS

CONFIG_FILE = "config.json"


class OctopiConfig(Record):
    """config.json of a saved model: what it stands on, and its shapes."""

    model_type: str = "octopi"
    architectures: tuple[str, ...] = ("OctopiForCausalLM",)
    base_model: str
    """Folder of the language model, as `language.weights` named it."""
    tactile_dim: int = Field(ge=1)
    """Length of a tactile embedding."""
    hidden_size: int = Field(ge=1)
    """Length of a word embedding."""
    tactile_tokens: tuple[str, ...] = TACTILE_TOKENS
    normalized: bool = False
    """Whether projected embeddings are as long as the language model's words (`language.normalize_touch`)."""
    trained_embeddings: TrainedEmbeddings = "new"
    """Whether words.safetensors holds embeddings of all words, or the language model's own are used."""


class Connector(nn.Module):
    """The paper's projection (two linear layers, GELU between) and the embeddings of the two new tokens.

    The new tokens' embeddings live here, not in the language model's matrix, whether its rows are trained too or not:
    the matrix keeps its shape, and a plain PEFT adapter stays loadable on the untouched base.
    """

    def __init__(self, tactile_dim: int, hidden: int) -> None:
        super().__init__()
        self.projection = nn.Sequential(nn.Linear(tactile_dim, hidden), nn.GELU(), nn.Linear(hidden, hidden))
        self.delimiters = nn.Parameter(torch.zeros(2, hidden))


def read_config(folder: Path) -> OctopiConfig:
    """config.json of a folder that `OctopiForCausalLM.save_pretrained` wrote; anything else is a UserError."""
    try:
        return OctopiConfig.model_validate(read_json(folder / CONFIG_FILE))
    except ValidationError as error:
        raise UserError(f"{folder / CONFIG_FILE}: {first_problem(error)}; run `dvc repro`") from None
