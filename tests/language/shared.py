"""What the tests of the language side share: training material, generation settings, prompts."""

from __future__ import annotations

import torch

from pipeline.config import LanguageConfig, LoraTrainConfig, TrainConfig
from pipeline.embeddings import EmbeddingStore
from pipeline.language.chat import encode, render
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Material
from pipeline.records import Opd, Question

FRAMES, DIM = 2, 6


def material(language: LanguageConfig, questions: list[Question], store: EmbeddingStore) -> Material:
    trained = [q for q in questions if q.task != "PSR"]
    return Material(trained, store, Opd.ALL, language, per_video=FRAMES, flip_probability=0.5, seed=3)


def generation(batch_size: int, tokens: int = 12) -> LanguageConfig:
    return LanguageConfig(weights="", max_new_tokens=tokens, generation_batch_size=batch_size)


def taking(samples: int, **own: float) -> LoraTrainConfig:
    """Settings that take so many questions."""
    return LoraTrainConfig(samples=samples, **own)


SMALL = TrainConfig(samples=8, epochs=2, batch_size=4, micro_batch_size=2, projection_learning_rate=1e-3)


def prompt(question: Question, opd: Opd, model: OctopiForCausalLM) -> list[int]:
    """Token ids of a question's first turn."""
    dialogue = question.dialogue(opd)
    assert dialogue is not None
    text = render(dialogue.turns, model.tokenizer, system_prompt="", frames=FRAMES, complete=False)
    return list(encode(text, model.tokenizer).input_ids)


def call(model: OctopiForCausalLM) -> dict[str, torch.Tensor]:
    """A question about two frames."""
    ids = torch.tensor([[5, model.start_id, model.frame_id, model.frame_id, model.end_id, 7, 9]])
    return {"input_ids": ids, "features": torch.randn(1, 2, DIM, generator=torch.manual_seed(3))}
