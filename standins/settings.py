"""The stand-ins' parameters, read from `params.yaml` and checked."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, PositiveInt, ValidationError

from pipeline.errors import UserError

FOLDER = Path(__file__).parent


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ClipSettings(_Section):
    """The tiny CLIP: architecture, contrastive training, zero-shot test."""

    seed: int
    image_size: PositiveInt
    patch_size: PositiveInt
    width: PositiveInt
    layers: PositiveInt
    text_width: PositiveInt
    text_layers: PositiveInt
    embed_dim: PositiveInt
    context_length: PositiveInt
    batch_size: int = Field(ge=2)
    full_captions: float = Field(ge=0, le=1)
    topic_weight: float = Field(gt=0)
    steps: PositiveInt
    learning_rate: float = Field(gt=0)
    matrix_rate: float = Field(gt=0)
    warmup_steps: PositiveInt
    descent: float = Field(gt=0, le=1)
    weight_decay: float = Field(ge=0)
    temperature: float = Field(gt=0)
    max_logit_scale: float = Field(gt=1)
    log_every: PositiveInt
    test_scenes: PositiveInt
    candidates: int = Field(ge=2)


class LlamaSettings(_Section):
    """The tiny Llama: architecture, curriculum, gate."""

    seed: int
    threads: PositiveInt
    hidden_size: PositiveInt
    intermediate_size: PositiveInt
    layers: PositiveInt
    heads: PositiveInt
    max_positions: PositiveInt
    learning_rate: float = Field(gt=0)
    betas: tuple[float, float]
    warmup_steps: PositiveInt
    weight_decay: float = Field(ge=0)
    gradient_clip: float = Field(gt=0)
    batch_tokens: PositiveInt
    probe_layer: PositiveInt
    probe_weight: float = Field(ge=0)
    round_documents: PositiveInt
    check_rounds: PositiveInt
    check_questions: PositiveInt
    pass_accuracy: float = Field(gt=0, le=1)
    format_rounds: PositiveInt
    stall_rounds: PositiveInt
    stalled_rate: float = Field(gt=0, le=1)
    decay_rounds: PositiveInt
    gate_questions: PositiveInt
    gate_seed: int
    held_out: tuple[tuple[int, int, int], ...] = Field(min_length=3)


class Settings(_Section):
    """Everything in `params.yaml`."""

    clip: ClipSettings
    llama: LlamaSettings


def load_settings(path: Path = FOLDER / "params.yaml") -> Settings:
    """Read and check the parameters; a UserError names the file and the key."""
    try:
        return Settings.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (ValidationError, yaml.YAMLError, OSError) as error:
        raise UserError(f"{path}: {' '.join(str(error).split())[:300]}") from None
